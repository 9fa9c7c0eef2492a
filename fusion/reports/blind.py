"""`report.html` of a blind check, its figure sheet, and its summary as text."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.fusion.reports.page import TWIN_LIBRARIES, write_page, write_png
from terrafusion.fusion.reports.plots import blind as plots

Scores = Mapping[str, Any]
VERDICTS = ["no_gap", "effect", "ambiguous", "parameters", "unknown", "crash"]
MET = {True: "met", False: "missed", None: "not measured"}


def write_blind(out: Path, scores: Scores, provenance: Mapping[str, object] | None = None) -> None:
    """`report.html` and `sheet.png` in the folder `out`.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    sheet = plots.plot_sheet(scores)
    write_png(out / "sheet.png", sheet)
    met = [t["met"] for t in scores["targets"]]
    lead = (
        f"Of {len(met)} targets {met.count(True)} are met, {met.count(False)} are missed, {met.count(None)} "
        f"not measured. {len(scores['crashes'])} trials ended in a crash, which counts as a wrong answer. "
        "The trials come from a plant that shares no equation with the twin; their labels were sealed until "
        f"all answers were in. Plant {plots.plant_name(scores)}."
    )
    write_page(
        out / "report.html", "blind.html.j2", f"Blind check of the diagnosis, {scores['trials']} trials",
        lead=lead, provenance=provenance, packages=TWIN_LIBRARIES,
        targets=[
            [t["name"], rounded(t["value"]), f"{t['sign']} {t['target']:g}", MET[t["met"]]]
            for t in scores["targets"]
        ],
        sheet=sheet, kinds=VERDICTS,
        verdicts=[
            [family, *(str(counts.get(kind, 0)) for kind in VERDICTS)]
            for family, counts in scores["verdicts"].items()
            if counts
        ],
        class_sizes=", ".join(f"{family} {rounded(size)}" for family, size in scores["class_size"].items()),
        effects=[
            [e["effect"], *(rate_text(e[name]) for name in ("power", "top1", "unknown"))]
            for e in scores["effects"]
        ],
        confusion=plots.plot_confusion(scores),
        shrink=[_shrink_row(plots.FAMILY_LABELS[family], s) for family, s in scores["shrink"].items()],
    )  # fmt: skip


def rounded(value: float | None) -> str:
    """Three digits, or a dash."""
    return "–" if value is None else f"{value:.3g}"


def rate_text(rate: Mapping[str, Any]) -> str:
    """`hits / count (low to high)`."""
    if not rate["count"]:
        return "–"
    return f"{rate['hits']} / {rate['count']} ({rate['low']:.2f} to {rate['high']:.2f})"


def summary(scores: Scores) -> list[str]:
    """The result in a few lines of text."""
    alarms = rate_text(scores["false_alarms"]["all"])
    plant, crashes = plots.plant_name(scores), len(scores["crashes"])
    lines = [f"{scores['trials']} trials of plant {plant}, {crashes} crashes; false alarms {alarms}"]
    width = max(len(t["name"]) for t in scores["targets"])
    for t in scores["targets"]:
        met = "MISSED" if t["met"] is False else MET[t["met"]]
        lines.append(f"{t['name']:{width}s}  {rounded(t['value']):>7s}  {t['sign']} {t['target']:g}  {met}")
    return lines


def _shrink_row(label: str, s: Mapping[str, Any]) -> list[str]:
    mean, same, oracle = (rounded(s[key]) for key in ("mean", "beside_oracle", "oracle"))
    return [label, mean, str(s["count"]), same, oracle, str(s["count_oracle"])]
