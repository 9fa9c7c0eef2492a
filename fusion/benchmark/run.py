"""Runs the jobs of a benchmark in parallel; an interrupted benchmark continues from its `checkpoints`."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import check_folder
from terrafusion.fusion.benchmark.checkpoints import FOLDER, log_state, read_part, write_part
from terrafusion.fusion.benchmark.field_logs import Refusal, runs_of
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE, METHODS
from terrafusion.fusion.benchmark.plan import BenchmarkPlan, Job
from terrafusion.fusion.benchmark.run_score import RunScore, score_run
from terrafusion.fusion.benchmark.twin_runs import BenchmarkCase, simulate_case
from terrafusion.twin.executors import open_workers


@dataclass(frozen=True)
class BenchmarkResult:
    """Scores of all runs, and the logs that were not run; repeatable but for `seconds` of the scores."""

    rows: tuple[RunScore, ...]
    refused: tuple[Refusal, ...]

    @classmethod
    def read(cls, raw: dict[str, Any]) -> Self:
        """A result from its JSON object."""
        return cls(tuple(map(RunScore.read, raw["rows"])), tuple(Refusal(**one) for one in raw["refused"]))


def run_benchmark(
    plan: BenchmarkPlan,
    out: Path,
    *,
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> BenchmarkResult:
    """Run the jobs without a checkpoint in `out`; returns the results of all jobs in the order of the plan.

    Args:
        out: folder; checkpoints of other sources or files, and of refused logs, are computed again.
        jobs: processes on this machine.
        backend: "loky" (this machine) or "dask", then with the `address` of its scheduler.
        progress: called with the share of the jobs that is done, 0 to 1.

    Raises:
        ConfigError: an invalid plan.
        TerrafusionError: no job to run, workers died, or the folder cannot be written.
    """
    planned = plan.jobs()
    if not planned:
        raise TerrafusionError(
            "there is nothing to run: no field log is present",
            remedy="set TERRAFUSION_DATA, or run `terrafusion fetch SET`, or leave out --only field",
        )
    check_folder(out / FOLDER)
    results = {job: stored for job in planned if (stored := _stored(out, job)) is not None}
    missing = [job for job in planned if job not in results]
    if missing:
        with open_workers(backend, min(jobs, len(missing)), address) as workers:
            for job, new in workers.results(run_job, [(job,) for job in missing]):
                part = write_part(out, job.key, dataclasses.asdict(new), _state(job))
                results[job] = BenchmarkResult.read(part)
                if progress is not None:
                    progress(len(results) / len(planned))
    rows = tuple(row for job in planned for row in results[job].rows)
    refused = dict.fromkeys(one for job in planned for one in results[job].refused)
    return BenchmarkResult(rows, tuple(refused))


def _stored(out: Path, job: Job) -> BenchmarkResult | None:
    """Result of a job stored in `out`; None also if a log was refused: it may be repaired by now."""
    try:
        part = read_part(out, job.key, _state(job))
        result = None if part is None else BenchmarkResult.read(part)
    except (KeyError, TypeError):  # JSON, but no checkpoint
        return None
    return None if result is None or result.refused else result


def _state(job: Job) -> str:
    return "" if isinstance(job.item, BenchmarkCase) else log_state(job.item.name)


def run_job(job: Job) -> tuple[Job, BenchmarkResult]:
    """The job, and the scores of all its runs with all its methods."""
    methods = [method for method in METHODS if method.name in job.methods]
    compared = [method for method in methods if method.name in (ADAPTIVE, BASELINE)]
    scores: list[RunScore] = []
    refused: list[Refusal] = []
    for run in [simulate_case(job.item)] if isinstance(job.item, BenchmarkCase) else runs_of(job.item):
        if isinstance(run, Refusal):
            refused.append(run)
            continue
        for method in methods if run.judged else compared:
            score = score_run(run, method)
            scores += [] if score is None else [score]
    return job, BenchmarkResult(tuple(scores), tuple(refused))
