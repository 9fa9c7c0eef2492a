"""Benchmark and training on a Dask cluster whose two workers are killed halfway, and resumed on new ones."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.benchmark.checkpoints import FOLDER
from terrafusion.fusion.benchmark.plan import BenchmarkPlan, Job
from terrafusion.fusion.benchmark.run import run_benchmark
from terrafusion.fusion.benchmark.twin_runs import FIRST_SEED, BenchmarkCase
from terrafusion.fusion.training.train_detector import TrainingPlan, train, write_model
from terrafusion.twin import executors
from tests.dask_cluster import scheduler, wait_for_workers, worker

pytest.importorskip("distributed", reason="distributed is not installed: pip install 'terrafusion[cluster]'")

TRAINING = TrainingPlan(1, ("figure_eight",), (0.0, 3.0), (0.0,))


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with scheduler(tmp_path_factory.mktemp("dask")) as address:
        yield address


@contextlib.contextmanager
def two_workers(address: str) -> Iterator[Callable[..., None]]:
    """Two workers, and what kills both."""
    with worker(address) as one, worker(address) as two:
        wait_for_workers(address, 2)
        yield lambda *_: [child.kill() for child in (one, two)]


def killed_and_resumed(address: str, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> Any:
    """`run(progress)`, whose workers die at its first progress, and again on new workers."""
    monkeypatch.setattr(executors, "WORKERLESS_S", 1.0)
    with (
        two_workers(address) as kill,
        pytest.raises(TerrafusionError, match=r"no workers any more; .*the same command continues"),
    ):
        run(kill)
    with two_workers(address):
        return run(lambda *_: None)


def test_training(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = tmp_path / "model.yaml.parts"
    found: list[int] = []

    def run(tick: Callable[[], None]) -> Any:
        found.append(len(list(parts.glob("run-*.npz"))))
        return train(TRAINING, tick, backend="dask", address=address, parts=parts)[0]

    models = [killed_and_resumed(address, run, monkeypatch), train(TRAINING)[0]]
    assert 0 < found[1] < TRAINING.runs()
    assert not parts.exists()
    for number, model in enumerate(models):
        write_model(model, tmp_path / f"{number}.yaml")
    assert (tmp_path / "0.yaml").read_bytes() == (tmp_path / "1.yaml").read_bytes()


def test_benchmark(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = [FIRST_SEED + 2 + 3 * i for i in range(3)]  # of the shortest runs
    jobs = [Job(BenchmarkCase("outages", "twin", seed), ("fixed",)) for seed in seeds]
    monkeypatch.setattr(BenchmarkPlan, "jobs", lambda self: jobs)
    finished: list[set[Path]] = []

    def run(progress: Callable[[float], None]) -> Any:
        finished.append(set((tmp_path / FOLDER).glob("*.json")))
        plan = BenchmarkPlan({"outages": None}, seeds=3)
        return run_benchmark(plan, tmp_path, backend="dask", address=address, progress=progress)

    result = killed_and_resumed(address, run, monkeypatch)
    assert 0 < len(finished[1]) < len(jobs)
    assert [row.unit for row in result.rows] == [f"seed {seed}" for seed in seeds]
    assert not any(row.failed or row.diverged for row in result.rows)
