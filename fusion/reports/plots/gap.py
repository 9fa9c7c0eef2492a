"""Plots of a diagnosis: the gap map, ranked causes, errors before and after the effect is added."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.where import BANDS, REGIMES
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_CAUSES = 8


def plot_map(d: GapDiagnosis) -> Figure:
    """Channel by regime (both bands): share of the excess error; a dot where it is significant."""
    channels = list(dict.fromkeys(c.channel for c in d.where))
    columns = [(r, b) for r, _ in REGIMES for b in BANDS]
    share = np.full((len(channels), len(columns)), np.nan)
    fig, ax = style.canvas(None, (10.0, 2.6 + 0.36 * len(channels)))
    for cell in d.where:
        row, column = channels.index(cell.channel), columns.index((cell.regime, cell.band))
        share[row, column] = 100.0 * cell.share
        if cell.p_value <= d.significance:
            ax.plot(column, row, "o", color=style.TRUTH, markersize=4)
    image = ax.imshow(share, aspect="auto", cmap="Oranges", vmin=0.0)
    ax.set_yticks(range(len(channels)), channels, fontsize=8)
    labels = [f"{r}\n{b}" for r, b in columns]
    ax.set_xticks(range(len(columns)), labels, rotation=55, ha="right", fontsize=7)
    fig.colorbar(image, ax=ax, label="share of the excess, %")
    return fig


def plot_causes(d: GapDiagnosis) -> Figure:
    """Probability of the first causes, of an unknown one and of none."""
    rows = [(c.effect, c.probability) for c in d.verdict.causes[:MOST_CAUSES]]
    rows += [("unknown cause", d.verdict.p_unknown), ("no gap", d.verdict.p_null)]
    fig, ax = style.canvas(None, (8.0, 1.0 + 0.32 * len(rows)))
    at = np.arange(len(rows))[::-1]
    colours = [style.AFTER if name in d.verdict.named else style.NEUTRAL for name, _ in rows]
    ax.barh(at, [100.0 * p for _, p in rows], color=colours, height=0.7)
    for y, (_, p) in zip(at, rows, strict=True):
        ax.text(100.0 * p + 1.0, y, f"{100.0 * p:.0f} %", va="center", fontsize=8)
    ax.set_yticks(at, [name for name, _ in rows])
    ax.set_xlim(0.0, 112.0)
    style.format_axes(ax, x="probability, %")
    return fig


def plot_shrink(d: GapDiagnosis) -> Figure:
    """Whitened error of every channel before and after, and in the references."""
    assert d.shrinkage is not None
    names, rows = list(d.shrinkage.channels), list(d.shrinkage.channels.values())
    fig, ax = style.canvas(None, (8.0, 1.2 + 0.42 * len(names)))
    at = np.arange(len(names))[::-1]
    for shift, colour, label, k in ((0.2, style.BEFORE, "before", 0), (-0.2, style.AFTER, "after", 1)):
        ax.barh(at + shift, [row[k] or 0.0 for row in rows], height=0.38, color=colour, label=label)
    for y, row in zip(at, rows, strict=True):
        if row[2] is not None:
            ax.plot([row[2], row[2]], [y - 0.42, y + 0.42], color=style.TRUTH, linewidth=1.5)
    if d.references:
        ax.plot([], [], color=style.TRUTH, linewidth=1.5, label="references")
    ax.set_yticks(at, names)
    ax.legend(fontsize=8, frameon=False)
    style.format_axes(ax, x="root mean square error, in sigmas of its noise")
    return fig


def plot_errors(d: GapDiagnosis, run: int) -> Figure:
    """Whitened errors of one run over time, channel by channel, before and after."""
    assert d.shrinkage is not None
    evidence, channels = d.evidence.runs[run], d.evidence.channels
    fig, axes = style.channel_grid(len(channels), 1.5, 1.2)
    for i, (ax, channel) in enumerate(zip(axes, channels, strict=True)):
        mine = np.flatnonzero(evidence.channel == i)
        mine = mine[:: max(1, len(mine) // style.MAX_POINTS)]
        t_s = evidence.time_s[mine]
        ax.plot(
            t_s, d.shrinkage.errors_before[run][mine], ".", color=style.BEFORE, markersize=2, label="before"
        )
        ax.plot(t_s, d.shrinkage.errors_after[run][mine], ".", color=style.AFTER, markersize=2, label="after")
        style.format_axes(ax, title=f"{CHANNEL_NAMES[channel]} ({channel})")
    style.finish_grid(fig, axes)
    return fig
