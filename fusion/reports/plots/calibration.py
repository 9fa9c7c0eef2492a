"""Plots of a calibration: its numbers, their correlation, and every channel before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.calibrate.result import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED, BEFORE, AFTER, PRIOR = "#1a1a1a", "#d55e00", "#0072b2", "#d0d0d0"


def plot_numbers(calibration: Calibration, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Each number in prior sigmas about its prior, with two sigma; hollow where the data do not tell it."""
    fitted = calibration.fitted
    fig, ax = style.canvas(ax, (8.0, 0.9 + 0.36 * len(fitted)))
    rows = np.arange(len(fitted))[::-1]
    ax.barh(rows, 4.0, left=-2.0, height=0.5, color=PRIOR)
    for row, f in zip(rows, fitted, strict=True):
        at, bar = (f.value - f.prior) / f.prior_sigma, 2.0 * f.sigma / f.prior_sigma
        face = AFTER if f.status == "told" else "white"
        ax.errorbar(at, row, xerr=bar, fmt="o", color=AFTER, markerfacecolor=face, capsize=3)
        ax.plot((f.start - f.prior) / f.prior_sigma, row, "|", color=BEFORE, markersize=14, markeredgewidth=2)
    ax.set_yticks(rows, [f"{f.name}\n{f.value:.4g} ± {f.sigma:.2g} {f.unit}".rstrip() for f in fitted])
    style.dress(ax, x="prior sigmas from the prior value (dot: fitted, bar: start)")
    return fig, ax


def plot_correlation(calibration: Calibration, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Correlation matrix with its numbers."""
    names = [f.name.rpartition(".")[2] for f in calibration.fitted]
    size = 2.2 + 0.55 * len(names)
    fig, ax = style.canvas(ax, (size + 1.2, size))
    ax.imshow(calibration.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    for (i, j), value in np.ndenumerate(calibration.correlation):
        colour = "white" if abs(value) > 0.6 else "black"
        ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    return fig, ax


def plot_channels(calibration: Calibration, log: str) -> tuple[Figure, NDArray[Any]]:
    """Every channel of one log over time: measured, the twin before and after."""
    from matplotlib.figure import Figure

    fits = [c for c in calibration.channels if c.log == log]
    rows = (len(fits) + 1) // 2
    fig = Figure(figsize=(10.0, 1.5 + 1.6 * rows), layout="constrained")
    axes = fig.subplots(rows, 2, sharex=True, squeeze=False)
    for ax, fit in zip(axes.flat, fits, strict=False):
        step = max(1, len(fit.t_s) // style.MAX_POINTS)
        t_s = fit.t_s[::step]
        ax.plot(t_s, fit.measured[::step], ".", color=MEASURED, markersize=2, label="measured")
        ax.plot(t_s, fit.before[::step], color=BEFORE, linewidth=0.9, label="twin before")
        ax.plot(t_s, fit.after[::step], color=AFTER, linewidth=0.9, label="twin after")
        style.dress(ax, title=fit.channel)
    for ax in axes.flat[len(fits) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel("time, s", fontsize=9)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=8, frameon=False)
    return fig, axes
