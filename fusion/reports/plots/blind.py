"""Plots of a blind check: power, false alarms by setting, naming, confidence, confusion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, name_ticks

METHOD_COLOURS = {"diagnosis": "#0072b2", "opponent": "#d55e00"}
FORMS = {"same": "same form", "shifted": "form-shifted"}
NAMED = {"right": "right and not unknown", "top1": "class top-1", "top3": "class top-3"}
ALARM_TARGET = 0.05
CELL_PX = 19
Scores = Mapping[str, Any]


def draw(sheet: Sheet, scores: Scores) -> None:
    """All figures of a check."""
    figures = scores["figures"]
    power = {
        method: {
            f"d' {float(d):g}, {form}": rate
            for family, form in FORMS.items()
            for d, rate in found["power"][family].items()
        }
        for method, found in figures.items()
    }
    plot_rates(sheet, "power", "share of trials whose change is detected", power)
    alarms = {method: found["false_alarms"] for method, found in figures.items()}
    plot_rates(sheet, "alarms", "share of trials without a change", alarms, ALARM_TARGET)
    named = {
        method: {
            f"{label}, {form}": found[name][family]
            for name, label in NAMED.items()
            for family, form in FORMS.items()
        }
        for method, found in figures.items()
    }
    plot_rates(sheet, "named", "share of detected trials", named)
    plot_reliability(sheet, figures["diagnosis"]["confidence"])
    plot_confusion(sheet, figures["diagnosis"]["confusion"])


def plot_rates(
    sheet: Sheet, key: str, about: str, rates: Mapping[str, Mapping[str, Any]], target: float | None = None
) -> None:  # fmt: skip
    """A named rate a row with its interval, of each method; a line at the target."""
    names = list(next(iter(rates.values())))
    plot = sheet.add_rows(f"rows {key}", about, names, 20 + 16 * len(rates), x_range=(-0.02, 1.02))
    if target is not None:
        edge = np.array([-0.5, len(names) - 0.5])
        plot.line(np.full(2, target), edge, "target", style.TRUTH_ON_ANY, dash="dotted")
    for k, (method, found) in enumerate(rates.items()):
        known = [i for i, name in enumerate(names) if found[name]["rate"] is not None]
        rows = np.array(known, dtype=float) + 0.3 * (k - 0.5 * (len(rates) - 1))
        some = [found[names[i]] for i in known]
        value, low, high = (np.array([rate[word] for rate in some]) for word in ("rate", "low", "high"))
        text = [f"{r['hits']} of {r['count']} ({r['low']:.2f} to {r['high']:.2f})" for r in some]
        plot.intervals(rows, value, low, high, method, METHOD_COLOURS[method], text=text)


def plot_reliability(sheet: Sheet, confidence: Mapping[str, Any]) -> None:
    """Share that was right over stated confidence of the diagnosis, dots as large as their count."""
    limits: dict[str, Any] = {"x_range": (-0.03, 1.03), "y_range": (-0.03, 1.05)}
    plot = sheet.add("p confidence", "stated confidence in the first class", "share that was right", **limits)
    ends = np.array([0.0, 1.0])
    plot.line(ends, ends, "as stated", style.TRUTH_ON_ANY, width=1.0)
    for family, colour in zip(FORMS, (style.AFTER, style.BEFORE), strict=True):
        if not confidence[family]["bins"]:
            continue
        stated, true, count = np.array(confidence[family]["bins"]).T
        numbers = "ECE {ece:.3f}, Brier {brier:.3f}".format(**confidence[family])
        label = f"{FORMS[family]}: {numbers}"
        plot.line(stated, true, label, colour)
        data = {"x": stated, "y": true, "size": 4.0 + 2.0 * np.sqrt(count)}
        tips = {"stated": "@x{0.##}", "right": "@y{0.##}", "trials": "@count"}
        more = {"count": count.astype(int)}
        plot.glyph("scatter", data, label, colour, "line", more=more, tips=tips, fill_alpha=0.5)


def plot_confusion(sheet: Sheet, table: Mapping[str, Mapping[str, int]]) -> None:
    """True effects in rows, the effect ranked first in columns, coloured by the share of the row."""
    from bokeh.palettes import Blues256

    rows, answers = list(table), {name for counts in table.values() for name in counts}
    columns = [name for name in rows if name in answers] + sorted(answers - set(rows))
    if not columns:
        return
    values = np.array([[table[row].get(column, 0) for column in columns] for row in rows], dtype=float)
    share = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    x, y = (np.arange(-0.5, n) for n in (len(columns), len(rows)))
    plot = sheet.add_rows("cells confusion", "ranked first", rows, CELL_PX, x_range=(x[0], x[-1]))
    fig = plot.panel.figure
    fig.height += 150
    plot.panel.height = fig.height
    texts = [
        f"{count:.0f} of {total:.0f}: {row} ranked as {column}"
        for row, counts, total in zip(rows, values, values.sum(axis=1), strict=True)
        for column, count in zip(columns, counts, strict=True)
    ]
    plot.cells(x, y, np.where(values > 0, share, np.nan), Blues256[::-1][40:], limits=(0.0, 1.0), texts=texts)
    name_ticks(fig.xaxis, columns)
    fig.xaxis.major_label_orientation = 1.2
    fig.xgrid.visible = False
