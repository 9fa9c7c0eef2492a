"""Maps of the drive, and several runs of one drive over each other."""

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

ELLIPSE_SIGMAS = 2.0
"""Half axes of the ellipses; two dimensions have 1 - exp(-2) = 86 % of their probability inside."""
ELLIPSE_S, MOST_ELLIPSES = 10.0, 60
"""Seconds between ellipses; longer drives get at most so many, outside and inside outages."""


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
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    fig, ax = style.canvas(ax, _map_size([estimate]))
    local = is_local(estimate)
    if local:
        handles = _draw_moved(ax, estimate, errors)
    else:
        handles = draw_references(ax, recording, held_out, refused_fixes(estimate))
    path = estimate.trajectory
    keep = style.thin(len(path), 2 * style.MAX_POINTS)
    xy = path.position_m[keep, :2]
    handles += _edge_outages(ax, estimate, recording.start_ns, outages)
    if len(xy) > 1 and estimate.classes:
        label = estimate.dominant_terrain()[keep]
        lines, colours = [], []
        for first, last in style.runs_of(label):
            lines.append(xy[first : last + 1])
            colours.append(style.colour_of(str(label[first]), style.TERRAIN_COLOURS))
        ax.add_collection(LineCollection(lines, colors=colours, linewidths=3.2, zorder=4))
        for name in dict.fromkeys(label.tolist()):
            colour = style.colour_of(str(name), style.TERRAIN_COLOURS)
            handles.append(Line2D([], [], color=colour, linewidth=3, label=f"on {style.plain(name)}"))
    elif len(xy):
        handles += ax.plot(xy[:, 0], xy[:, 1], color="#0072b2", linewidth=2.0, label="estimate")
    handles += _draw_ellipses(ax, ellipses(estimate, ellipse_rows(estimate, recording.start_ns, outages)))
    if len(xy):
        handles += ax.plot(
            *xy[0], "^", color="#111111", markersize=8, zorder=6, label="start", linestyle="none"
        )
        handles += ax.plot(
            *xy[-1], "s", color="#111111", markersize=6, zorder=6, label="end", linestyle="none"
        )
    _frame(ax)
    if local:
        style.dress(ax, x="x of the local frame, m", y="y of the local frame, m")
    _side_legend(ax, handles)
    return fig, ax


def plot_map_runs(
    estimates: Mapping[str, Estimate],
    recording: Recording,
    *,
    colours: Mapping[str, str] | None = None,
    held_out: Gnss | None = None,
    outages: Sequence[Outage] = (),
    ax: Axes | None = None,
) -> tuple[Figure, Axes]:
    """The paths of several runs, by name, over truth and GNSS fixes; thick where a run has no GNSS."""
    fig, ax = style.canvas(ax, _map_size(list(estimates.values())))
    handles = draw_references(ax, recording, held_out)
    for name, estimate in estimates.items():
        colour = (colours or {}).get(name) or style.colour_of(name, style.MODE_COLOURS)
        path = estimate.trajectory
        xy = path.position_m[style.thin(len(path), 2 * style.MAX_POINTS), :2]
        handles += ax.plot(xy[:, 0], xy[:, 1], color=colour, linewidth=1.4, zorder=5, label=style.plain(name))
        for outage in outages:
            rows = np.flatnonzero(outage.covers(path.t_ns, recording.start_ns))
            inside = path.position_m[rows[style.thin(len(rows))], :2]
            ax.plot(inside[:, 0], inside[:, 1], color=colour, linewidth=4.0, alpha=0.45, zorder=4)
            if len(inside):
                ax.plot(*inside[-1], "o", color=colour, markersize=6, markeredgecolor="white", zorder=6)
    if outages:
        from matplotlib.lines import Line2D

        handles.append(
            Line2D([], [], color="#777777", linewidth=4, alpha=0.5, label="no GNSS (dot: its end)")
        )
    _frame(ax)
    _side_legend(ax, handles)
    return fig, ax


def plot_error_runs(
    errors: Mapping[str, Errors],
    start_ns: int,
    *,
    colours: Mapping[str, str] | None = None,
    outages: Sequence[Outage] = (),
    ax: Axes | None = None,
) -> tuple[Figure, Axes]:
    """Size of the horizontal position error of several runs, by name, over time."""
    fig, ax = style.canvas(ax, (9.0, 3.0))
    shade_outages(ax, outages)
    for name, series in errors.items():
        colour = (colours or {}).get(name) or style.colour_of(name, style.MODE_COLOURS)
        distance = series.distance_m()
        peak = [int(np.nanargmax(distance))] if np.isfinite(distance).any() else []
        keep = style.thin(len(distance), keep=peak)
        t = style.seconds(series.t_ns, start_ns)[keep]
        ax.plot(t, distance[keep], color=colour, linewidth=1.2, label=style.plain(name))
    ax.set_ylim(bottom=0.0)
    style.dress(ax, x=TIME, y="position error, m")
    style.legend_above(ax)
    return fig, ax


def _draw_moved(ax: Axes, estimate: Estimate, errors: Errors | None) -> list[Any]:
    """The reference in the local frame: scoring moved the path onto it, and this moves it back."""
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
    moved = moved[style.thin(len(moved), 2 * style.MAX_POINTS)]
    dashes, label = (0, (4, 3)), "reference, moved to the start"
    return ax.plot(
        moved.real, moved.imag, color=style.TRUTH, linewidth=0.8, linestyle=dashes, zorder=7, label=label
    )


def refused_fixes(estimate: Estimate) -> TimesNs:
    """Times (N,) of the fixes whose position a gate turned away."""
    return np.array(
        [i.t_ns for i in estimate.innovations if i.sensor == "gnss" and not i.accepted], dtype=np.int64
    )


def ellipse_rows(estimate: Estimate, start_ns: int, outages: Sequence[Outage]) -> NDArray[np.int64]:
    """Keyframes that get an ellipse: one in ten seconds, one in two seconds where there is no GNSS.

    Without GNSS is what the caller left out and what the estimate's status says. The last of each
    such stretch is among them: there the position is the least sure.
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


def draw_references(
    ax: Axes, recording: Recording, held_out: Gnss | None, refused_ns: TimesNs | None = None
) -> list[Any]:
    """Truth, the fixes used, turned away and kept back; returns the legend's handles."""
    handles: list[Any] = []
    truth, gnss = recording.truth, recording.gnss
    if truth is not None and len(truth) and ("position" in (recording.truth_channels or ("position",))):
        xy = truth.position_m[style.thin(len(truth), 2 * style.MAX_POINTS), :2]
        handles += ax.plot(
            xy[:, 0],
            xy[:, 1],
            color=style.TRUTH,
            linewidth=0.8,
            linestyle=(0, (4, 3)),
            zorder=7,
            label="truth",
        )
    kept_ns = held_out.t_ns if held_out is not None else np.zeros(0, dtype=np.int64)
    if gnss is not None and len(gnss):
        given = gnss.select((gnss.fix != Fix.NONE) & ~np.isin(gnss.t_ns, kept_ns))
        refused = np.isin(given.t_ns, refused_ns if refused_ns is not None else [])
        used, away = given.select(~refused), given.select(refused).enu_m
        if len(away):
            handles += ax.plot(
                away[:, 0],
                away[:, 1],
                "x",
                color="#111111",
                markersize=5,
                zorder=6,
                label="GNSS rejected",
                linestyle="none",
            )
        xy = used.enu_m[style.thin(len(used), 800), :2]
        handles += ax.plot(
            xy[:, 0],
            xy[:, 1],
            ".",
            color="#9a9a9a",
            markersize=4,
            zorder=2,
            label="GNSS used",
            linestyle="none",
        )
    if held_out is not None and len(held_out):
        xy = held_out.enu_m[style.thin(len(held_out), 400), :2]
        handles += ax.plot(
            xy[:, 0],
            xy[:, 1],
            "o",
            markerfacecolor="none",
            color=style.HELD_OUT,
            markersize=4,
            markeredgewidth=0.8,
            zorder=3,
            label="GNSS kept back",
            linestyle="none",
        )
    return handles


def _edge_outages(ax: Axes, estimate: Estimate, start_ns: int, outages: Sequence[Outage]) -> list[Any]:
    handles: list[Any] = []
    path = estimate.trajectory
    for outage in outages:
        rows = np.flatnonzero(outage.covers(path.t_ns, start_ns))
        xy = path.position_m[rows[style.thin(len(rows))], :2]
        line = ax.plot(
            xy[:, 0],
            xy[:, 1],
            color="#f4a582",
            linewidth=7.0,
            alpha=0.8,
            zorder=3.5,
            label="no GNSS",
            solid_capstyle="round",
        )
        handles = handles or list(line)
    return handles


def ellipses(estimate: Estimate, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Ellipses (K, 41, 2) of the position, m, at those of the keyframes `rows` whose covariance is known."""
    path = estimate.trajectory
    if path.covariance is None:
        return np.zeros((0, 41, 2))
    P = path.covariance[rows, :2, :2]
    sound = np.isfinite(P).all(axis=(1, 2)) & np.isfinite(path.position_m[rows, :2]).all(axis=1)
    size, axes = np.linalg.eigh(P[sound])
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = ring * ELLIPSE_SIGMAS * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    return np.asarray(np.einsum("kij,knj->kni", axes, points) + path.position_m[rows[sound], None, :2])


def _draw_ellipses(ax: Axes, rings: NDArray[np.float64]) -> list[Any]:
    label = f"{ELLIPSE_SIGMAS:g} sigma of position"
    lines = [
        ax.plot(*ring.T, color="#0072b2", linewidth=0.7, alpha=0.8, zorder=5, label=label)[0]
        for ring in rings
    ]
    return lines[:1]


def _map_size(estimates: Sequence[Estimate]) -> tuple[float, float]:
    """Figure size, inches, that suits the extent of the drive: a long straight one gets a low map."""
    points = np.concatenate([e.trajectory.position_m[:, :2] for e in estimates] or [np.zeros((0, 2))])
    points = points[np.isfinite(points).all(axis=1)]
    width, height = np.ptp(points, axis=0) if len(points) else (1.0, 1.0)
    return 9.0, float(np.clip(7.0 * height / max(width, 1e-3), 2.2, 6.0)) + 0.7


def _frame(ax: Axes) -> None:
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.05)
    ax.autoscale_view()
    style.dress(ax, x="east, m", y="north, m")


def _side_legend(ax: Axes, handles: Sequence[Any]) -> None:
    if handles:
        ax.legend(
            handles=list(handles), loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8
        )
