"""Maps of a drive, and several runs of one drive compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.outputs.replay_files import is_local
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.replay import TIME, shade_outages

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TimesNs = NDArray[np.int64]
Array = NDArray[np.float64]

ELLIPSE_SIGMAS = 2.0
"""Half axes of the ellipses; two dimensions have 1 - exp(-2) = 86 % of their probability inside."""
ELLIPSE_S, MOST_ELLIPSES = 10.0, 60
"""Seconds between ellipses; longer drives get at most so many, outside and inside outages."""
_DASHES = (0, (4, 3))
_ESTIMATE = "#0072b2"


def plot_map(
    estimate: Estimate,
    recording: Recording,
    *,
    errors: Errors | None = None,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
    ax: Axes | None = None,
) -> tuple[Figure, Axes]:
    """The path coloured by terrain with ellipses of two sigma, over truth and fixes; outages are edged."""
    fig, ax = style.canvas(ax, _map_size([estimate]))
    path = estimate.trajectory
    local = is_local(estimate)
    if local:
        handles = _draw_aligned_reference(ax, estimate, errors)
    else:
        handles = _draw_references(ax, recording, held_out, rejected_fixes(estimate))
    for i, outage in enumerate(outages):
        rows = np.flatnonzero(outage.covers(path.t_ns, recording.start_ns))
        edge: dict[str, Any] = {"color": "#f4a582", "linewidth": 7.0, "alpha": 0.8, "zorder": 3.5}
        drawn = _draw(ax, path.position_m[rows], "-", "no GNSS", solid_capstyle="round", **edge)
        handles += drawn if i == 0 else []
    handles += _draw_path(ax, estimate)
    rings = ellipses(estimate, ellipse_rows(estimate, recording.start_ns, outages))
    for i, ring in enumerate(rings):
        label = f"{ELLIPSE_SIGMAS:g} sigma of position"
        drawn = ax.plot(*ring.T, color=_ESTIMATE, linewidth=0.7, alpha=0.8, zorder=5, label=label)
        handles += drawn if i == 0 else []
    if len(path):
        ends: dict[str, Any] = {"color": "#111111", "zorder": 6, "linestyle": "none"}
        keep = style.thin(len(path), 2 * style.MAX_POINTS)
        xy = path.position_m[keep, :2]
        handles += ax.plot(*xy[0], "^", markersize=8, label="start", **ends)
        handles += ax.plot(*xy[-1], "s", markersize=6, label="end", **ends)
    frame = "of the local frame, m"
    _finish(ax, handles, *((f"x {frame}", f"y {frame}") if local else ()))
    return fig, ax


def plot_map_runs(
    estimates: Mapping[str, Estimate],
    recording: Recording,
    *,
    colours: Mapping[str, str] | None = None,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
) -> Figure:
    """The paths of several runs, by name, over truth and GNSS fixes; thick where a run has no GNSS."""
    from matplotlib.lines import Line2D

    fig, ax = style.canvas(None, _map_size(list(estimates.values())))
    handles = _draw_references(ax, recording, held_out)
    for name, estimate in estimates.items():
        colour = (colours or {}).get(name) or style.colour_of(name, style.MODE_COLOURS)
        path = estimate.trajectory
        label = style.label_text(name)
        most = 2 * style.MAX_POINTS
        handles += _draw(ax, path.position_m, "-", label, most, color=colour, linewidth=1.4, zorder=5)
        for outage in outages:
            inside = path.position_m[outage.covers(path.t_ns, recording.start_ns)]
            _draw(ax, inside, "-", color=colour, linewidth=4.0, alpha=0.45, zorder=4)
            _draw(ax, inside[-1:], "o", color=colour, markersize=6, markeredgecolor="white", zorder=6)
    if outages:
        label = "no GNSS (dot: its end)"
        handles.append(Line2D([], [], color="#777777", linewidth=4, alpha=0.5, label=label))
    _finish(ax, handles)
    return fig


def plot_error_runs(
    errors: Mapping[str, Errors],
    start_ns: int,
    *,
    colours: Mapping[str, str] | None = None,
    outages: Sequence[Outage] = (),
) -> Figure:
    """Horizontal position error of several runs, by name, over time."""
    fig, ax = style.canvas(None, (9.0, 3.0))
    shade_outages(ax, outages)
    for name, series in errors.items():
        colour = (colours or {}).get(name) or style.colour_of(name, style.MODE_COLOURS)
        distance = series.distance_m()
        peak = [int(np.nanargmax(distance))] if np.isfinite(distance).any() else []
        rows = style.thin(len(distance), keep=peak)
        t = style.seconds(series.t_ns, start_ns)[rows]
        ax.plot(t, distance[rows], color=colour, linewidth=1.2, label=style.label_text(name))
    ax.set_ylim(bottom=0.0)
    style.format_axes(ax, x=TIME, y="position error, m")
    style.legend_above(ax)
    return fig


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


def _draw(
    ax: Axes, xyz: Array, form: str, label: str | None = None, most: int = style.MAX_POINTS, **options: Any
) -> list[Any]:
    xy = xyz[style.thin(len(xyz), most), :2]
    return ax.plot(xy[:, 0], xy[:, 1], *filter(None, [form]), label=label, **options)


def _draw_path(ax: Axes, estimate: Estimate) -> list[Any]:
    """The path, coloured by the most probable terrain where there are classes; returns the handles."""
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    keep = style.thin(len(estimate.trajectory), 2 * style.MAX_POINTS)
    xy = estimate.trajectory.position_m[keep, :2]
    if not len(xy):
        return []
    if len(xy) < 2 or not estimate.classes:
        return ax.plot(xy[:, 0], xy[:, 1], color=_ESTIMATE, linewidth=2.0, label="estimate")
    label = estimate.dominant_terrain()[keep]
    runs = style.runs_of(label)
    colours = [style.terrain_colour(label[first]) for first, _ in runs]
    lines = [xy[first : last + 1] for first, last in runs]
    ax.add_collection(LineCollection(lines, colors=colours, linewidths=3.2, zorder=4))
    names = dict.fromkeys(label.tolist())
    return [
        Line2D([], [], color=style.terrain_colour(name), linewidth=3, label=f"on {style.label_text(name)}")
        for name in names
    ]


def _draw_aligned_reference(ax: Axes, estimate: Estimate, errors: Errors | None) -> list[Any]:
    """The reference moved into the local frame, by the inverse of the alignment of the scores."""
    if errors is None:
        return []
    here = estimate.trajectory.positions_at(errors.t_ns)[:, :2]
    rows = np.isfinite(here + errors.estimate_m + errors.reference_m).all(axis=1)
    if rows.sum() < 2:
        return []
    here, there = here[rows] @ [1.0, 1j], errors.estimate_m[rows] @ [1.0, 1j]
    turn = np.vdot(there - there.mean(), here - here.mean())
    turn = turn / abs(turn) if abs(turn) > 0.0 else 1.0
    moved = (errors.reference_m[rows] @ [1.0, 1j] - there.mean()) * turn + here.mean()
    xy = np.column_stack([moved.real, moved.imag])
    look: dict[str, Any] = {"color": style.TRUTH, "linewidth": 0.8, "linestyle": _DASHES, "zorder": 7}
    return _draw(ax, xy, "", "reference, moved to the start", 2 * style.MAX_POINTS, **look)


def _draw_references(
    ax: Axes, recording: Recording, held_out: Gnss | None, rejected_ns: TimesNs | None = None
) -> list[Any]:
    """Truth, and the fixes used, rejected and held out; returns the legend's handles."""
    handles: list[Any] = []
    truth, gnss = recording.truth, recording.gnss
    if truth is not None and len(truth) and "position" in (recording.truth_channels or ("position",)):
        look: dict[str, Any] = {"color": style.TRUTH, "linewidth": 0.8, "linestyle": _DASHES, "zorder": 7}
        handles += _draw(ax, truth.position_m, "", "truth", 2 * style.MAX_POINTS, **look)
    held_ns = held_out.t_ns if held_out is not None else np.zeros(0, dtype=np.int64)
    if gnss is not None and len(gnss):
        given = gnss.select((gnss.fix != Fix.NONE) & ~np.isin(gnss.t_ns, held_ns))
        rejected = np.isin(given.t_ns, rejected_ns if rejected_ns is not None else [])
        if rejected.any():
            away = given.enu_m[rejected]
            handles += _draw(
                ax, away, "x", "GNSS rejected", len(away), color="#111111", markersize=5, zorder=6
            )
        used = given.enu_m[~rejected]
        handles += _draw(ax, used, ".", "GNSS used", 800, color="#9a9a9a", markersize=4, zorder=2)
    if held_out is not None and len(held_out):
        ring: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 0.8, "markersize": 4}
        colour = style.HELD_OUT
        handles += _draw(ax, held_out.enu_m, "o", "GNSS held out", 400, color=colour, zorder=3, **ring)
    return handles


def _map_size(estimates: Sequence[Estimate]) -> tuple[float, float]:
    """Figure size, inches, that suits the extent of the drive: a long straight one gets a low map."""
    points = np.concatenate([e.trajectory.position_m[:, :2] for e in estimates] or [np.zeros((0, 2))])
    points = points[np.isfinite(points).all(axis=1)]
    width, height = np.ptp(points, axis=0) if len(points) else (1.0, 1.0)
    return 9.0, float(np.clip(7.0 * height / max(width, 1e-3), 2.2, 6.0)) + 0.7


def _finish(ax: Axes, handles: list[Any], x: str = "east, m", y: str = "north, m") -> None:
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.05)
    ax.autoscale_view()
    style.format_axes(ax, x=x, y=y)
    if handles:
        corner = (1.0, 1.0)
        ax.legend(handles=handles, loc="upper left", bbox_to_anchor=corner, frameon=False, fontsize=8)
