"""The source study on a Dask cluster of two processes, one of which is killed in the middle."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.source_study.study import StudyPlan, run_study
from tests.studies.source_study.text import document_section

pytest.importorskip("distributed", reason="distributed is not installed: pip install 'terrafusion[cluster]'")

from tests.dask_cluster import scheduler, wait_for_workers, worker

PLAN = StudyPlan(seeds=1, quick=True)


def test_a_worker_killed_in_the_middle_changes_nothing(tmp_path: Path) -> None:
    here = run_study(PLAN)
    shares: list[float] = []
    with scheduler(tmp_path) as address, worker(address) as mortal, worker(address):
        wait_for_workers(address, 2)

        def kill_one(share: float) -> None:
            shares.append(share)
            if len(shares) == 3:
                mortal.kill()

        there = run_study(PLAN, kill_one, backend="dask", address=address)
    assert shares[-1] == 1.0
    assert document_section(there) == document_section(here)
    assert there.measured == here.measured
