"""Plots of one estimate over time: errors, slip, terrain, weights, speeds.

Every function draws into the axes it is given, or into new ones, and returns
the figure and the axes. Times are seconds from `start_ns`, the start of the
recording. Maps and comparisons of runs are in `plots_map`, what the filter
says of itself is in `plots_filter`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate, WeightChange
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
TIME = "time from the start, s"


def plot_errors(
    errors: Errors, start_ns: int, *, outages: Sequence[Outage] = (), axes: Sequence[Axes] | None = None
) -> tuple[Figure, NDArray[Any]]:
    """East, north and heading error (the last in degrees) with the band of two sigma the estimate claims."""
    has_yaw = bool(np.isfinite(errors.reference_yaw_rad).any())
    fig, panels = style.canvases(axes, 2 + has_yaw, (9.0, 1.7 * (2 + has_yaw) + 0.4))
    t = style.seconds(errors.t_ns, start_ns)
    error, P = errors.position_error_m(), errors.covariance_m2
    rows = [("east, m", error[:, 0], np.sqrt(P[:, 0, 0])), ("north, m", error[:, 1], np.sqrt(P[:, 1, 1]))]
    if has_yaw:
        rows.append(("heading, deg", np.degrees(errors.yaw_error_rad()), np.degrees(errors.yaw_sigma_rad)))
    keep = style.thin(len(t))
    for ax, (label, value, sigma) in zip(panels, rows, strict=True):
        ax.fill_between(
            t[keep],
            -2 * sigma[keep],
            2 * sigma[keep],
            color="#6baed6",
            alpha=0.35,
            linewidth=0,
            label="claimed ±2 sigma",
        )
        ax.plot(t[keep], value[keep], color=style.SENSOR_COLOURS["gnss"], linewidth=1.0, label="error")
        ax.set_ylim(*_error_limits(value, sigma))
        shade_outages(ax, outages)
        style.dress(ax, y=label)
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_slip(
    estimate: Estimate, start_ns: int, *, outages: Sequence[Outage] = (), ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Estimated slip with its band of two sigma, over the most probable terrain."""
    fig, ax = style.canvas(ax, (9.0, 2.9))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    keep = style.thin(len(t))
    s, sigma = estimate.slip[keep], estimate.slip_sigma[keep]
    patches = shade_terrain(ax, estimate, start_ns)
    ax.fill_between(t[keep], s - 2 * sigma, s + 2 * sigma, color="#0072b2", alpha=0.3, linewidth=0)
    ax.plot(t[keep], s, color="#003f6b", linewidth=1.1)
    mark_outages(ax, outages)
    band = np.concatenate([s - 2 * sigma, s + 2 * sigma])
    low, high = style.robust_limits(band, include=(0.0, 0.1))
    ax.set_ylim(max(low, -1.2), min(high, 1.2))
    if len(t):
        ax.set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    style.dress(ax, x=TIME, y="slip (1 - v / wheel speed)")
    style.legend_above(ax, handles=patches)
    return fig, ax


def plot_terrain(
    estimate: Estimate, start_ns: int, *, recording: Recording | None = None, ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Probabilities of the terrain classes, stacked; a strip on top shows the label of the log, if any."""
    fig, ax = style.canvas(ax, (9.0, 2.7))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    keep = style.thin(len(t))
    p = np.nan_to_num(estimate.terrain[keep])
    shown = [i for i in range(len(estimate.classes)) if p[:, i].max(initial=0.0) > 0.01]
    if len(shown) and len(keep):
        ax.stackplot(
            t[keep],
            *(p[:, i] for i in shown),
            colors=[style.colour_of(estimate.classes[i], style.TERRAIN_COLOURS) for i in shown],
            labels=[style.plain(estimate.classes[i]) for i in shown],
            linewidth=0,
        )
        ax.set_xlim(t[keep][0], max(t[keep][-1], t[keep][0] + 1e-3))
    top = 1.0
    if recording is not None and recording.terrain is not None and len(recording.terrain):
        _label_strip(ax, recording, t[-1] if len(t) else recording.duration_s())
        top = 1.16
    ax.set_ylim(0.0, top)
    ax.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    style.dress(ax, x=TIME, y="probability")
    style.legend_above(ax)
    return fig, ax


def plot_weights(
    estimate: Estimate,
    start_ns: int,
    *,
    marked: Sequence[WeightChange] = (),
    axes: Sequence[Axes] | None = None,
) -> tuple[Figure, NDArray[Any]]:
    """The noise in force for each sensor (log scale); the moments of `marked` are numbered from 1."""
    fig, panels = style.canvases(axes, 2, (9.0, 4.2))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    keep = style.thin(len(t))
    for ax, rows, label in zip(panels, _WEIGHTS, ("1 sigma", "times data sheet"), strict=True):
        for name, text, sensor, dashes in rows:
            if name in estimate.weights:
                colour = style.colour_of(sensor, style.SENSOR_COLOURS)
                values = np.maximum(estimate.weights[name][keep], 1e-6)
                ax.plot(t[keep], values, color=colour, linestyle=dashes, linewidth=1.3, label=text)
        ax.set_yscale("log")
        _plain_log_ticks(ax)
        style.dress(ax, y=label)
        style.legend_above(ax)
        ax.margins(x=0.01)
        for t_ns in moments(marked):
            ax.axvline((t_ns - start_ns) * 1e-9, color="#888888", linewidth=0.6, linestyle=":")
    _number_marks(panels[1], [(t_ns - start_ns) * 1e-9 for t_ns in moments(marked)])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig, panels


def plot_speeds(
    estimate: Estimate,
    recording: Recording,
    *,
    wheel_radius_m: float | None = None,
    outages: Sequence[Outage] = (),
    ax: Axes | None = None,
) -> tuple[Figure, Axes]:
    """Speed the wheels show, speed estimated, and speed from GNSS and truth where they have it."""
    fig, ax = style.canvas(ax, (9.0, 2.9))
    start = recording.start_ns
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth
    if wheels is not None and len(wheels) and (wheels.unit == "mps" or wheel_radius_m is not None):
        speed = wheels.side_speeds_mps(wheel_radius_m or 1.0).mean(axis=1)
        _line(ax, wheels.t_ns, speed, start, style.SENSOR_COLOURS["wheels"], "wheels", 0.8)
    if gnss is not None and gnss.velocity_enu_mps is not None:
        speed = np.hypot(gnss.velocity_enu_mps[:, 0], gnss.velocity_enu_mps[:, 1])
        keep = style.thin(len(gnss))
        ax.plot(
            style.seconds(gnss.t_ns, start)[keep],
            speed[keep],
            ".",
            color=style.SENSOR_COLOURS["gnss_velocity"],
            markersize=3,
            label="GNSS (no sign)",
        )
    listed = recording.truth_channels
    if truth is not None and truth.twist_body is not None and (not listed or "velocity" in listed):
        _line(ax, truth.t_ns, truth.twist_body[:, 0], start, style.TRUTH, "truth", 1.8, alpha=0.35)
    path = estimate.trajectory
    forward = (
        path.twist_body[:, 0]
        if path.twist_body is not None
        else np.linalg.norm(estimate.velocity_mps[:, :2], axis=1)
    )
    _line(ax, path.t_ns, forward, start, style.SENSOR_COLOURS["gnss"], "estimate", 1.1)
    shade_outages(ax, outages)
    style.dress(ax, x=TIME, y="forward speed, m/s")
    style.legend_above(ax)
    return fig, ax


def important_changes(
    changes: Sequence[WeightChange], most: int = 12, apart_s: float = 2.0
) -> list[WeightChange]:
    """The `most` largest changes by ratio, in order of time, their moments `apart_s` from each other."""

    def size(change: WeightChange) -> float:
        low, high = sorted((abs(change.before), abs(change.after)))
        ratio = high / low if low > 0.0 else 1e6 if high > 0.0 else 1.0
        return ratio if np.isfinite(ratio) else 1e6

    chosen: list[WeightChange] = []
    for change in sorted(changes, key=lambda c: (-size(c), c.t_ns, c.sensor)):
        if len(chosen) == most:
            break
        gaps = [abs(c.t_ns - change.t_ns) for c in chosen]
        if all(gap == 0 or gap > apart_s * 1e9 for gap in gaps):
            chosen.append(change)
    return sorted(chosen, key=lambda c: c.t_ns)


def moments(changes: Sequence[WeightChange]) -> dict[int, int]:
    """The times of changes that are in order, each with its number from 1."""
    return {t_ns: number for number, t_ns in enumerate(dict.fromkeys(c.t_ns for c in changes), 1)}


def shade_outages(ax: Axes, outages: Sequence[Outage]) -> None:
    """Shade the stretches without GNSS; they are named once in the legend."""
    for i, outage in enumerate(outages):
        label = "no GNSS" if i == 0 else None
        end = outage.start_s + outage.seconds
        ax.axvspan(outage.start_s, end, color=style.OUTAGE, zorder=0, linewidth=0, label=label)


def mark_outages(ax: Axes, outages: Sequence[Outage]) -> None:
    """Mark the stretches without GNSS by a bar at the foot, where the background is taken."""
    foot = ax.get_xaxis_transform()
    for outage in outages:
        x = (outage.start_s, outage.start_s + outage.seconds)
        ax.plot(x, (0.02, 0.02), transform=foot, color=style.HELD_OUT, linewidth=4, solid_capstyle="butt")
        text = ax.text(x[0], 0.05, "no GNSS", transform=foot, fontsize=7, color=style.HELD_OUT, clip_on=True)
        text.set_in_layout(False)


def shade_terrain(ax: Axes, estimate: Estimate, start_ns: int) -> list[Any]:
    """Colour the background by the most probable class; returns the legend's patches."""
    from matplotlib.patches import Patch

    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    if not len(t) or not estimate.classes:
        return []
    rows = style.thin(len(t), 600)
    label, t = estimate.dominant_terrain()[rows], t[rows]
    seen: dict[str, Any] = {}
    for first, last in style.runs_of(label):
        name = str(label[first])
        colour = style.colour_of(name, style.TERRAIN_COLOURS)
        end = t[last] if last < len(t) else t[-1]
        ax.axvspan(t[first], end, color=colour, alpha=0.3, linewidth=0, zorder=0)
        seen.setdefault(name, Patch(color=colour, alpha=0.4, linewidth=0, label=style.plain(name)))
    return list(seen.values())


_WEIGHTS = (
    (
        ("wheel_sigma_mps", "wheel speed, m/s", "wheels", "-"),
        ("slip_sigma", "slip", "slip", "-"),
        ("side_slip_sigma", "side-slip", "side_slip", "--"),
    ),
    (
        ("gyro_inflation", "gyro", "gyro", "-"),
        ("gyro_yaw_inflation", "gyro, yaw", "gyro", ":"),
        ("accel_inflation", "accelerometer", "accel", "--"),
        ("gnss_inflation", "GNSS", "gnss", "-"),
    ),
)


def _line(
    ax: Axes,
    t_ns: NDArray[np.int64],
    values: Array,
    start_ns: int,
    colour: str,
    label: str,
    width: float,
    alpha: float = 1.0,
) -> None:
    keep = style.thin(len(t_ns))
    t = style.seconds(t_ns, start_ns)[keep]
    ax.plot(t, values[keep], color=colour, linewidth=width, label=label, alpha=alpha)


def _label_strip(ax: Axes, recording: Recording, end_s: float) -> None:
    terrain = recording.terrain
    assert terrain is not None
    t = style.seconds(terrain.t_ns, recording.start_ns)
    for first, last in style.runs_of(terrain.label):
        stop = t[last] if last < len(t) else max(end_s, t[-1])
        colour = style.colour_of(str(terrain.label[first]), style.TERRAIN_COLOURS)
        ax.fill_between([t[first], stop], 1.05, 1.15, color=colour, linewidth=0)
    ax.text(
        1.005,
        1.10 / 1.16,
        f"{style.plain(terrain.source, 14)}",
        transform=ax.transAxes,
        fontsize=7,
        va="center",
    )


def _number_marks(ax: Axes, times_s: Sequence[float]) -> None:
    """Numbers 1, 2, ... below the top edge, in two heights so that neighbours do not cover each other."""
    for i, t in enumerate(times_s):
        ax.annotate(
            str(i + 1),
            (t, 0.93 if i % 2 == 0 else 0.82),
            xycoords=("data", "axes fraction"),
            fontsize=7,
            ha="center",
            va="center",
            bbox={
                "boxstyle": "round,pad=0.15",
                "facecolor": "white",
                "edgecolor": "#888888",
                "linewidth": 0.5,
            },
        )


def _plain_log_ticks(ax: Axes) -> None:
    """0.01, 0.1, 1, 10 instead of powers; 2 and 5 between them where the axis spans little."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = ax.get_ylim()
    wide = low > 0.0 and np.log10(high / low) > 2.5
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _error_limits(error: Array, sigma: Array) -> tuple[float, float]:
    """Limits that hold every error, and the band too unless it is far wider than the errors."""
    finite = error[np.isfinite(error)]
    low, high = (finite.min(), finite.max()) if len(finite) else (-1.0, 1.0)
    known = sigma[np.isfinite(sigma)]
    band = 2.2 * float(np.percentile(known, 90.0)) if len(known) else 0.0
    band = min(band, 3.0 * max(abs(low), abs(high), 1e-3))
    low, high = min(low, -band), max(high, band)
    room = 0.05 * (high - low)
    return float(low - room), float(high + room)
