"""Figures of the filter's own consistency: biases, normalised innovations and their mean in windows."""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics import consistency
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet

NORMAL_95 = 1.959963985
"""Standard deviations of a normal quantity that hold 95 % of it, to both sides."""
SHOWN_SIGMAS = 4.5
"""Normalised innovations beyond this are drawn at the edge."""
EXPECTED_LABEL = "95 % if consistent"


def plot_biases(sheet: Sheet, estimate: Estimate) -> None:
    """Gyro biases in degrees a second and accelerometer biases, body axes, with bands of two sigma."""
    t = sheet.seconds(estimate.trajectory.t_ns)
    sigma = estimate.bias_sigma if estimate.bias_sigma is not None else np.full((len(t), 6), np.nan)
    rows = (
        ("bias_gyro", "gyro bias, deg/s", np.degrees(estimate.gyro_bias_radps), np.degrees(sigma[:, :3])),
        ("bias_accel", "accelerometer bias, m/s²", estimate.accel_bias_mps2, sigma[:, 3:]),
    )
    for key, label, values, spread in rows:
        plot = sheet.add_time(key, label, 180, limits=_settled_limits(values, spread))
        for i, (axis, colour) in enumerate(zip("xyz", style.AXIS_COLOURS, strict=True)):
            if np.isfinite(values[:, i]).any():
                plot.band(t, values[:, i], spread[:, i], axis, colour, alpha=0.15)
                plot.line(t, values[:, i], axis, colour)


def plot_innovations(sheet: Sheet, estimate: Estimate) -> list[str]:
    """For each sensor its normalised innovations, and below the mean of their squares in windows; their keys.

    Both with the band that holds 95 % where the covariance is consistent; that of the windows allows for
    the correlation of the samples. Crosses were rejected by a gate.
    """
    keys = []
    for whitened in consistency.innovations(estimate.innovations):
        sensor = whitened.quantity.removeprefix("nis ")
        rejected = [x.t_ns for x in estimate.innovations if x.sensor == sensor and not x.accepted]
        word = "".join(c if c.isalnum() else "_" for c in sensor)
        keys += [f"innovation_{word}", f"nis_{word}"]
        _normalised(sheet, keys[-2], whitened, np.array(rejected, dtype=np.int64), sensor)
        _windows(sheet, keys[-1], whitened, sensor)
    return keys


def _settled_limits(values: Array, spread: Array) -> tuple[float, float]:
    """Limits for the bands after a tenth of the drive: the prior at the start would dwarf them."""
    rows = slice(len(values) // 10, None)
    known = np.nan_to_num(spread[rows])
    bounds = np.concatenate([values[rows] - 2 * known, values[rows] + 2 * known])
    return style.robust_limits(bounds.ravel(), include=(0.0,))


def _normalised(
    sheet: Sheet, key: str, whitened: consistency.Whitened, rejected_ns: NDArray[np.int64], sensor: str
) -> None:
    """The innovations over their own sigma; one dot a dimension."""
    label = f"{style.label_text(sensor, 20)} innovation / sigma"
    plot = sheet.add_time(key, label, 170, limits=(-1.1 * SHOWN_SIGMAS, 1.1 * SHOWN_SIGMAS))
    band = {"y0": np.array([-NORMAL_95]), "y1": np.array([NORMAL_95])}
    plot.glyph("hstrip", band, EXPECTED_LABEL, style.EXPECTED_ON_ANY, "area", alpha=0.3, line_width=0)
    rejected = np.isin(whitened.t_ns, rejected_ns)
    t = sheet.seconds(whitened.t_ns)
    values = np.clip(whitened.values, -SHOWN_SIGMAS, SHOWN_SIGMAS)
    colour = style.colour_of(sensor, style.SENSOR_COLOURS)
    for chosen, marker, size, shade, name in (
        (~rejected, "circle", 2.5, colour, style.label_text(sensor)),
        (rejected, "x", 6.0, style.HELD_OUT, f"rejected ({int(rejected.sum())})"),
    ):
        rows = np.flatnonzero(chosen)
        rows = rows[style.thin(len(rows))]
        if len(rows):
            columns = values.shape[1]
            plot.dots(np.repeat(t[rows], columns), values[rows].ravel(), name, shade, marker, size)


def _windows(sheet: Sheet, key: str, whitened: consistency.Whitened, sensor: str) -> None:
    """Mean NIS a dimension in windows, as steps over its band."""
    windows = consistency.over_time(whitened, sheet.start_ns)
    tops = np.array([bound for w in windows for bound in (w.high, w.mean)])
    limits = (0.0, style.robust_limits(tops, include=(2.0,))[1])
    plot = sheet.add_time(key, f"{style.label_text(sensor, 20)} NIS / dof", 170, limits=limits)
    if not windows:
        return
    begin, end, low, high, mean = np.array([(w.start_s, w.end_s, w.low, w.high, w.mean) for w in windows]).T
    band = {"left": begin, "right": end, "bottom": low, "top": high}
    plot.glyph("quad", band, EXPECTED_LABEL, style.EXPECTED_ON_ANY, "area", alpha=0.3, line_width=0)
    colour = style.colour_of(sensor, style.SENSOR_COLOURS)
    label = f"mean of {consistency.WINDOW_S:g} s"
    steps = {"x0": begin, "x1": end, "y0": mean, "y1": mean}
    plot.glyph("segment", steps, label, colour, "line", line_width=2.5)
    plot.line((begin + end) / 2, mean, label, colour, width=0.8)
    one = {"y": np.array([1.0])}
    plot.glyph("hspan", one, "1: consistent", "#808080", "line", line_width=1.0)
