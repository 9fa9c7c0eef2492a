"""What a diagnosis leaves behind: `diagnosis.json` and `report.html`."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.benchmark.estimator_gap import Compared
from terrafusion.fusion.reports.gap_text import sentences
from terrafusion.fusion.reports.page import bullets, figure, table, where_from, write_page
from terrafusion.fusion.reports.plots import gap as plots
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis

MOST_RUNS = 3
"""Runs beyond these have no plots of their own."""
MOST_CAUSES = 12


def write_diagnosis(
    out: Path,
    d: GapDiagnosis,
    provenance: Mapping[str, object] | None = None,
    judged: tuple[Sequence[Compared], Sequence[str]] | None = None,
) -> None:
    """Both files in the folder `out`, numbers first; and `judge.json` where somebody judged the logs.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    text = json.dumps(d.to_json(), indent=1, allow_nan=False)
    write_atomically(out / "diagnosis.json", lambda part: part.write_text(text + "\n", encoding="utf-8"))
    title = f"Gap between {d.vehicle} and its twin"
    body = [f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(" ".join(sentences(d)))}</p>']
    body += [_where(d), _causes(d), _shrink(d)]
    if judged is not None:
        marks, failed = judged
        told = json.dumps([dataclasses.asdict(mark) for mark in marks], indent=1, allow_nan=False)
        write_atomically(out / "judge.json", lambda part: part.write_text(told + "\n", encoding="utf-8"))
        body.append(_judged(marks, failed))
    if d.notes:
        body.append(f"<h2>What was assumed</h2>\n{bullets(escape(note) for note in d.notes)}")
    body.append(where_from(dict(provenance or {}), ("casadi", "numpy", "scipy")))
    write_page(out / "report.html", title, body)


def _judged(marks: Sequence[Compared], failed: Sequence[str]) -> str:
    rows = [
        (
            escape(m.mark),
            *("" if v is None else f"{v:.3g}" for v in (m.references, m.runs, m.twin, m.corrected)),
        )
        for m in marks
    ]
    heads = ("mark", "references", "judged runs", "twin of these", "twin with the effect")
    said = "<p>Means over the logs. Where twin and robot agree, so do the columns.</p>"
    lost = bullets(f"left out: {escape(line)}" for line in failed) if failed else ""
    return f"<h2>As the estimator sees it</h2>\n{said}\n{table(heads, rows, (1, 2, 3, 4))}\n{lost}"


def _where(d: GapDiagnosis) -> str:
    if not d.where:
        return "<h2>Where</h2>\n<p>There are no references to compare with, or too few rows.</p>"
    fig, _ = plots.plot_map(d)
    rows = [
        (escape(c.channel), escape(c.regime), escape(c.band), f"{100.0 * c.share:.1f}", f"{c.p_value:.3g}")
        for c in d.where[:10]
    ]
    caption = (
        "Where the runs err more than the references. Dots: significant for the whole map "
        "(max-T over choices of runs)."
    )
    return f"<h2>Where</h2>\n{figure(fig, caption)}\n" + table(
        ("channel", "regime", "band", "share, %", "p"), rows, (3, 4)
    )


def _causes(d: GapDiagnosis) -> str:
    fig, _ = plots.plot_causes(d)
    c, rows = d.evidence.candidates, []
    for cause in d.verdict.causes[:MOST_CAUSES]:
        told = "; ".join(
            f"{c.keys[i]} = {v * c.scale[i]:.3g} {_within(s * c.scale[i])} {escape(c.units[i])}"
            for i, v, s in zip(cause.columns, cause.value, cause.sigma, strict=True)
        )
        share = "" if cause.share is None else f"{100.0 * cause.share:.0f}"
        rows.append(
            (escape(cause.effect), f"{100.0 * cause.probability:.1f}", share, told,
             escape(", ".join(cause.members[1:])))
        )  # fmt: skip
    heads = ("effect", "probability, %", "explains, %", "parameters (1 sigma)", "cannot be told from")
    caption = "Probability of each cause; blue: judged present."
    return f"<h2>Causes</h2>\n{figure(fig, caption)}\n{table(heads, rows, (1, 2))}"


def _within(sigma: float) -> str:
    return f"&plusmn; {sigma:.2g}" if math.isfinite(sigma) else "(fit failed)"


def _shrink(d: GapDiagnosis) -> str:
    if d.shrinkage is None:
        return ""
    fig, _ = plots.plot_shrink(d)
    parts = [
        f"<h2>Before and after</h2>\n{figure(fig, 'Error of each channel; soil, offsets and pose adapted.')}"
    ]
    for i, name in enumerate(d.runs[:MOST_RUNS]):
        parts.append(figure(plots.plot_errors(d, i), f"{name}: whitened errors over time, before and after."))
    return "\n".join(parts)
