"""Plots of a blind check: power, false alarms by setting, calibration of the confidence, confusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METHOD_COLOURS = {"diagnosis": "#0072b2", "opponent": "#d55e00"}
DASHES = {"same": "-", "shifted": "--"}
NAMED = {"right": "right and\nnot unknown", "top1": "class\ntop-1", "top3": "class\ntop-3"}
Scores = Mapping[str, Any]


def plot_sheet(scores: Scores) -> Figure:
    """Four panels: power by d', false alarms by setting, naming, calibration of the confidence."""
    fig, axes = style.canvases(2, (11.0, 8.0), 2, sharex=False)
    for draw, ax in zip((plot_power, plot_alarms, plot_named, plot_reliability), axes, strict=True):
        draw(scores, ax)
    fig.suptitle(f"{scores['trials']} trials, plant {plant_name(scores)}", fontsize="small")
    return fig


def plant_name(scores: Scores) -> str:
    """First twelve digits of the plant's hash."""
    return str(scores.get("plant_sha256", "unknown"))[:12]


def plot_power(scores: Scores, ax: Axes) -> None:
    """Share detected over d' of the oracle, one line a method and form."""
    shift = 0.97
    for method, figures in scores["figures"].items():
        for family, dash in DASHES.items():
            cells = figures["power"][family]
            x = shift * np.array([float(d) for d in cells])
            label = f"{method}, {'same form' if family == 'same' else 'form-shifted'}"
            _rates(ax, x, list(cells.values()), fmt=f"o{dash}", color=METHOD_COLOURS[method], label=label)
            shift *= 1.02
    ax.set_xscale("log")
    ax.minorticks_off()
    ax.set_xticks([5, 10, 25], ["5", "10", "25"])
    ax.set_ylim(-0.03, 1.05)
    ax.legend(fontsize=7, frameon=False, loc="lower right")
    style.format_axes(ax, x="d' of the oracle", y="share detected", title="Detected")


def plot_alarms(scores: Scores, ax: Axes) -> None:
    """False alarms by setting."""
    names = list(scores["figures"]["diagnosis"]["false_alarms"])
    for k, (method, figures) in enumerate(scores["figures"].items()):
        rates, at = list(figures["false_alarms"].values()), np.arange(len(names)) + 0.2 * k
        _rates(ax, at, rates, fmt="o", color=METHOD_COLOURS[method], label=method)
    ax.axhline(0.05, color=style.NEUTRAL, linewidth=0.8, linestyle=":")
    _legend_above(ax)
    style.format_axes(ax, y="share of trials without effect", title="False alarms (dotted: target)")
    ax.set_xticks(range(len(names)), names, rotation=40, ha="right")
    ax.tick_params(axis="x", labelsize=7)


def plot_named(scores: Scores, ax: Axes) -> None:
    """Share of detected trials whose truth is named."""
    labels = [f"{label}\n{family}" for label in NAMED.values() for family in DASHES]
    for k, (method, figures) in enumerate(scores["figures"].items()):
        rates = [figures[name][family] for name in NAMED for family in DASHES]
        at = np.arange(len(rates)) + 0.2 * k
        _rates(ax, at, rates, fmt="o", color=METHOD_COLOURS[method], label=method)
    _legend_above(ax)
    style.format_axes(ax, y="share of detected trials", title="Named")
    ax.set_xticks(range(len(labels)), labels)
    ax.tick_params(axis="x", labelsize=7)


def plot_reliability(scores: Scores, ax: Axes) -> None:
    """Share that was right over stated confidence of the diagnosis, dots as large as their count."""
    ax.plot([0, 1], [0, 1], color=style.NEUTRAL, linewidth=0.8)
    for family, dash in DASHES.items():
        confidence = scores["figures"]["diagnosis"]["confidence"][family]
        if not confidence["bins"]:
            continue
        stated, true, count = np.array(confidence["bins"]).T
        label = f"{family}: ECE {confidence['ece']:.3f}, Brier {confidence['brier']:.3f}"
        ax.plot(stated, true, dash, color=METHOD_COLOURS["diagnosis"], linewidth=1.0, label=label)
        ax.scatter(stated, true, s=10.0 + 4.0 * count, color=METHOD_COLOURS["diagnosis"], alpha=0.7)
    ax.set_xlim(0.0, 1.03)
    ax.set_ylim(-0.03, 1.05)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, frameon=False, loc="lower right")
    x, y = "stated confidence of the first class", "share that was right"
    style.format_axes(ax, x=x, y=y, title="Confidence")


def plot_confusion(table: Mapping[str, Mapping[str, int]]) -> Figure:
    """Confusion matrix: true effects in rows, the effect ranked first in columns, counts in cells."""
    rows, answers = list(table), {name for counts in table.values() for name in counts}
    columns = [name for name in rows if name in answers] + sorted(answers - set(rows))
    values = np.array([[table[row].get(column, 0) for column in columns] for row in rows], dtype=float)
    share = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    fig, ax = style.canvas((2.5 + 0.24 * len(columns), 2.2 + 0.2 * len(rows)))
    ax.imshow(share, vmin=0.0, vmax=1.0, cmap="Blues", aspect="auto")
    for (i, j), count in np.ndenumerate(values):
        if count:
            colour = "white" if share[i, j] > 0.6 else "black"
            ax.text(j, i, f"{count:.0f}", ha="center", va="center", fontsize=6, color=colour)
    ax.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    ax.set_yticks(range(len(rows)), rows, fontsize=7)
    ax.set_xlabel("ranked first", fontsize=9)
    ax.set_ylabel("true", fontsize=9)
    return fig


def _rates(ax: Axes, x: Any, rates: Sequence[Mapping[str, Any]], **options: Any) -> None:
    y = np.array([r["rate"] if r["rate"] is not None else np.nan for r in rates])
    bars = np.array([[v - r["low"], r["high"] - v] for v, r in zip(y, rates, strict=True)]).T
    ax.errorbar(x, y, yerr=np.maximum(bars, 0.0), markersize=4, linewidth=1.2, capsize=2, **options)


def _legend_above(ax: Axes) -> None:
    """Shares from 0 to 1, and room for the legend over them."""
    ax.set_ylim(-0.03, 1.2)
    ax.set_yticks(np.linspace(0.0, 1.0, 6))
    ax.legend(fontsize=7, frameon=False, loc="upper left", ncol=2)
