"""Figures of a calibration: its parameters, their correlation, and every channel before and after."""

from __future__ import annotations

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, name_ticks
from terrafusion.twin.calibrate.identifiability import IDENTIFIED
from terrafusion.twin.calibrate.result import Calibration


def plot_parameters(sheet: Sheet, calibration: Calibration) -> None:
    """Each parameter in prior sigmas about its prior, with two sigma; hollow where not identified."""
    fitted = calibration.fitted
    plot = sheet.add_rows(
        "rows parameters", "prior sigmas from the prior value", [_short(f.name) for f in fitted]
    )
    rows = np.arange(len(fitted), dtype=float)
    prior = {"left": np.array([-2.0]), "right": np.array([2.0])}
    prior |= {"top": np.array([-0.5]), "bottom": np.array([len(fitted) - 0.5])}
    label = "two sigma of the prior"
    plot.glyph("quad", prior, label, style.EXPECTED_ON_ANY, "area", alpha=0.25, line_width=0)
    value, sigma, start = (
        np.array([(f.value - f.prior, f.sigma, f.start - f.prior) for f in fitted])
        / np.array([[f.prior_sigma] for f in fitted])
    ).T
    known = np.array([f.status == IDENTIFIED for f in fitted])
    for chosen, label in ((known, "fitted"), (~known, "not identified")):
        if chosen.any():
            mine = value[chosen], (value - 2 * sigma)[chosen], (value + 2 * sigma)[chosen]
            plot.intervals(rows[chosen], *mine, label, style.AFTER, hollow=label != "fitted")
    plot.glyph(
        "scatter", {"x": start, "y": rows}, "start", style.BEFORE, "dot", marker="dash", angle=1.571, size=16
    )


def plot_correlation(sheet: Sheet, calibration: Calibration) -> None:
    """Correlation matrix; nothing for one parameter."""
    from bokeh.palettes import RdBu11, interp_palette

    names = [_short(f.name) for f in calibration.fitted]
    if len(names) < 2:
        return
    edges = np.arange(-0.5, len(names))
    size = (len(names) - 0.5, -0.5)
    plot = sheet.add("cells correlation", "", "", 190 + 34 * len(names), y_range=size)
    plot.cells(edges, edges, calibration.correlation, interp_palette(RdBu11, 256), limits=(-1.0, 1.0))
    for axis in (plot.panel.figure.xaxis, plot.panel.figure.yaxis):
        name_ticks(axis, names)
    plot.panel.figure.xaxis.major_label_orientation = 0.8


def plot_channels(sheet: Sheet, calibration: Calibration, log: str) -> list[str]:
    """Every channel of one log over time: measured, the twin before and after; the keys of the figures."""
    fits = [c for c in calibration.channels if c.log == log]
    sheet.begin_axis(max((float(c.t_s[-1]) for c in fits), default=1.0))
    keys = [f"channel{len(sheet.panels) + i}" for i in range(len(fits))]
    for key, fit in zip(keys, fits, strict=True):
        plot = sheet.add_time(key, fit.channel, 170)
        rows = style.thin(len(fit.t_s))
        plot.dots(fit.t_s[rows], fit.measured[rows], "measured", style.TRUTH_ON_ANY, size=2.0)
        plot.line(fit.t_s, fit.before, "twin before", style.BEFORE, width=1.2)
        plot.line(fit.t_s, fit.after, "twin after", style.AFTER, width=1.2)
    return keys


def _short(name: str) -> str:
    """The last two words of a dotted name."""
    return ".".join(name.split(".")[-2:])
