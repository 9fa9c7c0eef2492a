"""`report.html` of a blind check, and its summary as text."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.sheet import Sheet, name_ticks

Scores = Mapping[str, Any]
VERDICTS = ["no_gap", "effect", "ambiguous", "parameters", "unknown", "crash"]
TILES = ("false alarms, same drives", "power at d' 25", "right and not unknown, same form")
MET = {True: "met", False: "missed", None: ""}
METHOD_COLOURS = {"diagnosis": "#0072b2", "opponent": "#d55e00"}
FORMS = {"same": "same form", "shifted": "form-shifted"}
NAMED = {"right": "right and not unknown", "top1": "class top-1", "top3": "class top-3"}
ALARM_TARGET = 0.05
CELL_PX = 19


def write_blind(out: Path, scores: Scores, provenance: Mapping[str, object] | None = None) -> None:
    """`report.html` in the folder `out`; a TerrafusionError where that cannot be written."""
    sheet = Sheet()
    draw(sheet, scores)
    own = scores["figures"]["diagnosis"]
    lead = (
        f"{len(own['crashes'])} trials ended in a crash, which counts as a wrong answer. "
        "The trials come from a plant that shares no equation with the twin; a salted hash of their labels "
        f"was written before the answers. Plant {plant_name(scores)}."
    )
    write_page(
        out / "report.html", "blind.html.j2", f"Blind check of the diagnosis, {scores['trials']} trials",
        lead=lead, verdicts=[_verdict(scores)], tiles=_tiles(scores), provenance=provenance,
        packages=TWIN_LIBRARIES,
        methods=list(scores["figures"]),
        headline=_headline(scores),
        kinds=VERDICTS,
        families=[
            [family, *(str(counts.get(kind, 0)) for kind in VERDICTS)]
            for family, counts in own["verdicts"].items()
            if counts
        ],
        settings=[
            [setting, *(measured({"value": rate["rate"], **rate}) for rate in (
                own["false_alarms"][setting], effects["power"], effects["right"]))]
            for setting, effects in own["settings"].items()
        ],
        **sheet.parts(),
    )  # fmt: skip


def _verdict(scores: Scores) -> VerdictBox:
    """How many targets are met, and a sentence for each that is missed."""
    aimed = [row for row in scores["headline"] if row["target"]]
    met = [row["diagnosis"]["met"] for row in aimed]
    reasons = [
        f"Missed: {row['name']}: {measured(row['diagnosis'])}, target {target_text(row['target'])}."
        for row in aimed
        if row["diagnosis"]["met"] is False
    ]
    value = "not_to_be_used" if reasons else "doubtful" if None in met else "good"
    counts = f"{len(reasons)} missed, {met.count(None)} not measured"
    title = f"{met.count(True)} of {len(met)} targets are met, {counts}"
    return VerdictBox(value, title, reasons)


def _tiles(scores: Scores) -> list[Tile]:
    """The figures of `TILES`."""
    rows = {row["name"]: row for row in scores["headline"]}
    return [
        Tile(
            name, rounded(rows[name]["diagnosis"]["value"]),
            f"{measured(rows[name]['diagnosis'])}, target {target_text(rows[name]['target'])}",
        )
        for name in TILES
    ]  # fmt: skip


def plant_name(scores: Scores) -> str:
    """First twelve digits of the plant's hash."""
    return str(scores.get("plant_sha256", "unknown"))[:12]


def rounded(value: float | None) -> str:
    """Three digits, or a dash."""
    return "–" if value is None else f"{value:.3g}"


def measured(found: Mapping[str, Any]) -> str:
    """`hits of count (low to high)` of a rate, else the value."""
    if not found.get("count"):
        return rounded(found["value"])
    return f"{found['hits']} of {found['count']} ({found['low']:.2f} to {found['high']:.2f})"


def target_text(target: list[float] | None) -> str:
    """`<= 0.1`, `>= 0.9`, or a range."""
    if target is None:
        return ""
    low, high = target
    if low in (0.0, 1.0) and high != 1.0:
        return f"<= {high:g}"
    return f">= {low:g}" if high == 1.0 else f"{low:g} to {high:g}"


def summary(scores: Scores) -> list[str]:
    """The headline as text: a figure, its 95 % interval, the same of the opponent, the target."""
    methods = list(scores["figures"])
    crashes = ", ".join(f"{len(f['crashes'])} of the {m}" for m, f in scores["figures"].items())
    lines = text_table(["", *methods, "target", ""], _headline(scores))
    count = f"{scores['trials']} of {scores.get('planned', scores['trials'])}"
    return [f"{count} trials of plant {plant_name(scores)}; crashes: {crashes}", *lines]


def _headline(scores: Scores) -> list[list[str]]:
    return [
        [
            row["name"], *(measured(row[method]) for method in scores["figures"]), target_text(row["target"]),
            MET[row["diagnosis"]["met"]],
        ]
        for row in scores["headline"]
    ]  # fmt: skip


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
