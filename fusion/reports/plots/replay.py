"""Figures over time of the replays of one drive: errors, ground and slip, weights, sensors."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.estimate import Estimate, WeightChange
from terrafusion.fusion.metrics.error_series import Errors
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Plot, Sheet

_SIGMAS = (
    ("wheel_sigma_mps", "wheel speed, m/s", "wheels", "solid"),
    ("slip_sigma", "slip", "slip", "solid"),
    ("side_slip_sigma", "side-slip", "side_slip", "dashed"),
)
_FACTORS = (
    ("gyro_inflation", "gyro", "gyro", "solid"),
    ("gyro_yaw_inflation", "gyro, yaw", "gyro", "dotted"),
    ("accel_inflation", "accelerometer", "accel", "dashed"),
    ("gnss_inflation", "GNSS", "gnss", "solid"),
)
"""Weight of the policy file, its label, sensor and dashes."""
_SKID_STEERING = (
    ("yaw_scale", "yaw scale", "#0072b2"),
    ("side_slip", "side-slip", "#d55e00"),
    ("icr_x_m", "centre of rotation, m", "#009e73"),
)


def plot_error_runs(sheet: Sheet, errors: Mapping[str, Errors], colours: Mapping[str, str]) -> None:
    """Horizontal distance between estimate and reference, a line a run."""
    plot = sheet.add_time("error_runs", "position error, m", 240)
    for name, one in errors.items():
        distance = one.distance_m()
        peak = [int(np.nanargmax(distance))] if np.isfinite(distance).any() else []
        plot.line(sheet.seconds(one.t_ns), distance, name, colours[name], keep=peak)


def plot_errors(sheet: Sheet, errors: Errors) -> None:
    """East, north and heading error (deg) with the estimated band of two sigma."""
    t = sheet.seconds(errors.t_ns)
    error, P = errors.position_error_m(), errors.covariance_m2
    rows = [
        ("error_east", "east error, m", error[:, 0], np.sqrt(P[:, 0, 0])),
        ("error_north", "north error, m", error[:, 1], np.sqrt(P[:, 1, 1])),
    ]
    if np.isfinite(errors.reference_yaw_rad).any():
        yaw, sigma = np.degrees(errors.yaw_error_rad()), np.degrees(errors.yaw_sigma_rad)
        rows.append(("error_heading", "heading error, deg", yaw, sigma))
    for key, label, value, sigma in rows:
        plot = sheet.add_time(key, label, 170, limits=_error_limits(value, sigma))
        plot.band(t, np.zeros(len(t)), sigma, "estimated ±2 sigma", "#6baed6", alpha=0.35)
        plot.line(t, value, "error", style.SENSOR_COLOURS["gnss"])


def plot_slip(
    sheet: Sheet, estimates: Mapping[str, Estimate], shown: str, colours: Mapping[str, str]
) -> None:
    """Estimated slip of each run, and the band of two sigma and the most probable ground of the one shown."""
    estimate = estimates[shown]
    t, s, sigma = sheet.seconds(estimate.trajectory.t_ns), estimate.slip, estimate.slip_sigma
    rows = style.thin(len(t))
    edges = np.concatenate([(s - 2 * sigma)[rows], (s + 2 * sigma)[rows]])
    low, high = style.robust_limits(edges, include=(0.0, 0.1))
    plot = sheet.add_time("slip", "slip (1 - v / wheel speed)", 220, limits=(max(low, -1.2), min(high, 1.2)))
    _shade_terrain(plot, estimate, t)
    plot.band(t, s, sigma, f"±2 sigma ({shown})", colours[shown])
    for name, one in estimates.items():
        plot.line(sheet.seconds(one.trajectory.t_ns), one.slip, name, colours[name])


def plot_terrain(sheet: Sheet, estimate: Estimate, recording: Recording) -> None:
    """Probabilities of the terrain classes, stacked; a strip on top shows the label of the log, if any."""
    t = sheet.seconds(estimate.trajectory.t_ns)
    rows = style.thin(len(t))
    p = np.nan_to_num(estimate.terrain[rows])
    terrain = recording.terrain
    labelled = terrain is not None and len(terrain) > 0
    plot = sheet.add_time(
        "terrain", "probability of the ground", 200, limits=(0.0, 1.16 if labelled else 1.0)
    )
    floor = np.zeros(len(rows))
    for i, name in enumerate(estimate.classes):
        if p[:, i].max(initial=0.0) > 0.01:
            data = {"x": t[rows], "y1": floor, "y2": floor + p[:, i]}
            plot.glyph("varea", data, style.label_text(name), style.terrain_colour(name), "area", alpha=0.85)
            floor = floor + p[:, i]
    if terrain is not None and labelled:
        end_s = float(t[-1]) if len(t) else recording.duration_s()
        _label_strip(plot, sheet.seconds(terrain.t_ns), terrain.label, end_s)


def plot_weights(sheet: Sheet, estimate: Estimate, *, marked: Sequence[WeightChange] = ()) -> None:
    """Noise of each sensor (log scale); the times of the changes `marked` are numbered from 1."""
    t = sheet.seconds(estimate.trajectory.t_ns)
    marks = sheet.seconds(np.array([*change_numbers(marked)], dtype=np.int64))
    for key, weights, label in (
        ("weight_sigmas", _SIGMAS, "1 sigma"),
        ("weight_factors", _FACTORS, "times data sheet"),
    ):
        plot = sheet.add_time(key, label, 200, log=True)
        top = 1.0e-6
        for name, text, sensor, dash in weights:
            if name in estimate.weights:
                values = np.maximum(estimate.weights[name], 1e-6)
                top = max(top, float(np.nanmax(values, initial=top)))
                plot.line(t, values, text, style.colour_of(sensor, style.SENSOR_COLOURS), dash=dash)
        if len(marks) and len(t):
            plot.glyph("vspan", {"x": marks}, "change, by its number", "#808080", "line", line_dash="dotted")
            numbers = np.array([str(k) for k in range(1, len(marks) + 1)], dtype=object)
            where = {"x": marks, "y": np.full(len(marks), 1.6 * top), "text": numbers}
            plot.glyph(
                "text", where, "change, by its number", "#808080", "line", text_font_size="10px",
                text_align="center",
            )  # fmt: skip


def plot_speeds(sheet: Sheet, estimate: Estimate, recording: Recording, wheel_radius_m: float) -> None:
    """Forward speed of the wheels and as estimated, and of GNSS and truth where there are any."""
    plot = sheet.add_time("speeds", "forward speed, m/s", 220)
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth
    colours = style.SENSOR_COLOURS
    if wheels is not None and len(wheels):
        speed = wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)
        plot.line(sheet.seconds(wheels.t_ns), speed, "wheels", colours["wheels"], width=1.0)
    if gnss is not None and gnss.velocity_enu_mps is not None:
        speed = np.hypot(gnss.velocity_enu_mps[:, 0], gnss.velocity_enu_mps[:, 1])
        rows = style.thin(len(speed))
        t = sheet.seconds(gnss.t_ns)[rows]
        plot.dots(t, speed[rows], "GNSS (absolute)", colours["gnss_velocity"], size=3.0)
    if truth is not None and truth.twist_body is not None and recording.truth_holds("velocity"):
        speed, t = truth.twist_body[:, 0], sheet.seconds(truth.t_ns)
        plot.line(t, speed, "truth", style.TRUTH_ON_ANY, width=2.4, alpha=0.6)
    path = estimate.trajectory
    if path.twist_body is not None:
        forward = path.twist_body[:, 0]
    else:
        forward = np.linalg.norm(estimate.velocity_mps[:, :2], axis=1)
    plot.line(sheet.seconds(path.t_ns), forward, "estimate", colours["gnss"])


def plot_skid_steering(sheet: Sheet, estimate: Estimate) -> None:
    """Yaw scale, side-slip and centre of rotation, those that were estimated, with bands of two sigma."""
    t = sheet.seconds(estimate.trajectory.t_ns)
    rows = style.thin(len(t))
    for name, label, colour in _SKID_STEERING:
        state = series(estimate, name)
        if state is None or not len(t):
            continue
        value, sigma = state
        edges = np.concatenate([(value - 2 * sigma)[rows], (value + 2 * sigma)[rows]])
        plot = sheet.add_time(f"skid_{name}", label, 160, limits=style.robust_limits(edges, include=(0.0,)))
        plot.band(t, value, sigma, "±2 sigma", colour)
        plot.line(t, value, "estimate", colour)


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


def _shade_terrain(plot: Plot, estimate: Estimate, t_s: Array) -> None:
    """Colour the background by the most probable class."""
    if not style.grounds_known(estimate):
        return
    rows = style.thin(len(t_s), 600)
    label, t_s = estimate.ground()[rows], t_s[rows]
    runs = style.runs_of(label)
    strips: dict[str, list[tuple[float, float]]] = {}
    for first, last in runs:
        strips.setdefault(str(label[first]), []).append((t_s[first], t_s[min(last, len(t_s) - 1)]))
    for name, edges in strips.items():
        at = np.array(edges)
        data: dict[str, Any] = {"x0": at[:, 0], "x1": at[:, 1]}
        colour = style.terrain_colour(name)
        plot.glyph("vstrip", data, style.label_text(name), colour, "area", alpha=0.3, line_width=0)


def _label_strip(plot: Plot, t: Array, label: NDArray[Any], end_s: float) -> None:
    """A strip on top with the label at times (N,), which holds until the next one."""
    runs = style.runs_of(label)
    data = {
        "left": t[[first for first, _ in runs]],
        "right": np.array([t[last] if last < len(t) else max(end_s, t[-1]) for _, last in runs]),
        "bottom": np.full(len(runs), 1.05),
        "top": np.full(len(runs), 1.15),
        "colour": np.array([style.terrain_colour(label[first]) for first, _ in runs], dtype=object),
    }
    plot.glyph("quad", data, "", None, "area", line_width=0)


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
