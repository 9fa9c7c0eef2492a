"""`run_benchmark`: all jobs of a plan on all processors; a run that was stopped goes on (`scores.parts`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import check_folder
from terrafusion.fusion.benchmark.checkpoints import FOLDER, log_state, read_part, write_part
from terrafusion.fusion.benchmark.field_logs import Refusal, drives_of
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE, METHODS
from terrafusion.fusion.benchmark.plan import BenchmarkPlan, Job
from terrafusion.fusion.benchmark.run_score import RunScore, measure
from terrafusion.fusion.benchmark.twin_runs import BenchmarkCase, simulate_case
from terrafusion.twin.executors import open_workers


@dataclass(frozen=True)
class BenchmarkResult:
    """All rows of a plan, and what was not run; the same plan and sources find the same but for `seconds`."""

    rows: tuple[RunScore, ...]
    refused: tuple[Refusal, ...]

    @classmethod
    def read(cls, raw: dict[str, Any]) -> BenchmarkResult:
        """What a part holds."""
        return cls(tuple(map(RunScore.read, raw["rows"])), tuple(Refusal(**one) for one in raw["refused"]))


def run_benchmark(
    plan: BenchmarkPlan, out: Path, *, jobs: int = 1, progress: Callable[[float], None] | None = None
) -> BenchmarkResult:
    """Run the jobs whose results `out` does not hold yet, and return the rows of all, in the plan's order.

    Args:
        out: folder; parts of other sources or files in it, and refused logs, are computed anew.
        jobs: processes.
        progress: told the share of the jobs that is done, from 0 to 1.

    Raises:
        ConfigError: an unreasonable plan.
        TerrafusionError: no job to run, workers died, or the folder cannot be written.
    """
    wanted = plan.jobs()
    if not wanted:
        raise TerrafusionError(
            "there is nothing to run: no field log is at hand",
            remedy="set TERRAFUSION_DATA, or run `terrafusion fetch SET`, or leave out --only field",
        )
    check_folder(out / FOLDER)
    found = {job: kept for job in wanted if (kept := _kept(out, job)) is not None}
    missing = [job for job in wanted if job not in found]
    with open_workers("loky", min(jobs, max(len(missing), 1))) as pool:
        for job, new in pool.results(run_job, [(job,) for job in missing]):
            found[job] = BenchmarkResult.read(write_part(out, job.key, dataclasses.asdict(new), _state(job)))
            if progress is not None:
                progress(len(found) / len(wanted))
    rows = tuple(row for job in wanted for row in found[job].rows)
    return BenchmarkResult(rows, tuple(dict.fromkeys(one for job in wanted for one in found[job].refused)))


def _kept(out: Path, job: Job) -> BenchmarkResult | None:
    """What `out` holds of a job; None also where something was refused: it may be mended by now."""
    try:
        part = read_part(out, job.key, _state(job))
        found = None if part is None else BenchmarkResult.read(part)
    except (KeyError, TypeError):  # JSON, but no part
        return None
    return None if found is None or found.refused else found


def _state(job: Job) -> str:
    return "" if isinstance(job.item, BenchmarkCase) else log_state(job.item.name)


def run_job(job: Job) -> tuple[Job, BenchmarkResult]:
    """The job, and what every drive of it gives with every arm of it."""
    arms = [arm for arm in METHODS if arm.name in job.arms]
    rows: list[RunScore] = []
    refused: list[Refusal] = []
    for drive in [simulate_case(job.item)] if isinstance(job.item, BenchmarkCase) else drives_of(job.item):
        if isinstance(drive, Refusal):
            refused.append(drive)
        else:
            chosen = arms if drive.judged else [arm for arm in arms if arm.name in (ADAPTIVE, BASELINE)]
            rows += [row for arm in chosen if (row := measure(drive, arm)) is not None]
    return job, BenchmarkResult(tuple(rows), tuple(refused))
