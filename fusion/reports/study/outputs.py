"""The files of a reproduced study.

plan.json        what was asked for, written before the runs, so that a folder that cannot be written is
                 told at once
agreement.csv    one row a statement of the study, with its verdict
agreement.md     the same as the Markdown that docs/study.md holds
metrics.json     everything measured, with intervals; the plan; the counts
batch.csv        one row a run of the batch
report.html      all of it, with the figures
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.json_text import finite, to_json
from terrafusion.fusion.reports.study.page import write_study_page
from terrafusion.twin.study.agreement import BASES, Row, counts
from terrafusion.twin.study.batch import CellResult
from terrafusion.twin.study.cases import SCENARIO, VEHICLE
from terrafusion.twin.study.published import CASES
from terrafusion.twin.study.study import Study, StudyPlan
from terrafusion.twin.study.text import document_section

SCHEMA = "terrafusion.study/1"


def write_plan(out: Path, plan: StudyPlan) -> None:
    """Write `plan.json`.

    Raises:
        ConfigError: the plan asks for no or too many seeds.
        TerrafusionError: the folder cannot be written.
    """
    content = {"scenario": SCENARIO, "vehicle": VEHICLE, "seeds": plan.seed_count(), "quick": plan.quick}
    _write_text(out / "plan.json", to_json(content, indent=2) + "\n")


def write_study(out: Path, study: Study, provenance: Mapping[str, object] | None = None) -> None:
    """All files of a reproduced study in the folder `out`, numbers first.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    texts = {
        "agreement.csv": _csv(
            [field.name for field in dataclasses.fields(Row)], map(dataclasses.asdict, study.rows)
        ),
        "agreement.md": "\n".join(document_section(study)) + "\n",
        "metrics.json": to_json(metrics_of(study), indent=2) + "\n",
        "batch.csv": _csv(BATCH_COLUMNS, map(batch_row, (*study.batch, *study.over_slip))),
    }
    for name, text in texts.items():
        _write_text(out / name, text)
    write_study_page(out / "report.html", study, provenance)


def write_bags(out: Path) -> None:
    """The three cases with seed 0 as ROS 2 bags with sensors, command and ground truth.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    from terrafusion.datasets.writers.mcap import write_mcap
    from terrafusion.twin.simulate import simulate

    for case in CASES:
        recording = simulate(SCENARIO, vehicle=VEHICLE, terrain=case.terrain, slope_deg=case.slope_deg)
        write_mcap(recording, out / f"{case.terrain}.mcap")


def metrics_of(study: Study) -> dict[str, Any]:
    """The content of `metrics.json`: intervals are half-widths at 95 %; unknown numbers are None."""
    return {
        "schema": SCHEMA,
        "seeds": study.plan.seed_count(),
        "quick": study.plan.quick,
        "agreement": counts(study.rows),
        "agreement_by_basis": {basis: counts(study.rows, basis) for basis in BASES},
        "measured": {name: dataclasses.asdict(found) for name, found in study.measured.items()},
        "gnss_noise": [dataclasses.asdict(fit) for fit in study.noise],
    }


BATCH_COLUMNS = (
    "terrain", "friction", "slope_deg", "payload_kg", "shear_modulus_m", "mobile", "advance", "slip_percent",
    "slip_ratio_percent", "energy_per_m_j", "immobilised_at_s",
)  # fmt: skip


def batch_row(result: CellResult) -> dict[str, Any]:
    """One run of the batch, by `BATCH_COLUMNS`; `shear_modulus_m` is empty for the soil's own."""
    return dataclasses.asdict(result.cell) | {
        "mobile": result.mobile,
        "advance": result.advance,
        "slip_percent": result.slip,
        "slip_ratio_percent": result.slip_ratio,
        "energy_per_m_j": result.energy_per_m_j,
        "immobilised_at_s": result.immobilised_at_s,
    }


def _write_text(path: Path, text: str) -> None:
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def _csv(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """A table as text; unknown and not finite numbers are empty."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(columns), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if value is None else value for name, value in finite(row).items()})
    return buffer.getvalue()
