"""Trials of studies on a Dask cluster of two workers, of which one is killed halfway, then both."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from signal import SIGKILL

import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin import executors
from tests.dask_cluster import scheduler, slow_square, wait_for_workers, worker
from tests.studies.__main__ import executed
from tests.studies.parts import Task, TaskWorkers, result_of, run_all
from tests.studies.registry import STUDIES

TASKS = [Task(f"square {number}", "code", number) for number in range(16)]


def results(folder: Path) -> list[int | None]:
    return [result_of(task, folder) for task in TASKS]


def kill_after_first(folder: Path, *processes: int) -> threading.Thread:
    """Kill workers as soon as a result is there."""

    def watch() -> None:
        while not any(folder.glob("*.json")):
            time.sleep(0.01)
        for process in processes:
            os.kill(process, SIGKILL)

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


def test_workers_that_are_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="distributed is not installed")
    monkeypatch.setattr(executors, "WORKERLESS_S", 1.0)
    squares = [number * number for number in range(16)]
    with scheduler(tmp_path) as address:
        cluster = TaskWorkers(2, "dask", address)
        for killed in (1, 2):
            folder = tmp_path / str(killed)
            with worker(address) as one, worker(address) as two:
                wait_for_workers(address, 2)
                thread = kill_after_first(folder, *(one.pid, two.pid)[:killed])
                if killed == 1:
                    run_all(TASKS, slow_square, folder, cluster)
                else:
                    with pytest.raises(TerrafusionError, match="no workers any more"):
                        run_all(TASKS, slow_square, folder, cluster)
                thread.join()
        assert results(tmp_path / "1") == squares
        there = {path: path.stat().st_mtime_ns for path in folder.glob("*.json")}
        assert 0 < len(there) < len(TASKS)
        with worker(address):
            wait_for_workers(address, 1)
            run_all(TASKS, slow_square, folder, cluster)
    assert results(folder) == squares
    assert all(path.stat().st_mtime_ns == then for path, then in there.items())


def test_studies_with_many_trials_take_workers() -> None:
    for study in STUDIES:
        if study.spread and study.command[0] == "-m":
            file = Path(*study.command[1].split("."))
            text = (Path(__file__).parents[2] / file).with_suffix(".py").read_text(encoding="utf-8")
            assert any(words in text for words in ("add_options(", "add_worker_options(", "parser_of("))
    assert sum(study.spread for study in STUDIES) >= 20


def test_a_study_without_trials_runs_on_a_worker_as_a_whole(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="distributed is not installed")
    whole = next(study for study in STUDIES if not study.spread)
    words = ["-c", "import os, sys; print(os.getppid()); sys.exit(3)"]
    with scheduler(tmp_path) as address, worker(address) as one:
        wait_for_workers(address, 1)
        ended = executed(whole, words, {"backend": "dask", "address": address})
    assert (ended.returncode, ended.stderr) == (3, "")
    assert int(ended.stdout) == one.pid
    here = executed(whole, words, {"jobs": "2"})
    assert (here.returncode, int(here.stdout)) == (3, os.getpid())
