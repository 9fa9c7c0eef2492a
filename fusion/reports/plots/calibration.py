"""Plots of a calibration: its parameters, their correlation, and every channel before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.calibrate.identifiability import IDENTIFIED
from terrafusion.twin.calibrate.result import Calibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRIOR = "#d0d0d0"


def plot_parameters(calibration: Calibration) -> Figure:
    """Each parameter in prior sigmas about its prior, with two sigma; hollow where not identified."""
    fitted = calibration.fitted
    fig, ax = style.canvas((8.0, 0.9 + 0.36 * len(fitted)))
    rows = np.arange(len(fitted))[::-1]
    ax.barh(rows, 4.0, left=-2.0, height=0.5, color=PRIOR)
    for row, f in zip(rows, fitted, strict=True):
        at, bar = (f.value - f.prior) / f.prior_sigma, 2.0 * f.sigma / f.prior_sigma
        face = style.AFTER if f.status == IDENTIFIED else "white"
        ax.errorbar(at, row, xerr=bar, fmt="o", color=style.AFTER, markerfacecolor=face, capsize=3)
        start = (f.start - f.prior) / f.prior_sigma
        ax.plot(start, row, "|", color=style.BEFORE, markersize=14, markeredgewidth=2)
    ax.set_yticks(rows, [f"{f.name}\n{f.value:.4g} ± {f.sigma:.2g} {f.unit}".rstrip() for f in fitted])
    style.format_axes(ax, x="prior sigmas from the prior value (dot: fitted, bar: start)")
    return fig


def plot_correlation(calibration: Calibration) -> Figure:
    """Correlation matrix with its numbers."""
    names = [f.name.rpartition(".")[2] for f in calibration.fitted]
    size = 2.2 + 0.55 * len(names)
    fig, ax = style.canvas((size + 1.2, size))
    ax.imshow(calibration.correlation, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    for (i, j), value in np.ndenumerate(calibration.correlation):
        colour = "white" if abs(value) > 0.6 else "black"
        ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    return fig


def plot_channels(calibration: Calibration, log: str) -> Figure:
    """Every channel of one log over time: measured, the twin before and after."""
    fits = [c for c in calibration.channels if c.log == log]
    fig, axes = style.channel_grid(len(fits), 1.6, 1.5)
    for ax, fit in zip(axes, fits, strict=True):
        step = max(1, len(fit.t_s) // style.MAX_POINTS)
        t_s = fit.t_s[::step]
        ax.plot(t_s, fit.measured[::step], ".", color=style.TRUTH, markersize=2, label="measured")
        ax.plot(t_s, fit.before[::step], color=style.BEFORE, linewidth=0.9, label="twin before")
        ax.plot(t_s, fit.after[::step], color=style.AFTER, linewidth=0.9, label="twin after")
        style.format_axes(ax, title=fit.channel)
    style.finish_grid(fig, axes)
    return fig
