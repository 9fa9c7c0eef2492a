"""The files of a reproduced study.

agreement.csv    one row a statement of the study, with its verdict
metrics.json     everything measured, with intervals; the plan; the counts
batch.csv        one row a run of the batch
report.html      all of it, with the figures
"""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.json_text import finite, to_json
from terrafusion.fusion.reports.page import TWIN_LIBRARIES, Tile, VerdictBox, write_page, write_text
from terrafusion.fusion.reports.plots.sheet import Sheet
from tests.studies.source_study import plots
from tests.studies.source_study import plots_field as field
from tests.studies.source_study.batch import BatchResult
from tests.studies.source_study.claims import BASES, PREDICTED, VERDICTS, ClaimResult, counts
from tests.studies.source_study.published import CASES, FRICTION, TITLE, platform_figures
from tests.studies.source_study.study import Study
from tests.studies.source_study.text import (
    ASSUMED_HEAD,
    TAB4_HEAD,
    assumed_rows,
    noise_sentence,
    table_cells,
)

TEMPLATE = Path(__file__).parent / "study.html.j2"
SCHEMA = "terrafusion.study/1"
BATCH_COLUMNS = (
    "terrain", "friction", "slope_deg", "payload_kg", "shear_modulus_m", "mobile", "advance", "slip_percent",
    "slip_ratio_percent", "energy_per_m_j", "immobilised_at_s",
)  # fmt: skip


def write_study(out: Path, study: Study, provenance: Mapping[str, object] | None = None) -> None:
    """All files of a reproduced study in the folder `out`, numbers first.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    columns = [field.name for field in dataclasses.fields(ClaimResult)]
    texts = {
        "agreement.csv": _csv(columns, map(dataclasses.asdict, study.rows)),
        "metrics.json": to_json(metrics_of(study), indent=2) + "\n",
        "batch.csv": _csv(BATCH_COLUMNS, map(batch_row, (*study.batch, *study.over_slip))),
    }
    for name, text in texts.items():
        write_text(out / name, text)
    _write_page(out / "report.html", study, provenance)


def metrics_of(study: Study) -> dict[str, Any]:
    """The content of `metrics.json`: intervals are half-widths at 95 %; unknown numbers are None."""
    return {
        "schema": SCHEMA,
        "seeds": study.plan.seed_count(),
        "quick": study.plan.quick,
        "agreement": counts(study.rows),
        "agreement_by_basis": {basis: counts(study.rows, basis) for basis in BASES},
        "measured": {name: dataclasses.asdict(value) for name, value in study.measured.items()},
        "gnss_noise": [dataclasses.asdict(fit) for fit in study.noise],
    }


def batch_row(result: BatchResult) -> dict[str, Any]:
    """One run of the batch, by `BATCH_COLUMNS`; `shear_modulus_m` is empty for the soil's own."""
    return dataclasses.asdict(result.cell) | {
        "mobile": result.mobile,
        "advance": result.advance,
        "slip_percent": result.slip,
        "slip_ratio_percent": result.slip_ratio,
        "energy_per_m_j": result.energy_per_m_j,
        "immobilised_at_s": result.immobilised_at_s,
    }


def _csv(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """A table as text; unknown and not finite numbers are empty."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(columns), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if value is None else value for name, value in finite(row).items()})
    return buffer.getvalue()


def _write_page(path: Path, study: Study, provenance: Mapping[str, object] | None) -> None:
    every, predicted = counts(study.rows), counts(study.rows, PREDICTED)
    lead = f"{TITLE}, by the twin with {study.plan.seed_count()} seeds a case."
    title = f"Of {len(study.rows)} statements and numbers {_counts_text(every)}"
    reason = (
        f"Of the {sum(predicted.values())} that the twin was neither calibrated to nor given "
        f"{_counts_text(predicted)}."
    )
    tiles = [
        Tile(f"{word}, of those predicted", str(count), f"{every[word]} of all")
        for word, count in predicted.items()
    ]
    disagreeing = [row for verdict in VERDICTS[:0:-1] for row in study.rows if row.verdict == verdict]
    write_page(
        path, TEMPLATE, "The source study, reproduced", lead=lead, provenance=provenance,
        verdicts=[VerdictBox("doubtful" if disagreeing else "good", title, [reason])], tiles=tiles[:3],
        packages=TWIN_LIBRARIES, noise=noise_sentence(study),
        tab4_heads=TAB4_HEAD, tab4=[(case.label, *table_cells(study, case)) for case in CASES],
        disagreement=[(*_statement(row), row.why) for row in disagreeing],
        agreement=[(*_statement(row), row.criterion, row.why) for row in study.rows],
        batch=len(study.batch), stuck=sum(not r.mobile for r in study.batch),
        tab3=_friction_rows(study.batch), assumed_heads=ASSUMED_HEAD, assumed=assumed_rows(study),
        robot=[(f.name, f"{f.study:g} {f.unit}", f"{f.twin:.5g} {f.unit}") for f in platform_figures()],
        **_figures(study),
    )  # fmt: skip


def _figures(study: Study) -> dict[str, Any]:
    """The figures, and the keys of those that stand together."""
    first, uneven = ({t: of[0] for t, of in runs.items()} for runs in (study.runs, study.uneven))
    noisy = {t: of[0] for t, of in study.noisy.items()}
    common_m, drive = study.study_like().common_m, study.field[0]
    gaussian = {terrain: [run.error(common_m) for run in of] for terrain, of in study.noisy.items()}
    sheet = Sheet(float(first["mud"].profiles.t_s[-1]))
    plots.plot_tab4(sheet, study.runs, gaussian)
    plots.plot_mud(sheet, first["mud"])
    plots.plot_noise(sheet, study.noise)
    keys = {
        "sand": plots.plot_sand_speeds(sheet, first),
        "yaw_sand": plots.plot_yaw_rates(sheet, uneven, ("loose_sand", "medium_sand")),
        "gnss": plots.plot_gnss_speeds(sheet, first, noisy, common_m),
        "mobility": plots.plot_mobility(sheet, study.batch),
        "energy": plots.plot_energy(sheet, study.batch, study.over_slip),
    }
    profiles = [run.profiles for run in (first["mud"], *study.uneven["mud"])]
    sheet.begin_axis(1.1 * max(float(p.t_s[p.moving()][-1]) for p in profiles))
    plots.plot_slip_proxy(sheet, first["mud"], study.uneven["mud"])
    keys["yaw_mud"] = plots.plot_yaw_rates(sheet, uneven, ("mud",))
    sheet.begin_axis(float(drive.imu_t_s[-1]))
    keys |= {
        "acceleration": field.plot_acceleration(sheet, drive),
        "trace": field.plot_trace(sheet, drive),
        "velocity": field.plot_velocity(sheet, drive),
    }
    field.plot_ground_speed(sheet, drive)
    field.plot_imu_speed(sheet, study.field)
    return {"keys": keys, **sheet.parts()}


def _counts_text(number: Mapping[str, int]) -> str:
    return ", ".join(f"{number[verdict]} {verdict}" for verdict in VERDICTS)


def _statement(row: ClaimResult) -> tuple[tuple[str, str], str, str, str | tuple[str, str]]:
    """Cells: the statement and what is measured, value of study and twin, the verdict and its basis."""
    verdict = row.verdict if row.basis == PREDICTED else (row.verdict, row.basis)
    return (f"{row.source}: {row.statement}", row.quantity), row.study, row.twin, verdict


def _friction_rows(batch: Sequence[BatchResult]) -> list[list[str]]:
    """Slip at the ends of each terrain's friction range, without payload, flat and on 5 deg."""

    def ends(terrain: str, slope_deg: float) -> str:
        place = (terrain, slope_deg, 0.0)
        mine = [r for r in batch if (r.cell.terrain, r.cell.slope_deg, r.cell.payload_kg) == place]
        mine.sort(key=lambda r: r.cell.friction)
        return " to ".join(f"{r.slip:.1f} %" if r.mobile else "stuck" for r in (mine[0], mine[-1]))

    return [
        [terrain.replace("_", " "), f"{low:g} to {high:g}", ends(terrain, 0.0), ends(terrain, 5.0)]
        for terrain, (low, high) in FRICTION.items()
    ]
