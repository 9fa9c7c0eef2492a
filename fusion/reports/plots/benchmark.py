"""The figure of a benchmark: the error of every arm over that of the tuned fixed noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrafusion.fusion.benchmark.compare import Contrast
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet

COLOURS = style.MODE_COLOURS | {"data sheet": "#e69f00", "shuffled": "#8c510a", "adversarial": "#5e2a84"}
ARM_PX, LEAST_PX = 15, 48
"""Height of an arm in the row of its group, and of the row at least."""
RANGE = (0.1, 20.0)
"""Of the ratios; what lies outside, such as those of failed replays, is drawn at its ends."""
TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def plot_ratios(sheet: Sheet, contrasts: Sequence[Contrast]) -> None:
    """A row a family and plant, in it each arm with its 95 % interval; below 1 its errors are smaller."""
    shown = [c for c in contrasts if c.arm != BASELINE]
    groups = list(dict.fromkeys((c.family, c.plant) for c in shown))
    arms = list(dict.fromkeys(c.arm for c in shown))
    if not shown:
        return
    names = [f"{family}, {plant}" for family, plant in groups]
    px = max(LEAST_PX, ARM_PX * (len(arms) + 2))
    x = f"position error over that of {BASELINE}"
    ends = [_clipped(x) for c in shown for x in (c.ratio, *(c.interval or ()))]
    limits = (0.9 * min(ends), 1.1 * max(ends))
    plot = sheet.add_rows("rows ratios", x, names, px, x_axis_type="log", x_range=limits)
    plot.panel.figure.xaxis.ticker = [t for t in TICKS if limits[0] <= t <= limits[1]]
    edge = np.array([-0.5, len(groups) - 0.5])
    plot.line(np.ones(2), edge, "as large as that of fixed", style.TRUTH_ON_ANY, width=1.0)
    for k, arm in enumerate(arms):
        own = [c for c in shown if c.arm == arm]
        offset = (k - 0.5 * (len(arms) - 1)) / (len(arms) + 2)
        rows = np.array([groups.index((c.family, c.plant)) + offset for c in own])
        values = [(c.ratio, *(c.interval or (c.ratio, c.ratio))) for c in own]
        text = [f"{v:.3g} [{a:.3g}, {b:.3g}]" for v, a, b in values]
        ratio, low, high = (np.array([_clipped(row[i]) for row in values]) for i in range(3))
        colour = style.line_colour(style.colour_of(arm, COLOURS))
        plot.intervals(rows, ratio, low, high, arm, colour, hollow=arm != ADAPTIVE, text=text)


def _clipped(ratio: float) -> float:
    return min(max(ratio, RANGE[0]), RANGE[1])
