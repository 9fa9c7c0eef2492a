"""`python -m tests.studies.field_table.table --out DIR`: every field log in every mode.

Each log with wheels and IMU is replayed whole, and once for each simulated
outage (`outage_plan`), scored on its truth or on held-out fixes and never
realigned after the start. A log with truth but no receiver is dead reckoning
when replayed whole; for outages it gets fixes made from its truth. A log
without any reference is only checked for divergence (`health`).

What one log gives in one mode is kept in `DIR/parts` as soon as it is known: a
table that was stopped goes on with the same command, and `--collect` writes
the tables of what is there.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.files import check_folder
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.checkpoints import FOLDER, log_state, read_part, write_part
from terrafusion.fusion.benchmark.field_logs import (
    UNFORESEEN,
    Refusal,
    check_log,
    ground_of,
    outages_of,
    reference_of,
    refusal_of,
)
from terrafusion.fusion.benchmark.outage_plan import aided_by_truth, until
from terrafusion.fusion.config.estimator_config import MODES
from terrafusion.fusion.metrics.health import examine_estimate
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.executors import open_workers
from tests.studies.field_runs import catalogued, each_run
from tests.studies.parts import TaskWorkers, add_options

ONE = TaskWorkers()
FIRST_MODES = ("adaptive", "fixed")
"""Run on every log before the other modes: a table that was stopped compares these two everywhere."""


@dataclass(frozen=True)
class Run:
    """One replay: of the whole log (`test` "whole"; "aided" with fixes made from its truth), or with one
    outage ("outage 60 s" from `start_s`); on the `drive`th drive of the log, made fixes with noise of `seed`.

    `error_m` is, whole and aided: the root mean square against truth, or the median
    distance from held-out fixes; in an outage: the error at its end.
    """

    log: str
    ground: str
    vehicle: str
    reference: str
    mode: str
    test: str
    start_s: float | None
    distance_m: float
    error_m: float | None
    within_m: float | None
    percent: float | None
    nees: float | None
    top_speed_mps: float
    path_ratio: float | None
    diverged: str
    wheels_rejected: int
    gnss_rejected: int
    seconds: float
    realtime: float
    latency_p99_ms: float
    drive: int = 0
    seed: int = 0

    @classmethod
    def read(cls, raw: dict[str, Any]) -> Run:
        """A run from its JSON object, which has null for numbers that are not finite."""
        floats = [f.name for f in dataclasses.fields(cls) if f.type == "float"]
        return cls(**{**raw, **{name: float("nan") for name in floats if raw[name] is None}})


@dataclass(frozen=True)
class Task:
    """One log in one mode, so that tasks can run in parallel.

    `again` runs what other noise changes: fixes made from the truth, no whole drives, no fixes of a receiver.
    """

    log: str
    mode: str
    most_starts: int
    seed: int
    again: bool = False

    @property
    def key(self) -> str:
        """Its name as that of a file."""
        name = f"{quote(self.log, safe='')}-{self.mode}-{self.most_starts}-{self.seed}"
        return f"{name}-again" if self.again else name


def tasks_of(
    logs: Sequence[str], modes: Sequence[str], most_starts: int, seed: int, seeds: int = 1
) -> list[Task]:
    """The tasks in the order in which they are run: `FIRST_MODES` on all logs, the others, further seeds."""
    late = [mode not in FIRST_MODES for mode in modes]
    return [
        Task(log, mode, most_starts, seed + more, more > 0)
        for more in range(seeds)
        for turn in (False, True)
        for log in logs
        for mode, is_late in zip(modes, late, strict=True)
        if is_late == turn
    ]


def run_tasks(
    tasks: Sequence[Task], out: Path, *, workers: TaskWorkers = ONE,
    progress: Callable[[str], None] = lambda _: None,
) -> None:  # fmt: skip
    """Run the tasks of which `out` does not hold the results yet, and keep them there.

    Args:
        workers: with several, times are those of loaded processors.

    Raises:
        TerrafusionError: workers died, or the folder cannot be written.
    """
    check_folder(out / FOLDER)
    missing = [task for task in tasks if read_part(out, task.key, log_state(task.log)) is None]
    begun, jobs = time.monotonic(), min(workers.jobs, max(len(missing), 1))
    with open_workers(workers.backend, jobs, workers.address) as opened:
        for task, found in opened.results(run_task, [(task,) for task in missing]):
            runs = [dataclasses.asdict(r) for r in found if isinstance(r, Run)]
            refused = [dataclasses.asdict(r) for r in found if isinstance(r, Refusal)]
            write_part(out, task.key, {"runs": runs, "refused": refused}, log_state(task.log))
            progress(f"{task.log}, {task.mode}")
            if time.monotonic() - begun > workers.limit_s:
                break


def collect(tasks: Sequence[Task], out: Path) -> tuple[list[Run], list[Refusal], list[Task]]:
    """The runs that `out` holds, log by log, the logs that were refused, and the tasks still missing."""
    runs: list[Run] = []
    refusals: dict[Refusal, None] = {}
    missing: list[Task] = []
    logs, modes = list(dict.fromkeys(t.log for t in tasks)), list(dict.fromkeys(t.mode for t in tasks))
    for task in sorted(tasks, key=lambda t: (logs.index(t.log), modes.index(t.mode), t.seed)):
        part = read_part(out, task.key, log_state(task.log))
        if part is None:
            missing.append(task)
            continue
        runs += [Run.read(raw) for raw in part["runs"]]
        refusals |= {Refusal(**raw): None for raw in part["refused"]}
    return runs, list(refusals), missing


def run_task(task: Task) -> tuple[Task, list[Run | Refusal]]:
    """The task, and all runs of its log in its mode; what stops one becomes a line that says so."""
    return task, each_run(task.log, lambda log, n, drive: _runs(dataclasses.replace(task, log=log), n, drive))


def _runs(task: Task, drive: int, recording: Recording) -> Iterator[Run | Refusal]:
    check_log(recording)
    reference = reference_of(recording)
    made = reference == "truth" and recording.gnss is None
    if task.again and not made:
        return
    if not task.again:
        yield _tried(task, drive, recording, reference, "whole", None)
    if reference == "none":
        return
    if made:
        recording, reference = aided_by_truth(recording, task.seed), "truth, fixes made from it"
        yield _tried(task, drive, recording, reference, "aided", None)
    for outage in outages_of(recording, task.most_starts):
        part, test = until(recording, outage.start_s + outage.seconds + 0.5), f"outage {outage.seconds:g} s"
        yield _tried(task, drive, part, reference, test, outage)


def _tried(
    task: Task, drive: int, recording: Recording, reference: str, test: str, outage: Outage | None
) -> Run | Refusal:
    """One replay; what stops it becomes a line of the table, so that one log does not cost all others."""
    where = f"{task.log}, {test}" + ("" if outage is None else f" from {outage.start_s:.1f} s")
    try:
        result = replay(recording, mode=task.mode, outages=[] if outage is None else [outage])
    except TerrafusionError as error:
        return refusal_of(where, error)
    except UNFORESEEN as error:
        return refusal_of(f"{where}, {task.mode}", error)
    return dataclasses.replace(_run(task, result, reference, test, outage), drive=drive, seed=task.seed)


def _run(task: Task, result: ReplayResult, reference: str, test: str, outage: Outage | None) -> Run:
    recording, scores = result.recording, result.scores
    assert recording.wheels is not None
    health = examine_estimate(result.estimate, recording.wheels, result.vehicle.rig().wheel_radius_m)
    percent: float | None = None
    distance, nees, within = health.path_m, scores.nees_mean, None
    if outage is not None:
        part = scores.outages[0]
        distance, error, within, percent = part.distance_m, part.end_error_m, part.median_m, part.percent
        nees = _nees_in(result, outage)
    elif scores.against == "truth":
        error = scores.ate_m
    else:
        error = None if scores.held_out is None else scores.held_out.median_m
    latencies = result.latencies_ms
    return Run(
        log=task.log,
        ground=ground_of(task.log, recording),
        vehicle=result.vehicle.name,
        reference="truth, no fixes"
        if test == "whole" and recording.gnss is None and error is not None
        else reference,
        mode=task.mode,
        test=test,
        start_s=None if outage is None else outage.start_s,
        distance_m=distance,
        error_m=error,
        within_m=within,
        percent=percent,
        nees=nees,
        top_speed_mps=health.top_speed_mps,
        path_ratio=health.path_ratio(),
        diverged=health.why,
        wheels_rejected=result.rejected_wheels,
        gnss_rejected=result.rejected_gnss,
        seconds=result.seconds,
        realtime=result.realtime_factor(),
        latency_p99_ms=float(np.percentile(latencies, 99.0)) if len(latencies) else float("nan"),
    )


def _nees_in(result: ReplayResult, outage: Outage) -> float | None:
    errors = result.scores.errors
    if errors is None:
        return None
    nees = errors.nees()[outage.covers(errors.t_ns, result.recording.start_ns)]
    nees = nees[np.isfinite(nees)]
    return float(nees.mean()) if len(nees) else None


def main() -> int:
    """Run, write the tables and the figure; 0, or 1 after a known error."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.field_table.table", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for tables and figure")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES, help="by default all")
    parser.add_argument(
        "--logs", nargs="+", metavar="LOG", help="by default all of the catalogue that are at hand"
    )
    parser.add_argument("--starts", type=int, default=4, help="outages of each length in a log, at most")
    parser.add_argument("--seed", type=int, default=1, help="of the noise on fixes made from truth")
    parser.add_argument("--seeds", type=int, default=1, help="how many draws of that noise, from --seed on")
    add_options(parser)
    parser.add_argument("--collect", action="store_true", help="run nothing, write what has been run")
    words = parser.parse_args()
    if words.seeds < 1:
        parser.error("--seeds must be 1 or more")
    logs = list(words.logs) if words.logs else catalogued()
    tasks = tasks_of(logs, words.modes, words.starts, words.seed, words.seeds)
    try:
        _table(words.out, tasks, None if words.collect else TaskWorkers.of(words))
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _table(out: Path, tasks: Sequence[Task], workers: TaskWorkers | None) -> None:
    """Run what is missing, unless `workers` is None, and write the tables of what is there."""
    from tests.studies.field_table.page import write

    if not tasks:
        raise DataError(
            "no field log is at hand", remedy="set TERRAFUSION_DATA, or run `terrafusion fetch SET`"
        )
    begun = time.monotonic()

    def progress(text: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\x1b[K{time.monotonic() - begun:5.0f} s  {text}", end="", file=sys.stderr, flush=True)

    if workers is not None:
        run_tasks(tasks, out, workers=workers, progress=progress)
    progress("")
    runs, refusals, missing = collect(tasks, out)
    print(write(out, runs, refusals))
    rest = f"; {len(missing)} of {len(tasks)} logs and modes not run yet" if missing else ""
    print(f"{time.monotonic() - begun:.0f} s; written to {out}{rest}")


if __name__ == "__main__":
    from tests.studies.field_table import table as field_table

    sys.exit(field_table.main())  # workers know the tasks by the module's own name
