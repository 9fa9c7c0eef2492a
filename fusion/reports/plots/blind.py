"""Plots of a blind check: power, ranks, calibration of the confidence, other claims, confusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.fusion.reports.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FAMILY_COLOURS = {"same": "#0072b2", "shifted": "#d55e00", "outside": "#009e73", "pair": "#cc79a7"}
FAMILY_LABELS = {
    "same": "same form", "shifted": "form-shifted", "outside": "out of catalogue", "pair": "pairs",
}  # fmt: skip
DASHES = {"exciting": "-", "gentle": "--"}
NAMING_TARGETS = {
    ("top1", "same"): 0.95, ("top3", "same"): 0.98, ("top1", "shifted"): 0.90, ("top3", "shifted"): 0.95,
}  # fmt: skip
Scores = Mapping[str, Any]
Bar = tuple[str, Mapping[str, Any], float | None, str]
"""Label, rate, target and family."""


def plot_sheet(scores: Scores) -> Figure:
    """Four panels: power by severity, first ranks, calibration of the confidence, other claims."""
    fig, axes = style.canvases(2, (11.0, 8.0), 2, sharex=False)
    for draw, ax in zip((plot_power, plot_ranks, plot_reliability, plot_claims), axes, strict=True):
        draw(scores, ax)
    fig.suptitle(f"{scores['trials']} trials, plant {plant_name(scores)}", fontsize="small")
    return fig


def plant_name(scores: Scores) -> str:
    """First twelve digits of the plant's hash."""
    return str(scores.get("plant_sha256", "unknown"))[:12]


def plot_power(scores: Scores, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Share detected over severity, one line a family and drive; the false alarms are at zero."""
    fig, ax = style.canvas(ax, (6.0, 4.0))
    shift = 0.0
    for family, colour in FAMILY_COLOURS.items():
        for drive, dash in DASHES.items():
            cells = [c for c in scores["power"] if (c["family"], c["drive"]) == (family, drive)]
            if not cells:
                continue
            x = np.array([c["severity"] for c in cells]) + shift
            label = f"{FAMILY_LABELS[family]}, {drive}"
            _rates(ax, x, cells, fmt="o" if len(cells) == 1 else f"o{dash}", color=colour, label=label)
            shift += 0.02
    alarms = scores["false_alarms"]
    for drive in (d for d in DASHES if d in alarms):
        label = f"no effect, {drive}"
        _rates(ax, [shift - 0.1], [alarms[drive]], fmt="s", color=style.NEUTRAL, label=label)
        shift += 0.05
    ax.axhline(0.05, color=style.NEUTRAL, linewidth=0.8, linestyle=":")
    ax.set_ylim(-0.03, 1.38)  # room for the legend above all bars
    ax.set_yticks(np.linspace(0.0, 1.0, 6))
    ax.legend(fontsize=7, frameon=False, loc="upper left", ncol=3)
    style.format_axes(ax, x="severity, half-power points", y="share detected", title="Detected")
    return fig, ax


def plot_ranks(scores: Scores, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Share of detected trials whose truth is the first, or among the first three, classes."""
    kinds = (("top1_effect", "the effect itself"), ("top1", "class, top 1"), ("top3", "class, top 3"))
    bars = [
        (
            f"{label}\n{FAMILY_LABELS[family]}",
            scores[name][family],
            NAMING_TARGETS.get((name, family)),
            family,
        )
        for family in ("same", "shifted")
        for name, label in kinds
    ]
    return _bars(ax, bars, "share of detected trials", "Named (black line: target)")


def plot_reliability(scores: Scores, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Share that was right over stated confidence, dots as large as their count."""
    fig, ax = style.canvas(ax, (6.0, 4.0))
    ax.plot([0, 1], [0, 1], color=style.NEUTRAL, linewidth=0.8)
    for family in ("same", "shifted"):
        confidence = scores["confidence"][family]
        if not confidence["bins"]:
            continue
        stated, true, count = np.array(confidence["bins"]).T
        label = f"{FAMILY_LABELS[family]}: ECE {confidence['ece']:.3f}, Brier {confidence['brier']:.3f}"
        ax.plot(stated, true, "-", color=FAMILY_COLOURS[family], linewidth=1.0)
        ax.scatter(stated, true, s=10.0 + 4.0 * count, color=FAMILY_COLOURS[family], label=label, alpha=0.7)
    ax.set_xlim(0.0, 1.03)
    ax.set_ylim(-0.03, 1.05)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, frameon=False, loc="lower right")
    x, y = "stated confidence of the first class", "share that was right"
    style.format_axes(ax, x=x, y=y, title="Confidence")
    return fig, ax


def plot_claims(scores: Scores, ax: Axes | None = None) -> tuple[Figure, Axes]:
    """Unknown where it is true and where it is not, and pairs."""
    unknown, pairs = scores["unknown"], scores["pairs"]
    bars: list[Bar] = [
        ("unknown,\nout of catalogue", unknown["recall"], 0.90, "outside"),
        ("unknown,\nsame form", unknown["false_same"], 0.10, "same"),
        ("unknown,\nform-shifted", unknown["false_shifted"], 0.10, "shifted"),
        ("pair:\nboth", pairs["both"], 0.80, "pair"),
        ("pair:\nat least one", pairs["at_least_one"], None, "pair"),
    ]
    return _bars(ax, bars, "share of trials", "Unknown and pairs (black line: target)")


def plot_confusion(scores: Scores) -> Figure:
    """Confusion matrix: true effects in rows, the effect ranked first in columns, counts in cells."""
    table = scores["confusion"]
    rows, answers = list(table), {name for counts in table.values() for name in counts}
    columns = [name for name in rows if name in answers] + sorted(answers - set(rows))
    values = np.array([[table[row].get(column, 0) for column in columns] for row in rows], dtype=float)
    share = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    fig, ax = style.canvas(None, (2.5 + 0.24 * len(columns), 2.2 + 0.2 * len(rows)))
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


def _bars(ax: Axes | None, bars: Sequence[Bar], y: str, title: str) -> tuple[Figure, Axes]:
    """Rates with their intervals; a black line is a target."""
    fig, ax = style.canvas(ax, (6.0, 4.0))
    for at, (_, rate, target, family) in enumerate(bars):
        ax.bar(at, rate["rate"] or 0.0, color=FAMILY_COLOURS[family], width=0.7)
        if rate["rate"] is not None:
            _rates(ax, [at], [rate], fmt="none", ecolor="black")
        if target is not None:
            ax.plot([at - 0.4, at + 0.4], [target, target], color="black", linewidth=1.5)
    ax.set_ylim(0.0, 1.05)
    style.format_axes(ax, y=y, title=title)
    ax.set_xticks(range(len(bars)), [label for label, *_ in bars])
    ax.tick_params(axis="x", labelsize=7)
    return fig, ax
