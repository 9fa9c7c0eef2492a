"""Plots of a diagnosis: paths, the gap map, ranked causes, errors before and after the effect is added."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.reports.plots import style
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.where import BANDS, REGIMES, regimes
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES, CHANNEL_UNITS, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, physical_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MOST_CAUSES = 8
PLACE_S = 0.5
"""Interval of a path that is drawn as one point."""
LEAST_SIDE = 0.5
"""Shorter side of the frame of a path over its longer one."""
ALIKE = "#9ecae1"


def plot_map(d: GapDiagnosis) -> Figure:
    """Channel by regime (both bands): share of the excess error; a dot where it is significant."""
    channels = list(dict.fromkeys(c.channel for c in d.where))
    columns = [(r, b) for r, _ in REGIMES for b in BANDS]
    share = np.full((len(channels), len(columns)), np.nan)
    fig, ax = style.canvas((10.0, 2.6 + 0.36 * len(channels)))
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
    """Share of the gap that each of the first causes explains by itself; its probability beside it."""
    causes = [c for c in d.verdict.causes if c.share is not None][:MOST_CAUSES]
    fig, ax = style.canvas((8.0, 1.0 + 0.32 * len(causes)))
    alike = {name for s in d.verdict.sets if s.named for name in s.effects}
    at = np.arange(len(causes))[::-1]
    shares = [100.0 * float(np.clip(c.share or 0.0, 0.0, 1.0)) for c in causes]
    colours = [
        style.AFTER if c.effect in d.verdict.named else ALIKE if c.effect in alike else style.NEUTRAL
        for c in causes
    ]
    ax.barh(at, shares, color=colours, height=0.7)
    for y, share, c in zip(at, shares, causes, strict=True):
        ax.text(share + 1.0, y, f"probability {100.0 * c.probability:.1f} %", va="center", fontsize=8)
    ax.set_yticks(at, [c.effect for c in causes])
    ax.set_xlim(0.0, 130.0)
    ax.set_xticks(range(0, 101, 20))
    style.format_axes(ax, x="share of the gap that it explains by itself, %")
    return fig


def plot_path(d: GapDiagnosis, most: int) -> Figure:
    """Path of each judged run, coloured by the error of the first place's channel, its regime ringed."""
    place, runs = next(iter(d.where), None), d.evidence.runs[:most]
    fig, axes = style.canvases(1, (3.4 * len(runs) + 1.2, 3.8), len(runs), sharex=False)
    name = place.channel if place is not None else CHANNEL_NAMES[d.evidence.channels[0]]
    drawn = [_place_errors(d, i, name) for i in range(len(runs))]
    top = max((float(np.quantile(e, 0.98)) for _, _, e in drawn if len(e)), default=1.0)
    for ax, run, (at, t_s, error) in zip(axes, runs, drawn, strict=True):
        ax.plot(at[:, 0], at[:, 1], "-", color=style.EXPECTED, linewidth=1.0)
        if place is not None:
            index = [r for r, _ in REGIMES].index(place.regime)
            known = np.interp(t_s, run.time_s[np.argsort(run.time_s)], _in_regime(d, run, index)) > 0.5
            ax.plot(at[known, 0], at[known, 1], "o", color=style.TRUTH, markersize=7, fillstyle="none")
        points = ax.scatter(at[:, 0], at[:, 1], c=error, s=14, cmap="YlOrRd", vmin=0.0, vmax=top, zorder=3)
        x, y = _limits(at)
        ax.set(xlim=x, ylim=y, aspect="equal")
        style.format_axes(ax, x="x, m", y="y, m", title=Path(run.name).name)
    fig.colorbar(points, ax=axes, label=f"{name}: RMS error of {PLACE_S:g} s, {CHANNEL_UNITS[name]}")
    return fig


def _limits(at: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of both axes of a path (N, 2), m; a straight one is not drawn on a line."""
    low, high = at.min(axis=0), at.max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * (high - low)
    half = np.maximum(half, max(LEAST_SIDE * float(half.max()), 0.5))
    (x0, y0), (x1, y1) = (middle - half).tolist(), (middle + half).tolist()
    return (x0, x1), (y0, y1)


def _in_regime(d: GapDiagnosis, run: WhitenedRun, index: int) -> Array:
    return (regimes(run, d.evidence.model) == index).astype(float)[np.argsort(run.time_s)]


def _place_errors(d: GapDiagnosis, i: int, name: str) -> tuple[Array, Array, Array]:
    """Positions (n, 2), times (n,) and root mean squares (n,) of a channel's error by interval of a run."""
    run = d.evidence.runs[i]
    error = physical_error(run, d.evidence.noise, d.shrinkage.errors_before[i])
    mine = np.isin(run.channel, [k for k, c in enumerate(d.evidence.channels) if CHANNEL_NAMES[c] == name])
    _, group = np.unique(np.floor(run.time_s[mine] / PLACE_S), return_inverse=True)
    count = np.maximum(np.bincount(group), 1)
    t_s = np.bincount(group, run.time_s[mine]) / count
    return _positions(d, run, t_s), t_s, np.sqrt(np.bincount(group, error[mine] ** 2) / count)


def _positions(d: GapDiagnosis, run: WhitenedRun, t_s: Array) -> Array:
    """Positions (n, 2) at times: fixes; without any, the commands integrated."""
    fixes = {o.channel: o for o in run.log.observed if o.channel in ("gnss_east_m", "gnss_north_m")}
    if len(fixes) == 2:
        return np.stack([np.interp(t_s, o.end_s, o.value - o.value[0]) for o in fixes.values()], axis=1)
    grid, twist = commanded_twist(run.log, d.evidence.model)
    step = float(grid[1] - grid[0])
    yaw = np.cumsum(twist[:, 1]) * step
    path = [np.cumsum(twist[:, 0] * f(yaw)) * step for f in (np.cos, np.sin)]
    return np.stack([np.interp(t_s, grid, x) for x in path], axis=1)


def plot_shrink(d: GapDiagnosis) -> Figure:
    """Error of every channel before and after, and in the references, in sigmas and in its unit."""
    names, rows = list(d.shrinkage.channels), list(d.shrinkage.channels.values())
    fig, ax = style.canvas((9.0, 1.2 + 0.42 * len(names)))
    at = np.arange(len(names))[::-1]
    for shift, colour, label, k in ((0.2, style.BEFORE, "before", 0), (-0.2, style.AFTER, "after", 1)):
        ax.barh(at + shift, [row[k] or 0.0 for row in rows], height=0.38, color=colour, label=label)
    for y, name, row in zip(at, names, rows, strict=True):
        before, after, _ = d.shrinkage.physical[name]
        text = f"{before:.2g} \u2192 {after:.2g} {CHANNEL_UNITS[name]}"
        ax.text(max(x or 0.0 for x in row), y, f"  {text}", va="center", fontsize=8)
        if row[2] is not None:
            ax.plot([row[2], row[2]], [y - 0.42, y + 0.42], color=style.TRUTH, linewidth=1.5)
    if d.references:
        ax.plot([], [], color=style.TRUTH, linewidth=1.5, label="references")
    ax.set_yticks(at, names)
    ax.set_xlim(0.0, 1.3 * max(x or 0.0 for row in rows for x in row))
    ax.legend(fontsize=8, frameon=False, loc="lower right")
    style.format_axes(ax, x="root mean square error, in sigmas of its noise; numbers: in its unit")
    return fig


def plot_errors(d: GapDiagnosis, run: int) -> Figure:
    """Errors of one run over time in the units of the channels, before and after."""
    evidence, channels = d.evidence.runs[run], d.evidence.channels
    fig, axes = style.channel_grid(len(channels), 1.5, 1.2)
    arms = [
        (label, colour, physical_error(evidence, d.evidence.noise, errors[run]))
        for label, colour, errors in (
            ("before", style.BEFORE, d.shrinkage.errors_before),
            ("after", style.AFTER, d.shrinkage.errors_after),
        )
    ]
    for i, (ax, channel) in enumerate(zip(axes, channels, strict=True)):
        mine = np.flatnonzero(evidence.channel == i)
        mine = mine[:: max(1, len(mine) // style.MAX_POINTS)]
        for label, colour, error in arms:
            ax.plot(evidence.time_s[mine], error[mine], ".", color=colour, markersize=2, label=label)
        style.format_axes(ax, title=f"{channel.rsplit('_', 1)[0]}, {CHANNEL_UNITS[CHANNEL_NAMES[channel]]}")
    style.finish_grid(fig, axes)
    return fig
