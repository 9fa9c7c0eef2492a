"""`report.html` of a blind check, and its summary as text."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page
from terrafusion.fusion.reports.plots import blind as plots
from terrafusion.fusion.reports.plots.sheet import Sheet

Scores = Mapping[str, Any]
VERDICTS = ["no_gap", "effect", "ambiguous", "parameters", "unknown", "crash"]
TILES = ("false alarms, same drives", "power at d' 25", "right and not unknown, same form")
MET = {True: "met", False: "missed", None: ""}


def write_blind(out: Path, scores: Scores, provenance: Mapping[str, object] | None = None) -> None:
    """`report.html` in the folder `out`.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    sheet = Sheet()
    plots.draw(sheet, scores)
    own = scores["figures"]["diagnosis"]
    lead = (
        f"{len(own['crashes'])} trials ended in a crash, which counts as a wrong answer. "
        "The trials come from a plant that shares no equation with the twin; their labels were sealed until "
        f"all answers were in. Plant {plant_name(scores)}."
    )
    write_page(
        out / "report.html", "blind.html.j2", f"Blind check of the diagnosis, {scores['trials']} trials",
        lead=lead, verdicts=[_verdict(scores)], tiles=_tiles(scores), provenance=provenance,
        packages=TWIN_LIBRARIES,
        methods=list(scores["figures"]),
        headline=[
            [row["name"], *(measured(row[m]) for m in scores["figures"]), target_text(row["target"]),
             MET[row["diagnosis"]["met"]]]
            for row in scores["headline"]
        ],
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
    rows = [
        [row["name"], *(measured(row[m]) for m in methods), target_text(row["target"]),
         MET[row["diagnosis"]["met"]]]
        for row in scores["headline"]
    ]  # fmt: skip
    lines = text_table(["", *methods, "target", ""], rows)
    count = f"{scores['trials']} of {scores.get('planned', scores['trials'])}"
    return [f"{count} trials of plant {plant_name(scores)}; crashes: {crashes}", *lines]
