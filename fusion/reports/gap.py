"""The files of a diagnosis: `diagnosis.json`, `judge.json` with the estimator's gap, and `report.html`."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.fusion.benchmark.estimator_gap import Compared
from terrafusion.fusion.reports.gap_text import (
    alternatives_text,
    named_sets,
    numbers,
    percent,
    sections,
    verdict_line,
)
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page, write_text
from terrafusion.fusion.reports.plots import gap as plots
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.verdict import LEAST_PROBABILITY
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_UNITS

MOST_RUNS = 3
"""Runs beyond these have no plots of their own."""
MOST_CAUSES = 12
MOST_PLACES = 10


def write_diagnosis(
    out: Path,
    d: GapDiagnosis,
    provenance: Mapping[str, object] | None = None,
    judged: tuple[Sequence[Compared], Sequence[str]] | None = None,
) -> None:
    """All files in the folder `out`, numbers first.

    Args:
        judged: the estimator's gap, and the logs that could not be replayed.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    scores, failed = judged or ((), ())
    write_text(out / "diagnosis.json", json.dumps(d.to_json(), indent=1, allow_nan=False) + "\n")
    if judged is not None:
        write_text(out / "judge.json", json.dumps(judge_rows(scores), indent=1, allow_nan=False) + "\n")
    sheet = Sheet()
    paths = plots.plot_paths(sheet, d, MOST_RUNS) if d.detected else []
    if d.where:
        plots.plot_map(sheet, d)
    if d.detected:
        plots.plot_causes(sheet, d)
    plots.plot_shrink(sheet, d)
    errors = {name: plots.plot_errors(sheet, d, i) for i, name in enumerate(d.runs[:MOST_RUNS])}
    write_page(
        out / "report.html", "gap.html.j2", f"Gap between {d.vehicle} and its twin",
        verdicts=[VerdictBox(_value(d), verdict_line(d), ())], tiles=_tiles(d),
        sections=sections(d), provenance=provenance, packages=TWIN_LIBRARIES, where=_where(d),
        causes=_causes(d), drives=_drives(d),
        sets=[
            (alternatives_text(s), percent(s.probability), "yes" if s.named else "no")
            for s in d.verdict.sets
        ],
        notes=d.notes, paths=paths, errors=errors,
        estimator_gap=[
            [s.score, *("" if v is None else f"{v:.3g}" for v in (s.references, s.runs, s.twin, s.corrected))]
            for s in scores
        ],
        failed=[f"left out: {line}" for line in failed],
        **sheet.parts(),
    )  # fmt: skip


def _value(d: GapDiagnosis) -> str:
    if d.verdict.kind == "unknown":
        return "not_to_be_used"
    covered = d.drives is None or not d.drives.limits()
    alike = d.verdict.kind == "no_gap" and d.detection.p_value > d.significance
    return "good" if alike and covered else "doubtful"


def judge_rows(scores: Sequence[Compared]) -> list[dict[str, Any]]:
    """The rows of judge.json."""
    keys = ("mark", "references", "runs", "twin", "corrected")
    return [dict(zip(keys, dataclasses.astuple(one), strict=True)) for one in scores]


def _tiles(d: GapDiagnosis) -> list[Tile]:
    """How sure it is that there is a gap, and what a named effect explains of it."""
    p, limit = d.detection.p_value, d.significance
    tiles = [Tile("p-value", f"{p:.2g}", f"a gap below {limit:g}")]
    if named := named_sets(d):
        tiles.append(Tile("certain of the cause", percent(named[0].probability), alternatives_text(named[0])))
    elif d.verdict.kind == "unknown":
        tiles.append(
            Tile("certain of an unknown cause", percent(d.verdict.p_unknown), "none of the catalogue")
        )
    if d.verdict.named and d.shrinkage.share is not None:
        share = f"{100.0 * d.shrinkage.share:.0f} %"
        tiles.append(Tile("the gap shrinks by", share, "with the named effect in the twin"))
    return tiles


def _where(d: GapDiagnosis) -> list[list[str]]:
    return [
        [
            c.channel, c.regime, c.band, f"{c.error:.2g} {CHANNEL_UNITS[c.channel]}",
            f"{c.reference:.2g} {CHANNEL_UNITS[c.channel]}", f"{c.sigmas:.1f}", percent(c.share),
            f"{c.p_value:.2g}",
        ]
        for c in d.where[:MOST_PLACES]
    ]  # fmt: skip


def _causes(d: GapDiagnosis) -> list[list[str]]:
    """Causes that are possible; none without a gap."""
    possible = [c for c in d.verdict.causes if c.probability >= LEAST_PROBABILITY][:MOST_CAUSES]
    return [
        [c.effect, percent(c.probability), "" if c.share is None else percent(c.share), numbers(d, c)]
        for c in (possible if d.detected else [])
    ]


def _drives(d: GapDiagnosis) -> list[str]:
    if d.drives is None:
        return ["There are no references to compare the drives with."]
    covered = f"The references cover {percent(d.drives.covered)} of the time of these drives."
    return [covered, *(f"They lack: {what}" for what in d.drives.missing)]
