"""The reproduced study as lines of text and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from terrafusion.twin.study.agreement import PREDICTED, Row, counts
from terrafusion.twin.study.cases import CaseRun
from terrafusion.twin.study.published import CASES, Case
from terrafusion.twin.study.spread import spread
from terrafusion.twin.study.study import Study

TAB4_HEAD = ("", "|s|", "odometry", "IMU", "GNSS, RTK", "GNSS, Gaussian", "stopped for good at")
COLUMNS = ("source", "statement", "quantity", "study", "twin", "verdict", "criterion", "basis", "why")
"""Columns of the table of agreement, fields of `Row`."""


def study_lines(study: Study) -> list[str]:
    """Tab. 4 side by side, the GNSS noise, and how much agrees."""
    seeds = study.plan.seed_count()
    lines = [f"mean %, twin / study; {seeds} seeds, 95 % interval of the mean"]
    rows = [list(TAB4_HEAD), *([case.label, *table_cells(study, case)] for case in CASES)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(TAB4_HEAD))]
    lines += ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return [*lines, "", noise_sentence(study), *count_lines(study.rows)]


def table_cells(study: Study, case: Case) -> list[str]:
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
    return (
        f"White position noise at {fit.rate_hz:g} Hz that gives the study's GNSS error of each run alone: "
        f"{alone}. "
        f"One for all: {100 * fit.common_m:.1f} cm, which misses the worst by a factor of "
        f"{fit.worst_factor(wanted):.1f}."
    )


def count_lines(rows: Sequence[Row]) -> list[str]:
    """How many claims agree, of all and of those the twin was not calibrated to."""
    lines = []
    for name, found in (
        ("of all claims", counts(rows)),
        ("of those not calibrated to", counts(rows, PREDICTED)),
    ):
        told = ", ".join(f"{count} {verdict}" for verdict, count in found.items())
        lines.append(f"{name} ({sum(found.values())}): {told}")
    return lines


def markdown_rows(rows: Sequence[Row], columns: Sequence[str] = COLUMNS) -> list[str]:
    """The table of agreement in Markdown."""
    lines = [f"| {' | '.join(columns)} |", f"|{' --- |' * len(columns)}"]
    for row in rows:
        cells = [str(getattr(row, column)).replace("|", "\\|") for column in columns]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def document_section(study: Study) -> list[str]:
    """What docs/study.md holds between its marks: Tab. 4, the GNSS noise, the counts, and the table."""
    cells = [[case.label, *table_cells(study, case)] for case in CASES]
    lines = [
        "| mean %, twin / study | " + " | ".join(name.replace("|", "\\|") for name in TAB4_HEAD[1:]) + " |"
    ]
    lines.append(f"|{' --- |' * len(TAB4_HEAD)}")
    lines += [f"| {' | '.join(row)} |" for row in cells]
    return [
        *lines,
        "",
        noise_sentence(study),
        "",
        *(f"- {line}" for line in count_lines(study.rows)),
        "",
        *markdown_rows(study.rows),
    ]
