"""A fixed part of the matrix of faults, on drives of the twin: `python -m tests.studies run fault_matrix`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.fault_matrix.faults import FAULTS
from tests.studies.fault_matrix.matrix import TWIN, Cell, clean_log, run, tried

CRASHED = (12, 44)
"""Cells that ended in an exception once: an accelerometer in g, on a steered robot."""


def test_cells_fail_neither_loudly_nor_silently(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("TERRAFUSION_DATA", raising=False)
    rows = run(len(FAULTS), 600.0, tmp_path, first=1000)
    assert {row["faults"][0] for row in rows} == set(FAULTS)
    bad = [row for row in rows if row["outcome"] not in ("ok", "warned", "refused", "slow")]
    assert not bad, bad
    assert sum(row["outcome"] == "refused" for row in rows) < len(rows) / 2
    again = run(len(FAULTS), 0.0, tmp_path, first=1000)
    assert [row["outcome"] for row in again] == [row["outcome"] for row in rows], "kept, not done again"


@pytest.mark.parametrize("number", CRASHED)
def test_what_broke_the_numbers_is_refused(number: int) -> None:
    cell = Cell(number, "steered", "robust", False, ("wrong_unit",))
    assert tried(cell)["outcome"] == "refused"


def test_fixes_a_tenth_of_a_second_late_do_not_pass_as_good() -> None:
    assert tried(Cell(562, "steered", "adaptive", True, ("lag",)))["verdict"] == "doubtful"


def test_a_fault_changes_the_log_alone_that_it_is_given() -> None:
    log = clean_log(TWIN[0])
    for number in range(len(FAULTS)):
        cell = Cell.drawn(number, TWIN)
        assert cell.faulty(log) is not log
    assert clean_log(TWIN[0]) is log
