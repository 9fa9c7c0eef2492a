"""The figure of a benchmark: every arm's error over that of the tuned fixed row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from terrafusion.fusion.benchmark.compare import Contrast
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = style.MODE_COLOURS | {"data sheet": "#e69f00", "shuffled": "#8c510a", "adversarial": "#5e2a84"}
ROW_IN, SPREAD = 0.62, 0.09
"""Height of a group, inches, and of an arm in it, shares of that."""
RANGE = (0.1, 20.0)
"""Of the ratios; what lies outside, such as those of failed replays, is drawn at its ends."""


def plot_ratios(found: Sequence[Contrast]) -> Figure:
    """A row a family and plant, a mark an arm with its 95 % interval; left of 1 its errors are smaller."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    shown = [c for c in found if c.arm != BASELINE]
    groups = list(dict.fromkeys((c.family, c.plant) for c in shown))
    arms = list(dict.fromkeys(c.arm for c in shown))
    figure = Figure(figsize=(9.0, 1.3 + ROW_IN * len(groups)), layout="constrained")
    ax = figure.subplots()
    for k, arm in enumerate(arms):
        own = [c for c in shown if c.arm == arm]
        height = [groups.index((c.family, c.plant)) + SPREAD * (k - 0.5 * (len(arms) - 1)) for c in own]
        ratio = [_drawn(c.ratio) for c in own]
        ends = [tuple(map(_drawn, c.interval or (c.ratio, c.ratio))) for c in own]
        reach = [[r - e[0] for r, e in zip(ratio, ends, strict=True)],
                 [e[1] - r for r, e in zip(ratio, ends, strict=True)]]  # fmt: skip
        ax.errorbar(
            ratio, height, xerr=reach, fmt="D" if arm == ADAPTIVE else "o", markersize=6 if arm == ADAPTIVE else 4,
            color=style.colour_of(arm, COLOURS), elinewidth=1.2, label=arm,
        )  # fmt: skip
    ax.axvline(1.0, color=style.TRUTH, linewidth=0.8)
    ax.set_xscale("log")
    low, high = (f([_drawn(c.ratio) for c in shown], default=1.0) for f in (min, max))
    ax.set_xlim(max(RANGE[0], 0.7 * low), min(RANGE[1], 1.5 * high))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xticks(
        [t for t in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0) if ax.get_xlim()[0] <= t <= ax.get_xlim()[1]]
    )
    ax.set_yticks(range(len(groups)), [f"{family}, {plant}" for family, plant in groups])
    ax.invert_yaxis()
    style.dress(
        ax, x=f"position error in the outage over that of {BASELINE} (tuned): median of pairs, 95 % interval"
    )
    style.legend_above(ax)
    return figure


def _drawn(ratio: float) -> float:
    return min(max(ratio, RANGE[0]), RANGE[1])
