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
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.json_text import finite, to_json
from terrafusion.fusion.reports.page import bullets, figure, table, where_from, write_page
from terrafusion.fusion.reports.plots import study as plots
from terrafusion.fusion.reports.plots import study_field as field
from terrafusion.twin.study.agreement import BASES, PREDICTED, Row, counts
from terrafusion.twin.study.batch import CellResult
from terrafusion.twin.study.cases import SCENARIO, VEHICLE
from terrafusion.twin.study.criteria import VERDICTS
from terrafusion.twin.study.published import CASES, FRICTION, TITLE
from terrafusion.twin.study.robot import platform_figures
from terrafusion.twin.study.study import Study, StudyPlan
from terrafusion.twin.study.text import (
    ASSUMED_HEAD,
    TAB4_HEAD,
    assumed_rows,
    document_section,
    noise_sentence,
    table_cells,
)

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


def write_study_page(path: Path, study: Study, provenance: Mapping[str, object] | None = None) -> Path:
    """Write the report of a reproduced study to `path`.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    body = [
        _head(study),
        _tab4(study),
        _open(study.rows),
        _mud(study),
        _sand(study),
        _gnss(study),
        _batch(study),
        _field(study),
        _tables(study),
        _agreement(study.rows),
        _method(study),
        where_from(provenance or {}, ("casadi", "numpy", "scipy")),
    ]
    return write_page(path, "The source study, reproduced", body)


def _head(study: Study) -> str:
    found = counts(study.rows)
    predicted = counts(study.rows, PREDICTED)
    told = ", ".join(f"{found[verdict]} {verdict}" for verdict in VERDICTS)
    free = ", ".join(f"{predicted[verdict]} {verdict}" for verdict in VERDICTS)
    return (
        f'<h1>The source study, reproduced</h1>\n<p class="lead">{escape(TITLE)}, by the twin with '
        f"{study.plan.seed_count()} seeds a case. Of {len(study.rows)} statements and numbers: {told}. "
        f"Of the {sum(predicted.values())} that the twin was neither calibrated to nor given: {free}.</p>"
    )


def _tab4(study: Study) -> str:
    gaussian = {
        terrain: [run.error(study.study_like().common_m) for run in of] for terrain, of in study.noisy.items()
    }
    fig, _ = plots.plot_tab4(study.runs, gaussian)
    rows = [[escape(cell) for cell in (case.label, *table_cells(study, case))] for case in CASES]
    return "\n".join(
        [
            "<h2>Tab. 4: twin / study</h2>",
            table(TAB4_HEAD, rows, range(1, 7)),
            '<p class="dim">Mean percent over moving samples, with the 95 % interval of the mean over the '
            "seeds. On even ground the motion knows no seed: slip and odometry do not scatter.</p>",
            figure(fig, "Each point is one run of the twin; the diamonds are the study's single runs."),
        ]
    )


def _open(rows: Sequence[Row]) -> str:
    """What does not agree, or in part only."""
    found = [row for verdict in VERDICTS[:0:-1] for row in rows if row.verdict == verdict]
    lines = [
        (_told(row), escape(row.study), escape(row.twin), _verdict(row), escape(row.why)) for row in found
    ]
    heads = ("statement and what is measured", "study", "twin", "verdict", "why")
    return "<h2>What does not agree</h2>\n" + table(heads, lines, (1, 2))


def _agreement(rows: Sequence[Row]) -> str:
    lines = [
        (
            _told(row),
            escape(row.study),
            escape(row.twin),
            _verdict(row),
            escape(row.criterion),
            escape(row.why),
        )
        for row in rows
    ]
    heads = ("statement and what is measured", "study", "twin", "verdict", "criterion", "why")
    return (
        "<h2>All statements and numbers</h2>\n"
        + table(heads, lines, (1, 2))
        + '<p class="dim">The verdict is computed by the criterion. Calibrated: the twin was fitted to '
        "this, or it follows from what it was fitted to; given: taken over. That proves little.</p>"
    )


def _told(row: Row) -> str:
    return f'{escape(row.source)}: {escape(row.statement)}<span class="about">{escape(row.quantity)}</span>'


def _verdict(row: Row) -> str:
    basis = "" if row.basis == PREDICTED else f'<span class="about">{escape(row.basis)}</span>'
    return f"{escape(row.verdict)}{basis}"


def _tables(study: Study) -> str:
    tab3 = [
        (
            escape(terrain.replace("_", " ")),
            f"{low:g} to {high:g}",
            *(escape(_ends(study.batch, terrain, slope)) for slope in (0.0, 5.0)),
        )
        for terrain, (low, high) in FRICTION.items()
    ]
    robot = [(escape(f.name), f"{f.study:g} {f.unit}", f"{f.twin:.5g} {f.unit}") for f in platform_figures()]
    return "\n".join(
        [
            "<h2>Tab. 3: effective friction</h2>",
            table(("terrain", "friction", "mean |s| over it, flat", "mean |s| over it, 5 deg"), tab3),
            "<h2>Tabs. 1 and 2: robot, sensors, profile</h2>",
            table(("figure", "study", "twin"), robot, (1, 2)),
        ]
    )


def _ends(batch: Sequence[CellResult], terrain: str, slope_deg: float) -> str:
    """Slip at the ends of a terrain's friction range, without payload."""
    found = sorted(
        (
            r
            for r in batch
            if (r.cell.terrain, r.cell.slope_deg, r.cell.payload_kg) == (terrain, slope_deg, 0.0)
        ),
        key=lambda r: r.cell.friction,
    )
    return " to ".join(f"{r.slip:.1f} %" if r.mobile else "stuck" for r in (found[0], found[-1]))


def _mud(study: Study) -> str:
    run, uneven = study.runs["mud"][0], {terrain: of[0] for terrain, of in study.uneven.items()}
    parts = [
        (plots.plot_mud(run)[0], "Fig. 4. Command, odometry and truth on mud."),
        (
            plots.plot_slip_proxy(run, study.uneven["mud"])[0],
            "Fig. 6. The slip proxy on mud, while it moves; negative: the wheels run ahead.",
        ),
        (plots.plot_yaw_rates(uneven, ("mud",))[0], "Fig. 7. Yaw rate on mud whose strength varies."),
    ]
    return "<h2>Mud (Figs. 4, 6, 7)</h2>\n" + _figures(parts)


def _sand(study: Study) -> str:
    first, uneven = ({t: of[0] for t, of in runs.items()} for runs in (study.runs, study.uneven))
    parts = [
        (plots.plot_sand_speeds(first)[0], "Fig. 5. Speeds on loose and medium sand, 5 deg."),
        (
            plots.plot_yaw_rates(uneven, ("loose_sand", "medium_sand"))[0],
            "Fig. 8. Yaw rate on loose and medium sand whose strength varies.",
        ),
    ]
    return "<h2>Sand (Figs. 5, 8)</h2>\n" + _figures(parts)


def _gnss(study: Study) -> str:
    fit = study.study_like()
    first, noisy = {t: of[0] for t, of in study.runs.items()}, {t: of[0] for t, of in study.noisy.items()}
    parts = [
        (
            plots.plot_gnss_speeds(first, noisy, fit.common_m)[0],
            "Fig. 9. GNSS speed by differenced positions: the data sheet's RTK, and the one Gaussian noise "
            "that comes closest to the study's errors.",
        ),
        (
            plots.plot_noise(study.noise)[0],
            "White position noise that gives the study's GNSS error of each terrain. It falls with the rate: "
            "the study's errors do not tell its noise without its rate.",
        ),
    ]
    return f"<h2>GNSS (Fig. 9)</h2>\n<p>{escape(noise_sentence(study))}</p>\n" + _figures(parts)


def _batch(study: Study) -> str:
    stuck = sum(not r.mobile for r in study.batch)
    parts = [
        (
            plots.plot_mobility(study.batch)[0],
            "Net way uphill over the commanded way. Solid: no payload, dashed and dotted: with payload. "
            "Below zero the robot slides back.",
        ),
        (
            plots.plot_energy(study.batch, study.over_slip)[0],
            "Energy a metre of the runs that make half of the way, averaged over friction. Right: one load "
            "on one slope, with sand from stiff to soft in shear.",
        ),
    ]
    return (
        f"<h2>Batch: terrain x friction x slope x payload</h2>\n<p>{len(study.batch)} runs of 300 s; {stuck} "
        "make less than half of the way. All of them are in batch.csv.</p>\n" + _figures(parts)
    )


def _field(study: Study) -> str:
    drive = study.field[0]
    parts = [
        (field.plot_acceleration(drive)[0], "Fig. 11. Specific force as measured."),
        (field.plot_trace(drive)[0], "Fig. 12. Latitude and longitude of the fixes, and altitude."),
        (field.plot_velocity(drive)[0], "Fig. 13. Velocity east, north, up."),
        (field.plot_ground_speed(drive)[0], "Fig. 14. Ground speed."),
        (field.plot_imu_speed(study.field)[0], "Fig. 15. Speed integrated from the IMU."),
    ]
    return (
        "<h2>Field test (Figs. 11 to 15)</h2>\n<p>A drive of the twin on loose and medium sand with a "
        "stand-alone receiver under partial canopy. Course, ground and commands of the study's field test "
        "are not published: these figures can agree in kind only.</p>\n" + _figures(parts)
    )


def _method(study: Study) -> str:
    items = [
        "Streams are matched in time within 50 ms; speeds and the yaw rate pass a second-order low-pass of "
        "1 Hz without lag (cut-off assumed).",
        "Errors and slip are averaged over samples with a true speed above 0.1 m/s (threshold assumed).",
        "GNSS speed: differenced positions, then the low-pass. IMU speed: forward acceleration less its mean "
        "over the first 2 s, 0.5 s moving average, trapezoid rule.",
        "Stops of the profile: 5 s every 75 s, ramps of 0.5 m/s2 (assumed; the study says short stops).",
        "Uneven ground: strength with a standard deviation of 20 % and a correlation length of 0.5 m "
        "(assumed), another one for each seed.",
    ]
    return "\n".join(
        [
            "<h2>How it is processed</h2>",
            bullets(escape(item) for item in items),
            '<p class="dim">Tab. 4 under other cut-offs and thresholds of motion, mean percent:</p>',
            table(ASSUMED_HEAD, assumed_rows(study), range(1, 10)),
        ]
    )


def _figures(parts: Iterable[tuple[object, str]]) -> str:
    return "\n".join(figure(fig, caption) for fig, caption in parts)  # type: ignore[arg-type]
