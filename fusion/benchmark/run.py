"""`run_benchmark`: all jobs of a plan on all processors; a run that was stopped goes on (`scores.parts`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.fusion.benchmark.arms import ARMS, BASE, OWN
from terrafusion.fusion.benchmark.drives import Case, drive_of
from terrafusion.fusion.benchmark.field import Refused, drives_of
from terrafusion.fusion.benchmark.measure import Row, measure
from terrafusion.fusion.benchmark.plan import Job, Plan
from terrafusion.fusion.scores.parts import read_part, write_part
from terrafusion.twin.pools import open_pool


@dataclass(frozen=True)
class Found:
    """All rows of a plan, and what was not run; the same plan and sources find the same but for `seconds`."""

    rows: tuple[Row, ...]
    refused: tuple[Refused, ...]


def run_benchmark(
    plan: Plan, out: Path, *, jobs: int = 1, progress: Callable[[float], None] | None = None
) -> Found:
    """Run the jobs whose results `out` does not hold yet, and return the rows of all, in the plan's order.

    Args:
        out: folder; parts of other sources in it are computed anew.
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
    missing = [job for job in wanted if read_part(out, job.key) is None]
    done = len(wanted) - len(missing)
    with open_pool("loky", min(jobs, max(len(missing), 1))) as pool:
        for job, found in pool.results(run_job, [(job,) for job in missing]):
            write_part(out, job.key, dataclasses.asdict(found))
            done += 1
            if progress is not None:
                progress(done / len(wanted))
    parts = [part for job in wanted if (part := read_part(out, job.key)) is not None]
    rows = tuple(Row.read(raw) for part in parts for raw in part["rows"])
    refused = dict.fromkeys(Refused(**raw) for part in parts for raw in part["refused"])
    return Found(rows, tuple(refused))


def run_job(job: Job) -> tuple[Job, Found]:
    """The job, and what every drive of it gives with every arm of it."""
    arms = [arm for arm in ARMS if arm.name in job.arms]
    rows: list[Row] = []
    refused: list[Refused] = []
    for drive in [drive_of(job.item)] if isinstance(job.item, Case) else drives_of(job.item):
        if isinstance(drive, Refused):
            refused.append(drive)
        else:
            chosen = arms if drive.judged else [arm for arm in arms if arm.name in (OWN, BASE)]
            rows += [row for arm in chosen if (row := measure(drive, arm)) is not None]
    return job, Found(tuple(rows), tuple(refused))
