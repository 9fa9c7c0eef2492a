"""The files of a diagnosis: `diagnosis.json`, `judge.json` with the estimator's gap, and `report.html`."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from terrafusion.fusion.benchmark.estimator_gap import Compared
from terrafusion.fusion.reports.gap_text import answer
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, write_page, write_text
from terrafusion.fusion.reports.plots import gap as plots
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis

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
        rows = [dataclasses.asdict(score) for score in scores]
        write_text(out / "judge.json", json.dumps(rows, indent=1, allow_nan=False) + "\n")
    shrink = d.shrinkage is not None
    write_page(
        out / "report.html", "gap.html.j2", f"Gap between {d.vehicle} and its twin",
        lead=" ".join(answer(d)), provenance=provenance, packages=TWIN_LIBRARIES,
        where=_where(d), causes=_causes(d), notes=d.notes,
        figures={
            "map": plots.plot_map(d) if d.where else None,
            "causes": plots.plot_causes(d),
            "shrink": plots.plot_shrink(d) if shrink else None,
        },
        errors={name: plots.plot_errors(d, i) for i, name in enumerate(d.runs[:MOST_RUNS]) if shrink},
        estimator_gap=_estimator_gap(scores), failed=[f"left out: {line}" for line in failed],
    )  # fmt: skip


def _where(d: GapDiagnosis) -> list[list[str]]:
    return [
        [c.channel, c.regime, c.band, f"{100.0 * c.share:.1f}", f"{c.p_value:.3g}"]
        for c in d.where[:MOST_PLACES]
    ]


def _causes(d: GapDiagnosis) -> list[list[str]]:
    c, rows = d.evidence.candidates, []
    for cause in d.verdict.causes[:MOST_CAUSES]:
        parameters = "; ".join(
            f"{c.keys[i]} = {v * c.scale[i]:.3g} {_within(s * c.scale[i])} {c.units[i]}"
            for i, v, s in zip(cause.columns, cause.value, cause.sigma, strict=True)
        )
        share = "" if cause.share is None else f"{100.0 * cause.share:.0f}"
        others = ", ".join(cause.members[1:])
        rows.append([cause.effect, f"{100.0 * cause.probability:.1f}", share, parameters, others])
    return rows


def _within(sigma: float) -> str:
    return f"± {sigma:.2g}" if math.isfinite(sigma) else "(fit failed)"


def _estimator_gap(scores: Sequence[Compared]) -> list[list[str]]:
    return [
        [s.mark, *("" if v is None else f"{v:.3g}" for v in (s.references, s.runs, s.twin, s.corrected))]
        for s in scores
    ]
