"""`report.html` of a blind check, and its figure sheet."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.reports.page import figure, table, where_from, write_page
from terrafusion.fusion.reports.plots import blind as plots

Scores = Mapping[str, Any]


def write_blind(out: Path, scores: Scores, provenance: Mapping[str, object] | None = None) -> None:
    """`report.html` and `sheet.png` in the folder `out`.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    sheet = plots.plot_sheet(scores)
    write_atomically(out / "sheet.png", lambda part: sheet.savefig(part, format="png", dpi=150))
    title = f"Blind check of the diagnosis, {scores['trials']} trials"
    confusion, _ = plots.plot_confusion(scores)
    body = [
        _head(title, scores),
        _targets(scores),
        figure(
            sheet,
            "Bars are 95 % intervals (Wilson). Severity 1 is where about half of all effects are seen; a "
            "single one may be seen earlier or later.",
        ),
        _verdicts(scores),
        _effects(scores),
        "<h2>Who was taken for whom</h2>",
        figure(confusion, "True effect in rows, the effect ranked first in columns; counts of trials."),
        _shrink(scores),
        where_from(dict(provenance or {}), ("casadi", "numpy", "scipy")),
    ]
    write_page(out / "report.html", title, body)


def _head(title: str, scores: Scores) -> str:
    met = [t["met"] for t in scores["targets"]]
    lead = (
        f"Of {len(met)} targets {met.count(True)} are met, {met.count(False)} are missed, {met.count(None)} "
        f"not measured. {len(scores['crashes'])} trials ended in a crash, which counts as a wrong answer. "
        "The trials come from a plant that shares no equation with the twin; their labels were sealed until "
        "all answers stood."
    )
    return f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>'


def _targets(scores: Scores) -> str:
    words = {True: "met", False: "missed", None: "not measured"}
    rows = [
        (escape(t["name"]), number(t["value"]), f"{escape(t['sign'])} {t['target']:g}", words[t["met"]])
        for t in scores["targets"]
    ]
    return f"<h2>Targets</h2>\n{table(('', 'measured', 'target', ''), rows, (1, 2))}"


def _verdicts(scores: Scores) -> str:
    kinds = ("no_gap", "effect", "ambiguous", "parameters", "unknown", "crash")
    rows = [
        (escape(family), *(str(counts.get(kind, 0)) for kind in kinds))
        for family, counts in scores["verdicts"].items()
        if counts
    ]
    sizes = ", ".join(f"{family} {number(size)}" for family, size in scores["class_size"].items())
    note = f'<p class="dim">Mean size of the class ranked first: {escape(sizes)}.</p>'
    return f"<h2>Verdicts</h2>\n{table(('family', *kinds), rows, range(1, 7))}\n{note}"


def _effects(scores: Scores) -> str:
    rows = [
        (escape(e["effect"]), *(share(e[name]) for name in ("power", "top1", "unknown")))
        for e in scores["effects"]
    ]
    heads = ("effect", "detected", "class first, of those detected", "called unknown, of those detected")
    note = '<p class="dim">From severity 1.5 on; both kinds of drive and both forms together.</p>'
    return f"<h2>Effects</h2>\n{table(heads, rows, (1, 2, 3))}\n{note}"


def _shrink(scores: Scores) -> str:
    rows = [
        (
            escape(plots.FAMILY_WORDS[family]), number(s["mean"]), str(s["count"]),
            number(s["beside_oracle"]), number(s["oracle"]), str(s["count_oracle"]),
        )
        for family, s in scores["shrink"].items()
    ]  # fmt: skip
    heads = ("", "share of the gap gone", "trials", "same trials", "the oracle's", "trials with oracle")
    return f"<h2>Shrink</h2>\n{table(heads, rows, range(1, 6))}"


def number(value: float | None) -> str:
    """Three digits, or a dash."""
    return "–" if value is None else f"{value:.3g}"


def share(rate: Mapping[str, Any]) -> str:
    """`hits / count (low to high)`."""
    if not rate["count"]:
        return "–"
    return f"{rate['hits']} / {rate['count']} ({rate['low']:.2f} to {rate['high']:.2f})"


def summary(scores: Scores) -> list[str]:
    """The result in a few lines of text."""
    alarms = scores["false_alarms"]["all"]
    lines = [f"{scores['trials']} trials, {len(scores['crashes'])} crashes; false alarms {share(alarms)}"]
    words = {True: "met", False: "MISSED", None: "not measured"}
    width = max(len(t["name"]) for t in scores["targets"])
    return lines + [
        f"{t['name']:{width}s}  {number(t['value']):>7s}  {t['sign']} {t['target']:g}  {words[t['met']]}"
        for t in scores["targets"]
    ]
