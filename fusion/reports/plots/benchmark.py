"""The figure of a benchmark: the error of every arm over that of the tuned fixed noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from terrafusion.fusion.benchmark.compare import Contrast
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE
from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = style.MODE_COLOURS | {"data sheet": "#e69f00", "shuffled": "#8c510a", "adversarial": "#5e2a84"}
GROUP_IN, SPREAD = 0.62, 0.09
"""Height of a group, inches, and of an arm in it, shares of that."""
RANGE = (0.1, 20.0)
"""Of the ratios; what lies outside, such as those of failed replays, is drawn at its ends."""
TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


def plot_ratios(contrasts: Sequence[Contrast]) -> Figure:
    """A line a family and plant, a marker an arm with its 95 % interval; below 1 its errors are smaller."""
    shown = [c for c in contrasts if c.arm != BASELINE]
    groups = list(dict.fromkeys((c.family, c.plant) for c in shown))
    arms = list(dict.fromkeys(c.arm for c in shown))
    fig, ax = style.canvas((9.0, 1.3 + GROUP_IN * len(groups)))
    for k, arm in enumerate(arms):
        own = [c for c in shown if c.arm == arm]
        height = [groups.index((c.family, c.plant)) + SPREAD * (k - 0.5 * (len(arms) - 1)) for c in own]
        ratio = [_clipped(c.ratio) for c in own]
        ends = [[_clipped(x) for x in c.interval or (c.ratio, c.ratio)] for c in own]
        reach = [
            [r - low for r, (low, _) in zip(ratio, ends, strict=True)],
            [high - r for r, (_, high) in zip(ratio, ends, strict=True)],
        ]
        form, size = ("D", 6) if arm == ADAPTIVE else ("o", 4)
        colour = style.colour_of(arm, COLOURS)
        ax.errorbar(
            ratio, height, xerr=reach, fmt=form, markersize=size, color=colour, elinewidth=1.2, label=arm
        )
    ax.axvline(1.0, color=style.TRUTH, linewidth=0.8)
    ax.set_xscale("log")
    low, high = (f([_clipped(c.ratio) for c in shown], default=1.0) for f in (min, max))
    ax.set_xlim(max(RANGE[0], 0.7 * low), min(RANGE[1], 1.5 * high))
    style.plain_log_ticks(ax.xaxis)
    left, right = ax.get_xlim()
    ax.set_xticks([t for t in TICKS if left <= t <= right])
    ax.set_yticks(range(len(groups)), [f"{family}, {plant}" for family, plant in groups])
    ax.invert_yaxis()
    x = f"position error in the outage over that of {BASELINE} (tuned): median of pairs, 95 % interval"
    style.format_axes(ax, x=x)
    style.legend_above(ax)
    return fig


def _clipped(ratio: float) -> float:
    return min(max(ratio, RANGE[0]), RANGE[1])
