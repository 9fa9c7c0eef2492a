"""Plots of one estimate over time: errors, slip, terrain, weights, speeds, skid steering.

Times are seconds from `start_ns`, the start of the recording. Maps and comparisons of runs are in
`replay_map`, innovations and biases in `replay_filter`.
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
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
TIME = "time from the start, s"
_GNSS = style.SENSOR_COLOURS["gnss"]
_SIGMAS = (
    ("wheel_sigma_mps", "wheel speed, m/s", "wheels", "-"),
    ("slip_sigma", "slip", "slip", "-"),
    ("side_slip_sigma", "side-slip", "side_slip", "--"),
)
_FACTORS = (
    ("gyro_inflation", "gyro", "gyro", "-"),
    ("gyro_yaw_inflation", "gyro, yaw", "gyro", ":"),
    ("accel_inflation", "accelerometer", "accel", "--"),
    ("gnss_inflation", "GNSS", "gnss", "-"),
)
"""Weight of the policy file, its label, sensor and dashes."""
_SKID_STEERING = (
    ("yaw_scale", "yaw scale", "#0072b2"),
    ("side_slip", "side-slip", "#d55e00"),
    ("icr_x_m", "centre of\nrotation, m", "#009e73"),
)


def plot_errors(errors: Errors, start_ns: int, *, outages: Sequence[Outage] = ()) -> Figure:
    """East, north and heading error (deg) with the estimated band of two sigma."""
    t = style.seconds(errors.t_ns, start_ns)
    error, P = errors.position_error_m(), errors.covariance_m2
    rows = [("east, m", error[:, 0], np.sqrt(P[:, 0, 0])), ("north, m", error[:, 1], np.sqrt(P[:, 1, 1]))]
    if np.isfinite(errors.reference_yaw_rad).any():
        rows.append(("heading, deg", np.degrees(errors.yaw_error_rad()), np.degrees(errors.yaw_sigma_rad)))
    fig, axes = style.canvases(len(rows), (9.0, 1.7 * len(rows) + 0.4))
    for ax, (label, value, sigma) in zip(axes, rows, strict=True):
        style.band(ax, t, np.zeros(len(t)), sigma, "#6baed6", alpha=0.35, label="estimated ±2 sigma")
        style.line(ax, t, value, _GNSS, "error", linewidth=1.0)
        ax.set_ylim(*_error_limits(value, sigma))
        shade_outages(ax, outages)
        style.format_axes(ax, y=label)
    style.legend_above(axes[0])
    axes[-1].set_xlabel(TIME, fontsize=9)
    return fig


def plot_slip(
    estimate: Estimate, start_ns: int, *, outages: Sequence[Outage] = (), ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Estimated slip with its band of two sigma, over the most probable terrain."""
    fig, ax = style.canvas(ax, (9.0, 2.9))
    t, s, sigma = style.seconds(estimate.trajectory.t_ns, start_ns), estimate.slip, estimate.slip_sigma
    patches = _shade_terrain(ax, estimate, t)
    style.band(ax, t, s, sigma, "#0072b2", alpha=0.3)
    style.line(ax, t, s, "#003f6b", linewidth=1.1)
    _mark_outages(ax, outages)
    rows = style.thin(len(t))
    edges = np.concatenate([(s - 2 * sigma)[rows], (s + 2 * sigma)[rows]])
    low, high = style.robust_limits(edges, include=(0.0, 0.1))
    ax.set_ylim(max(low, -1.2), min(high, 1.2))
    if len(t):
        ax.set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    style.format_axes(ax, x=TIME, y="slip (1 - v / wheel speed)")
    style.legend_above(ax, handles=patches)
    return fig, ax


def plot_terrain(
    estimate: Estimate, start_ns: int, *, recording: Recording | None = None, ax: Axes | None = None
) -> tuple[Figure, Axes]:
    """Probabilities of the terrain classes, stacked; a strip on top shows the label of the log, if any."""
    fig, ax = style.canvas(ax, (9.0, 2.7))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    rows = style.thin(len(t))
    p = np.nan_to_num(estimate.terrain[rows])
    shown = [i for i in range(len(estimate.classes)) if p[:, i].max(initial=0.0) > 0.01]
    if shown and len(rows):
        names = [estimate.classes[i] for i in shown]
        colours, labels = map(style.terrain_colour, names), map(style.label_text, names)
        ax.stackplot(t[rows], *p[:, shown].T, colors=list(colours), labels=list(labels), linewidth=0)
        ax.set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    top = 1.0
    if recording is not None and recording.terrain is not None and len(recording.terrain):
        _label_strip(ax, recording, t[-1] if len(t) else recording.duration_s())
        top = 1.16
    ax.set_ylim(0.0, top)
    ax.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    style.format_axes(ax, x=TIME, y="probability")
    style.legend_above(ax)
    return fig, ax


def plot_weights(estimate: Estimate, start_ns: int, *, marked: Sequence[WeightChange] = ()) -> Figure:
    """Noise of each sensor (log scale); the times of the changes `marked` are numbered from 1."""
    fig, axes = style.canvases(2, (9.0, 4.2))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    marks = [(t_ns - start_ns) * 1e-9 for t_ns in change_numbers(marked)]
    for ax, weights, label in zip(axes, (_SIGMAS, _FACTORS), ("1 sigma", "times data sheet"), strict=True):
        for name, text, sensor, dashes in weights:
            if name in estimate.weights:
                colour = style.colour_of(sensor, style.SENSOR_COLOURS)
                values = np.maximum(estimate.weights[name], 1e-6)
                style.line(ax, t, values, colour, text, linestyle=dashes, linewidth=1.3)
        ax.set_yscale("log")
        low, high = ax.get_ylim()
        wide = low > 0.0 and np.log10(high / low) > 2.5
        style.plain_log_ticks(ax.yaxis, (1.0,) if wide else (1.0, 2.0, 5.0))
        style.format_axes(ax, y=label)
        style.legend_above(ax)
        for t_s in marks:
            ax.axvline(t_s, color="#888888", linewidth=0.6, linestyle=":")
    _number_marks(axes[1], marks)
    axes[-1].set_xlabel(TIME, fontsize=9)
    return fig


def plot_speeds(
    estimate: Estimate,
    recording: Recording,
    *,
    wheel_radius_m: float | None = None,
    outages: Sequence[Outage] = (),
    ax: Axes | None = None,
) -> tuple[Figure, Axes]:
    """Forward speed of the wheels and as estimated, and of GNSS and truth where there are any."""
    fig, ax = style.canvas(ax, (9.0, 2.9))
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth

    def line(t_ns: NDArray[np.int64], speed: Array, colour: str, label: str, **options: Any) -> None:
        style.line(ax, style.seconds(t_ns, recording.start_ns), speed, colour, label, **options)

    if wheels is not None and len(wheels) and (wheels.unit == "mps" or wheel_radius_m is not None):
        speed = wheels.side_speeds_mps(wheel_radius_m or 1.0).mean(axis=1)
        line(wheels.t_ns, speed, style.SENSOR_COLOURS["wheels"], "wheels", linewidth=0.8)
    if gnss is not None and gnss.velocity_enu_mps is not None:
        speed = np.hypot(gnss.velocity_enu_mps[:, 0], gnss.velocity_enu_mps[:, 1])
        colour = style.SENSOR_COLOURS["gnss_velocity"]
        line(gnss.t_ns, speed, colour, "GNSS (absolute)", marker=".", linestyle="none", markersize=3)
    listed = recording.truth_channels
    if truth is not None and truth.twist_body is not None and (not listed or "velocity" in listed):
        line(truth.t_ns, truth.twist_body[:, 0], style.TRUTH, "truth", linewidth=1.8, alpha=0.35)
    path = estimate.trajectory
    if path.twist_body is not None:
        forward = path.twist_body[:, 0]
    else:
        forward = np.linalg.norm(estimate.velocity_mps[:, :2], axis=1)
    line(path.t_ns, forward, _GNSS, "estimate", linewidth=1.1)
    shade_outages(ax, outages)
    style.format_axes(ax, x=TIME, y="forward speed, m/s")
    style.legend_above(ax)
    return fig, ax


def has_skid_steering(estimate: Estimate) -> bool:
    """Whether `plot_skid_steering` has anything to show."""
    names = (name for name, _, _ in _SKID_STEERING)
    return bool(len(estimate.trajectory)) and any(series(estimate, name) is not None for name in names)


def plot_skid_steering(estimate: Estimate, start_ns: int, *, outages: Sequence[Outage] = ()) -> Figure:
    """Yaw scale, side-slip and centre of rotation over time, with bands of two sigma."""
    fig, axes = style.canvases(len(_SKID_STEERING), (9.0, 1.5 * len(_SKID_STEERING) + 0.6))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    rows = style.thin(len(t))
    for ax, (name, label, colour) in zip(axes, _SKID_STEERING, strict=True):
        state = series(estimate, name)
        if state is not None:
            value, sigma = state
            style.band(ax, t, value, sigma, colour, alpha=0.2, label="±2 sigma")
            style.line(ax, t, value, colour, "estimate")
            edges = np.concatenate([(value - 2 * sigma)[rows], (value + 2 * sigma)[rows]])
            ax.set_ylim(*style.robust_limits(edges, include=(0.0,)))
        shade_outages(ax, outages)
        style.format_axes(ax, y=label)
    style.legend_above(axes[0])
    axes[-1].set_xlabel(TIME, fontsize=9)
    return fig


def important_changes(
    changes: Sequence[WeightChange], most: int = 12, apart_s: float = 2.0
) -> list[WeightChange]:
    """The `most` largest changes by ratio, in order of time; their times are `apart_s` apart or equal."""

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


def change_numbers(changes: Sequence[WeightChange]) -> dict[int, int]:
    """The times of changes that are in order, each with its number from 1."""
    return {t_ns: number for number, t_ns in enumerate(dict.fromkeys(c.t_ns for c in changes), 1)}


def shade_outages(ax: Axes, outages: Sequence[Outage]) -> None:
    """Shade the outages of GNSS; they are named once in the legend."""
    for i, outage in enumerate(outages):
        label = "no GNSS" if i == 0 else None
        end = outage.start_s + outage.seconds
        ax.axvspan(outage.start_s, end, color=style.OUTAGE, zorder=0, linewidth=0, label=label)


def _mark_outages(ax: Axes, outages: Sequence[Outage]) -> None:
    """Mark the outages by a bar at the foot, where the background is taken."""
    foot = ax.get_xaxis_transform()
    for outage in outages:
        x = (outage.start_s, outage.start_s + outage.seconds)
        ax.plot(x, (0.02, 0.02), transform=foot, color=style.HELD_OUT, linewidth=4, solid_capstyle="butt")
        text = ax.text(x[0], 0.05, "no GNSS", transform=foot, fontsize=7, color=style.HELD_OUT, clip_on=True)
        text.set_in_layout(False)


def _shade_terrain(ax: Axes, estimate: Estimate, t_s: Array) -> list[Any]:
    """Colour the background by the most probable class; returns the legend's patches."""
    from matplotlib.patches import Patch

    if not len(t_s) or not estimate.classes:
        return []
    rows = style.thin(len(t_s), 600)
    label, t_s = estimate.dominant_terrain()[rows], t_s[rows]
    patches: dict[str, Any] = {}
    for first, last in style.runs_of(label):
        name = str(label[first])
        colour = style.terrain_colour(name)
        end = t_s[min(last, len(t_s) - 1)]
        ax.axvspan(t_s[first], end, color=colour, alpha=0.3, linewidth=0, zorder=0)
        patches.setdefault(name, Patch(color=colour, alpha=0.4, linewidth=0, label=style.label_text(name)))
    return list(patches.values())


def _label_strip(ax: Axes, recording: Recording, end_s: float) -> None:
    terrain = recording.terrain
    assert terrain is not None
    t = style.seconds(terrain.t_ns, recording.start_ns)
    for first, last in style.runs_of(terrain.label):
        stop = t[last] if last < len(t) else max(end_s, t[-1])
        colour = style.terrain_colour(terrain.label[first])
        ax.fill_between([t[first], stop], 1.05, 1.15, color=colour, linewidth=0)
    source = style.label_text(terrain.source, 14)
    ax.text(1.005, 1.10 / 1.16, source, transform=ax.transAxes, fontsize=7, va="center")


def _number_marks(ax: Axes, times_s: Sequence[float]) -> None:
    """Numbers 1, 2, ... below the top edge, in two heights so that neighbours do not cover each other."""
    box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "#888888", "linewidth": 0.5}
    for i, t in enumerate(times_s):
        ax.annotate(
            str(i + 1), (t, 0.93 if i % 2 == 0 else 0.82), xycoords=("data", "axes fraction"), fontsize=7,
            ha="center", va="center", bbox=box,
        )  # fmt: skip


def _error_limits(error: Array, sigma: Array) -> tuple[float, float]:
    """Limits that hold every error, and the band too unless it is far wider than the errors."""
    finite = error[np.isfinite(error)]
    low, high = (finite.min(), finite.max()) if len(finite) else (-1.0, 1.0)
    known = sigma[np.isfinite(sigma)]
    edge = 2.2 * float(np.percentile(known, 90.0)) if len(known) else 0.0
    edge = min(edge, 3.0 * max(abs(low), abs(high), 1e-3))
    low, high = min(low, -edge), max(high, edge)
    room = 0.05 * (high - low)
    return float(low - room), float(high + room)
