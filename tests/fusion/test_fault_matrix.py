"""A fixed part of the matrix of faults, on drives of the twin: `python -m tests.studies run fault_matrix`."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from tests.studies.fault_matrix import matrix
from tests.studies.fault_matrix.faults import FAULTS
from tests.studies.fault_matrix.matrix import FIELD, TWIN, Cell, clean_log, ended_after, run, tried
from tests.studies.parts import TaskWorkers

CRASHED = (12, 44)
"""Cells that ended in an exception once: an accelerometer in g, on a steered robot."""


def test_cells_fail_neither_loudly_nor_silently(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("TERRAFUSION_DATA", raising=False)
    rows = run(len(FAULTS), TaskWorkers(limit_s=600.0), tmp_path, first=1000)
    assert {row["faults"][0] for row in rows} == set(FAULTS)
    bad = [row for row in rows if row["outcome"] not in ("ok", "warned", "refused", "slow")]
    assert not bad, bad
    assert sum(row["outcome"] == "refused" for row in rows) < len(rows) / 2
    monkeypatch.setattr(matrix, "tried", lambda cell: {})
    again = run(len(FAULTS), TaskWorkers(), tmp_path, first=1000)
    assert [row["outcome"] for row in again] == [row["outcome"] for row in rows], "kept, not done again"


@pytest.mark.parametrize("number", CRASHED)
def test_what_broke_the_numbers_is_refused(number: int) -> None:
    cell = Cell(number, "steered", "robust", False, ("wrong_unit",))
    assert tried(cell)["outcome"] == "refused"


@pytest.mark.parametrize(("number", "mode"), [(562, "adaptive"), (242, "fixed")])
def test_fixes_a_tenth_or_two_of_a_second_late_do_not_pass_as_good(number: int, mode: str) -> None:
    assert tried(Cell(number, "steered", mode, True, ("lag",)))["verdict"] == "doubtful"


@pytest.mark.parametrize("number", [155, 603])
def test_what_the_drive_itself_refutes_is_not_good(number: int) -> None:
    """An IMU whose turn shows late, or never in half a log."""
    assert tried(Cell.drawn(number, (*TWIN, *FIELD)))["verdict"] == "doubtful"


def test_fixes_stamped_ahead_do_not_lead_astray() -> None:
    assert tried(Cell.drawn(757, (*TWIN, *FIELD)))["outcome"] == "ok"


def test_a_fault_changes_the_log_alone_that_it_is_given() -> None:
    log = clean_log(TWIN[0])
    for number in range(len(FAULTS)):
        cell = Cell.drawn(number, TWIN)
        assert cell.faulty(log) is not log
    assert clean_log(TWIN[0]) is log


def test_a_hang_is_ended_outside_the_main_thread_too() -> None:
    ended = []

    def hang() -> None:
        try:
            with ended_after(0.05):
                for _ in range(1000):
                    time.sleep(0.01)
        except TimeoutError:
            ended.append(True)

    thread = threading.Thread(target=hang)
    thread.start()
    thread.join()
    assert ended == [True]
