"""Plots of the filter's own consistency: biases, normalised innovations and their mean in windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics import consistency
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.replay import TIME, shade_outages

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NORMAL_95 = 1.959963985
"""Standard deviations of a normal quantity that hold 95 % of it, to both sides."""
SHOWN_SIGMAS = 4.5
"""Normalised innovations beyond this are drawn at the edge."""
EXPECTED_LABEL = "95 % if consistent"
Array = NDArray[np.float64]


def plot_biases(estimate: Estimate, start_ns: int) -> Figure:
    """Gyro biases in degrees a second and accelerometer biases, body axes, with bands of two sigma."""
    fig, panels = style.canvases(2, (9.0, 4.4))
    t = style.seconds(estimate.trajectory.t_ns, start_ns)
    sigma = estimate.bias_sigma if estimate.bias_sigma is not None else np.full((len(t), 6), np.nan)
    rows = (
        ("gyro, deg/s", np.degrees(estimate.gyro_bias_radps), np.degrees(sigma[:, :3])),
        ("accelerometer, m/s²", estimate.accel_bias_mps2, sigma[:, 3:]),
    )
    for ax, (label, values, spread) in zip(panels, rows, strict=True):
        for i, (axis, colour) in enumerate(zip("xyz", style.AXIS_COLOURS, strict=True)):
            if np.isfinite(values[:, i]).any():
                style.band(ax, t, values[:, i], spread[:, i], colour, alpha=0.15)
                style.line(ax, t, values[:, i], colour, axis)
        ax.set_ylim(*_settled_limits(values, spread))
        style.format_axes(ax, y=label)
    style.legend_above(panels[0])
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig


def plot_innovations(estimate: Estimate, start_ns: int, *, outages: Sequence[Outage] = ()) -> Figure:
    """For each sensor its normalised innovations, and below the mean of their squares in windows.

    Both with the band that holds 95 % where the covariance is consistent; that of the windows allows for
    the correlation of the samples. Crosses were rejected by a gate.
    """
    series = consistency.innovations(estimate.innovations)
    rows = max(1, 2 * len(series))
    fig, panels = style.canvases(rows, (9.0, 1.75 * rows + 0.5))
    for i, whitened in enumerate(series):
        sensor = whitened.quantity.removeprefix("nis ")
        rejected = [x.t_ns for x in estimate.innovations if x.sensor == sensor and not x.accepted]
        _normalised(panels[2 * i], whitened, np.array(rejected, dtype=np.int64), sensor, start_ns)
        _windows(panels[2 * i + 1], whitened, sensor, start_ns)
        for ax in panels[2 * i : 2 * i + 2]:
            shade_outages(ax, outages)
            style.legend_above(ax)
    panels[-1].set_xlabel(TIME, fontsize=9)
    return fig


def _settled_limits(values: Array, spread: Array) -> tuple[float, float]:
    """Limits for the bands after a tenth of the drive: the prior at the start would dwarf them."""
    rows = slice(len(values) // 10, None)
    known = np.nan_to_num(spread[rows])
    bounds = np.concatenate([values[rows] - 2 * known, values[rows] + 2 * known])
    return style.robust_limits(bounds.ravel(), include=(0.0,))


def _normalised(
    ax: Axes, whitened: consistency.Whitened, rejected_ns: NDArray[np.int64], sensor: str, start_ns: int
) -> None:
    """The innovations over their own sigma; one dot a dimension."""
    rejected = np.isin(whitened.t_ns, rejected_ns)
    t = style.seconds(whitened.t_ns, start_ns)
    values = np.clip(whitened.values, -SHOWN_SIGMAS, SHOWN_SIGMAS)
    colour = style.colour_of(sensor, style.SENSOR_COLOURS)
    ax.axhspan(-NORMAL_95, NORMAL_95, color=style.EXPECTED, alpha=0.6, linewidth=0, label=EXPECTED_LABEL)
    for chosen, marker, size, shade, label in (
        (~rejected, ".", 2.5, colour, style.label_text(sensor)),
        (rejected, "x", 5.0, style.TRUTH, f"rejected ({int(rejected.sum())})"),
    ):
        rows = np.flatnonzero(chosen)
        rows = rows[style.thin(len(rows))]
        for d in range(values.shape[1] if len(rows) else 0):
            ax.plot(
                t[rows], values[rows, d], marker, color=shade, markersize=size, alpha=0.7, linestyle="none",
                label=label if d == 0 else None,
            )  # fmt: skip
    ax.set_ylim(-1.1 * SHOWN_SIGMAS, 1.1 * SHOWN_SIGMAS)
    style.format_axes(ax, y=f"{style.label_text(sensor, 20)}\ninnovation / sigma")


def _windows(ax: Axes, whitened: consistency.Whitened, sensor: str, start_ns: int) -> None:
    """Mean NIS a dimension in windows, as steps over its band."""
    windows = consistency.over_time(whitened, start_ns)
    colour = style.colour_of(sensor, style.SENSOR_COLOURS)
    for i, w in enumerate(windows):
        label = EXPECTED_LABEL if i == 0 else None
        ax.fill_between((w.start_s, w.end_s), w.low, w.high, color=style.EXPECTED, linewidth=0, label=label)
    for i, w in enumerate(windows):
        label = f"mean of {consistency.WINDOW_S:g} s" if i == 0 else None
        ax.plot((w.start_s, w.end_s), (w.mean, w.mean), color=colour, linewidth=2.0, label=label)
    middle = [(w.start_s + w.end_s) / 2 for w in windows]
    ax.plot(middle, [w.mean for w in windows], color=colour, linewidth=0.7, alpha=0.7)
    ax.axhline(1.0, color="#555555", linewidth=0.9)
    tops = np.array([bound for w in windows for bound in (w.high, w.mean)])
    ax.set_ylim(0.0, style.robust_limits(tops, include=(2.0,))[1])
    style.format_axes(ax, y="NIS / dof")
