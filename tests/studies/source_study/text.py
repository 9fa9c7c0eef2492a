"""The reproduced study as Markdown."""

import itertools
from collections.abc import Sequence

from terrafusion.datasets.core.tables import markdown_table
from tests.studies.source_study.cases import CaseRun
from tests.studies.source_study.claims import PREDICTED, ClaimResult, counts
from tests.studies.source_study.gnss_noise import DATA_SHEET_M, rate_for
from tests.studies.source_study.profiles import OTHERS, USUAL
from tests.studies.source_study.published import CASES, StudyCase
from tests.studies.source_study.spread import spread
from tests.studies.source_study.study import Study

TAB4_HEAD = ("", "|s|", "odometry", "IMU", "GNSS, RTK", "GNSS, Gaussian", "stopped for good at")
ASSUMED_COLUMNS = ("slip", "imu", "gnss")
ASSUMED_HEAD = (
    "",
    *(
        f"{case.terrain.replace('_', ' ')}, {name}"
        for case, name in itertools.product(CASES, ("|s|", "IMU", "GNSS"))
    ),
)
COLUMNS = ("source", "statement", "quantity", "study", "twin", "verdict", "criterion", "basis", "why")
"""Columns of the table of agreement, fields of `ClaimResult`."""


def table_cells(study: Study, case: StudyCase) -> list[str]:
    """One row of Tab. 4, each cell `twin / study`, and when the robot stopped for good."""
    found, terrain = study.measured, case.terrain
    pairs = [
        (f"{terrain}.slip", case.slip), (f"{terrain}.odometry", case.odometry), (f"{terrain}.imu", case.imu),
        (f"{terrain}.gnss", case.gnss), (f"{terrain}.gnss_gaussian", case.gnss),
    ]  # fmt: skip
    return [
        *(f"{found[key].text()} / {published:g}" for key, published in pairs),
        stop_text(study.runs[terrain]),
    ]


def assumed_rows(study: Study) -> list[list[str]]:
    """Tab. 4 under the usual and the other choices of what the study does not state, by `ASSUMED_HEAD`."""
    rows = []
    for number, assumed in enumerate((USUAL, *OTHERS)):
        row = [f"{assumed.cutoff_hz:g} Hz, {assumed.moving_mps:g} m/s"]
        for case in CASES:
            errors = [(run.errors, *run.other_errors)[number] for run in study.runs[case.terrain]]
            row += [f"{spread(getattr(of, name) for of in errors).mean:.1f}" for name in ASSUMED_COLUMNS]
        rows.append(row)
    return rows


def stop_text(runs: Sequence[CaseRun]) -> str:
    """When the runs stopped for good, s from the start, and how many of them did."""
    stops = [run.summary.immobilised_at_s for run in runs if run.summary.immobilised_at_s is not None]
    if not stops:
        return "no"
    some = "" if len(stops) == len(runs) else f" ({len(stops)} of {len(runs)} runs)"
    return f"{spread(stops).text()} s{some}"


def noise_sentence(study: Study) -> str:
    """Which Gaussian noise comes closest to the study's GNSS errors, and how close."""
    fit = study.study_like()
    alone = ", ".join(
        f"{case.label} {100 * fit.alone_m[case.terrain]:.1f} cm ({case.gnss:g} %)" for case in CASES
    )
    wanted = {case.terrain: case.gnss for case in CASES}
    rates = ", ".join(f"{rate_for(study.noise, case.terrain):.0f}" for case in CASES)
    return (
        f"White position noise at {fit.rate_hz:g} Hz that gives the study's GNSS error of each run alone: "
        f"{alone}. "
        f"One for all: {100 * fit.common_m:.1f} cm, which misses the worst by a factor of "
        f"{fit.worst_factor(wanted):.1f}. White noise of {100 * DATA_SHEET_M:g} cm, the data sheet's bound, "
        f"would give the three errors with positions differenced at {rates} Hz."
    )


def count_lines(rows: Sequence[ClaimResult]) -> list[str]:
    """How many claims agree, of all and of those the twin was not calibrated to."""
    lines = []
    for name, found in (
        ("of all claims", counts(rows)),
        ("of those neither calibrated to nor given", counts(rows, PREDICTED)),
    ):
        shares = ", ".join(f"{count} {verdict}" for verdict, count in found.items())
        lines.append(f"{name} ({sum(found.values())}): {shares}")
    return lines


def markdown_rows(rows: Sequence[ClaimResult]) -> list[str]:
    """The table of agreement in Markdown."""
    return markdown_table(COLUMNS, [[getattr(row, column) for column in COLUMNS] for row in rows])


def document_section(study: Study) -> list[str]:
    """Tables and counts, as the stored result tests/studies/results/source_study.md holds them."""
    tab4 = [[case.label, *table_cells(study, case)] for case in CASES]
    return [
        *markdown_table(("mean %, twin / study", *TAB4_HEAD[1:]), tab4),
        "",
        noise_sentence(study),
        "",
        "Tab. 4 under other cut-offs and thresholds of motion (GNSS is the data sheet's RTK):",
        "",
        *markdown_table(ASSUMED_HEAD, assumed_rows(study)),
        "",
        *(f"- {line}" for line in count_lines(study.rows)),
        "",
        *markdown_rows(study.rows),
    ]


def quoted_lines(study: Study) -> list[str]:
    """Rows of Tab. 4 as docs/evidence/study.md quotes them: without the Gaussian GNSS noise."""
    lines = []
    for case in CASES:
        *errors, _, stopped = table_cells(study, case)
        lines.append(f"quoted of {case.terrain}: {' | '.join([*errors, stopped])}")
    return lines
