"""Plots of a diagnosis: the gap map, ranked causes, errors before and after, the shrink."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.where import BANDS, REGIMES
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, FLOOR, SURE = "#d55e00", "#0072b2", "#7f7f7f", "#1a1a1a"
SHOWN = 8
"""Causes in the plot."""


def plot_map(d: GapDiagnosis, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Channel by regime (both bands): share of the excess error; a dot where it is significant."""
    channels = list(dict.fromkeys(c.channel for c in d.where))
    columns = [(r, b) for r, _ in REGIMES for b in BANDS]
    share = np.full((len(channels), len(columns)), np.nan)
    for cell in d.where:
        share[channels.index(cell.channel), columns.index((cell.regime, cell.band))] = 100.0 * cell.share
    fig, ax = style.canvas(ax, (10.0, 2.6 + 0.36 * len(channels)))
    image = ax.imshow(share, aspect="auto", cmap="Oranges", vmin=0.0)
    for cell in d.where:
        if cell.p_value <= d.significance:
            at = (columns.index((cell.regime, cell.band)), channels.index(cell.channel))
            ax.plot(*at, "o", color=SURE, markersize=4)
    ax.set_yticks(range(len(channels)), channels, fontsize=8)
    labels = [f"{r}\n{b}" for r, b in columns]
    ax.set_xticks(range(len(columns)), labels, rotation=55, ha="right", fontsize=7)
    fig.colorbar(image, ax=ax, label="share of the excess, %")
    return fig, ax


def plot_causes(d: GapDiagnosis, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Probability of the first causes, of an unknown one and of none."""
    rows = [(c.effect, c.probability) for c in d.verdict.causes[:SHOWN]]
    rows += [("unknown cause", d.verdict.p_unknown), ("no gap", d.verdict.p_null)]
    fig, ax = style.canvas(ax, (8.0, 1.0 + 0.32 * len(rows)))
    at = np.arange(len(rows))[::-1]
    colours = [AFTER if name in d.verdict.named else FLOOR for name, _ in rows]
    ax.barh(at, [100.0 * p for _, p in rows], color=colours, height=0.7)
    for y, (_, p) in zip(at, rows, strict=True):
        ax.text(100.0 * p + 1.0, y, f"{100.0 * p:.0f} %", va="center", fontsize=8)
    ax.set_yticks(at, [name for name, _ in rows])
    ax.set_xlim(0.0, 112.0)
    style.dress(ax, x="probability, %")
    return fig, ax


def plot_shrink(d: GapDiagnosis, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Whitened error of every channel before and after, and in the references."""
    assert d.shrinkage is not None
    names = list(d.shrinkage.channels)
    fig, ax = style.canvas(ax, (8.0, 1.2 + 0.42 * len(names)))
    at = np.arange(len(names))[::-1]
    for shift, colour, label, column in ((0.2, BEFORE, "before", 0), (-0.2, AFTER, "after", 1)):
        values = [d.shrinkage.channels[name][column] or 0.0 for name in names]
        ax.barh(at + shift, values, height=0.38, color=colour, label=label)
    floors = [d.shrinkage.channels[name][2] for name in names]
    for y, floor in zip(at, floors, strict=True):
        if floor is not None:
            ax.plot([floor, floor], [y - 0.42, y + 0.42], color=SURE, linewidth=1.5)
    if d.references:
        ax.plot([], [], color=SURE, linewidth=1.5, label="references")
    ax.set_yticks(at, names)
    ax.legend(fontsize=8, frameon=False)
    style.dress(ax, x="root mean square error, in sigmas of its noise")
    return fig, ax


def plot_errors(d: GapDiagnosis, run: int) -> Figure:
    """Whitened errors of one run over time, channel by channel, before and after."""
    from matplotlib.figure import Figure

    assert d.shrinkage is not None
    evidence, channels = d.evidence.runs[run], d.evidence.channels
    rows = (len(channels) + 1) // 2
    fig = Figure(figsize=(10.0, 1.2 + 1.5 * rows), layout="constrained")
    axes = fig.subplots(rows, 2, sharex=True, squeeze=False)
    for i, (ax, channel) in enumerate(zip(axes.flat, channels, strict=False)):
        mine = np.flatnonzero(evidence.channel == i)
        mine = mine[:: max(1, len(mine) // style.MAX_POINTS)]
        t_s = evidence.time_s[mine]
        ax.plot(t_s, d.shrinkage.errors_before[run][mine], ".", color=BEFORE, markersize=2, label="before")
        ax.plot(t_s, d.shrinkage.errors_after[run][mine], ".", color=AFTER, markersize=2, label="after")
        style.dress(ax, title=f"{CHANNEL_NAMES[channel]} ({channel})")
    for ax in axes.flat[len(channels) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel("time, s", fontsize=9)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return fig
