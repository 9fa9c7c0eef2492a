"""Map of the replays of one drive: paths over truth and fixes, ellipses of the position, rejected fixes."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.outputs.replay_files import is_local
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet

ELLIPSE_SIGMAS = 2.0
"""Half axes of the ellipses; two dimensions have 1 - exp(-2) = 86 % of their probability inside."""
ELLIPSE_S, MOST_ELLIPSES = 10.0, 60
"""Seconds between ellipses; longer drives get at most so many, outside and inside outages."""


def rejected_fixes(estimate: Estimate) -> TimesNs:
    """Times (N,) of the fixes whose position was rejected by a gate."""
    rejected = [i.t_ns for i in estimate.innovations if i.sensor == "gnss" and not i.accepted]
    return np.array(rejected, dtype=np.int64)


def ellipse_rows(estimate: Estimate, start_ns: int, outages: Sequence[Outage]) -> NDArray[np.int64]:
    """Keyframes that get an ellipse: one in ten seconds, and one in two seconds in an outage.

    An outage is one of `outages`, or where the estimate's status says so. The last keyframe of each is
    among them: there the position is the least certain.
    """
    t_ns = estimate.trajectory.t_ns
    alone = np.asarray(estimate.status == "outage")
    for outage in outages:
        alone |= outage.covers(t_ns, start_ns)
    rows: list[int] = []
    for inside, every_s in ((False, ELLIPSE_S), (True, ELLIPSE_S / 5.0)):
        chosen = np.flatnonzero(alone == inside)
        slot = ((t_ns[chosen] - start_ns) // round(every_s * 1e9)).astype(np.int64)
        first = chosen[np.flatnonzero(np.diff(slot, prepend=-1))]
        rows += first[style.thin(len(first), MOST_ELLIPSES)].tolist()
    ends = np.flatnonzero(alone & ~np.append(alone[1:], False))
    return np.unique(np.array([*rows, *ends.tolist()], dtype=np.int64))


def ellipses(estimate: Estimate, rows: NDArray[np.int64]) -> Array:
    """Ellipses (K, 41, 2) of the position, m, at those of the keyframes `rows` whose covariance is known."""
    path = estimate.trajectory
    if path.covariance is None:
        return np.zeros((0, 41, 2))
    P = path.covariance[rows, :2, :2]
    known = np.isfinite(P).all(axis=(1, 2)) & np.isfinite(path.position_m[rows, :2]).all(axis=1)
    size, axes = np.linalg.eigh(P[known])
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = ring * ELLIPSE_SIGMAS * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    return np.asarray(np.einsum("kij,knj->kni", axes, points) + path.position_m[rows[known], None, :2])


MOST = 2 * style.MAX_POINTS


def plot_map(
    sheet: Sheet,
    estimates: Mapping[str, Estimate],
    shown: str,
    recording: Recording,
    colours: Mapping[str, str],
    *,
    errors: Mapping[str, Errors],
    held_out: Gnss | None = None,
) -> None:
    """The path of each run over truth and fixes.

    The run `shown` lies on a wide line in the colours of its most probable ground and has ellipses of two
    sigma; its rejected fixes are marked. Thick lines: without GNSS.
    """
    estimate = estimates[shown]
    local = is_local(estimate)
    frame = ("x of the local frame, m", "y of the local frame, m") if local else ("east, m", "north, m")
    plot = sheet.add_map("map", *frame)
    _ground(plot, estimate)
    if local:
        _aligned_reference(plot, estimate, errors.get(shown))
    else:
        _references(plot, recording, held_out, rejected_fixes(estimate))
    rings = ellipses(estimate, ellipse_rows(estimate, sheet.start_ns, sheet.outages))
    if len(rings):
        x, y = _joined(list(rings)).T
        label = f"{ELLIPSE_SIGMAS:g} sigma of position ({shown})"
        plot.glyph("line", {"x": x, "y": y}, label, colours[shown], "line", line_width=0.8, alpha=0.8)
    for name, one in estimates.items():
        _run(sheet, plot, name, one, colours[name], errors.get(name))
    away = np.full(len(estimates), np.nan)
    marks = {"x": away, "y": away, "colour": np.array([colours[name] for name in estimates], dtype=object)}
    plot.glyph("scatter", marks, "", None, "dot", name="cursor marks", size=11, line_color=style.NEUTRAL)
    path = estimate.trajectory.position_m[:, :2]
    known = path[np.isfinite(path).all(axis=1)]
    if len(known):
        plot.dots(known[:1, 0], known[:1, 1], "start", style.TRUTH_ON_ANY, "triangle", 10.0)
        plot.dots(known[-1:, 0], known[-1:, 1], "end", style.TRUTH_ON_ANY, "square", 8.0)


def _run(sheet: Sheet, plot: Plot, name: str, estimate: Estimate, colour: str, errors: Errors | None) -> None:
    """One path, thick where it has no GNSS; its source has time, error and slip for the cursor."""
    path = estimate.trajectory
    rows = style.thin(len(path), MOST)
    t = sheet.seconds(path.t_ns)[rows]
    error = np.full(len(rows), np.nan)
    if errors is not None and len(errors.t_ns):
        known = sheet.seconds(errors.t_ns)
        error = np.interp(t, known, errors.distance_m(), left=np.nan, right=np.nan)
    data = {"x": path.position_m[rows, 0], "y": path.position_m[rows, 1]}
    more = {"t": t, "error": error, "slip": estimate.slip[rows]}
    for outage in sheet.outages:
        inside = path.position_m[outage.covers(path.t_ns, sheet.start_ns)]
        if len(inside):
            plot.line(inside[:, 0], inside[:, 1], name, colour, width=5.0, alpha=0.4)
    plot.glyph("line", data, name, colour, "line", name=f"run {name}", more=more, line_width=1.8)


def _ground(plot: Plot, estimate: Estimate) -> None:
    """A wide line below the path, in the colour of the most probable class."""
    rows = style.thin(len(estimate.trajectory), MOST)
    xy = estimate.trajectory.position_m[rows, :2]
    if len(xy) < 2 or not style.grounds_known(estimate):
        return
    label = estimate.ground()[rows]
    lines: dict[str, list[Array]] = {}
    for first, last in style.runs_of(label):
        lines.setdefault(str(label[first]), []).append(xy[first : last + 1])
    for name, parts in lines.items():
        x, y = _joined(parts).T
        label_text, colour = f"on {style.label_text(name)}", style.terrain_colour(name)
        plot.glyph("line", {"x": x, "y": y}, label_text, colour, "area", line_width=15.0, alpha=0.45)


def _joined(lines: list[Array]) -> Array:
    """Lines (n, 2) as one, interrupted where one ends."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([piece for line in lines for piece in (line, gap)])


def _aligned_reference(plot: Plot, estimate: Estimate, errors: Errors | None) -> None:
    """The reference moved into the local frame, by the inverse of the alignment of the scores."""
    if errors is None:
        return
    here = estimate.trajectory.positions_at(errors.t_ns)[:, :2]
    rows = np.isfinite(here + errors.estimate_m + errors.reference_m).all(axis=1)
    if rows.sum() < 2:
        return
    here, there = here[rows] @ [1.0, 1j], errors.estimate_m[rows] @ [1.0, 1j]
    turn = np.vdot(there - there.mean(), here - here.mean())
    turn = turn / abs(turn) if abs(turn) > 0.0 else 1.0
    moved = (errors.reference_m[rows] @ [1.0, 1j] - there.mean()) * turn + here.mean()
    label = "reference, moved to the start"
    plot.line(moved.real, moved.imag, label, style.TRUTH_ON_ANY, dash="dashed", most=MOST)


def _references(
    plot: Plot, recording: Recording, held_out: Gnss | None, rejected_ns: NDArray[np.int64]
) -> None:
    """Truth, and the fixes used, rejected and held out."""
    truth, gnss = recording.truth, recording.gnss
    held_ns = held_out.t_ns if held_out is not None else np.zeros(0, dtype=np.int64)
    if gnss is not None and len(gnss):
        given = gnss.select((gnss.fix != Fix.NONE) & ~np.isin(gnss.t_ns, held_ns))
        rejected = np.isin(given.t_ns, rejected_ns)
        _fixes(plot, given.enu_m[~rejected], "GNSS used", style.NEUTRAL, "circle", 800)
        _fixes(plot, given.enu_m[rejected], "GNSS rejected", style.HELD_OUT, "x", len(given))
    if held_out is not None:
        _fixes(plot, held_out.enu_m, "GNSS held out", style.HELD_OUT, "ring", 400)
    if truth is not None and recording.truth_holds("position"):
        place = truth.position_m
        plot.line(place[:, 0], place[:, 1], "truth", style.TRUTH_ON_ANY, dash="dashed", most=MOST)


def _fixes(plot: Plot, enu_m: Array, label: str, colour: str, marker: str, most: int) -> None:
    if len(enu_m):
        rows = style.thin(len(enu_m), most)
        plot.dots(
            enu_m[rows, 0], enu_m[rows, 1], label, colour, marker, {"x": 7.0, "circle": 2.5}.get(marker, 5.0)
        )
