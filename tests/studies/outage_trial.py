"""A quick look at errors in outages while one works on the estimator: EKF and replay, log by log.

    python -m tests.studies.outage_trial LOG... --seconds 30 60 --modes fixed [--unknown] [--ekf]

LOG is a recording of the catalogue, a path, or either with `@rtk` or `@consumer` for fixes made from truth.
Without LOG: a handful of logs of different robots (`QUICK`); paths in TERRAFUSION_LOGS are added.
Printed: median error in per cent of the distance and in metres, outages in brackets.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from tests.studies.opponents import ekf, ours
from tests.studies.opponents.command import further_logs
from tests.studies.opponents.drives import Drive, all_drives, as_unknown, vehicle_of
from tests.studies.opponents.protocol import Row, Streams, scored, streams_of

QUICK = (
    "wvu_pathfinder/s5t1", "husky_parkinglot/test1", "umich_husky/mair_mocap/trial1",
    "norlab_drive/asphalt_2024_9_25_12h8s57/raw", "norlab_drive/grass_2024_8_8_16h11s19/raw",
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """One drive, one length of outages, one estimator ("EKF" or a mode)."""

    drive: int
    seconds: float
    estimator: str


_DRIVES: list[tuple[Drive, Streams]] = []
"""Loaded once; workers are forked from it."""


def run(task: Task) -> tuple[Task, list[Row], list[str], float]:
    """Rows, failures and the time taken."""
    begun = time.monotonic()
    drive, streams = _DRIVES[task.drive]
    if task.estimator == "EKF":
        rows = scored(streams, task.seconds, lambda blocked: ekf.run(streams, blocked))
        return task, rows, [], time.monotonic() - begun
    replayed, failures = ours.rows(drive.recording, streams, task.seconds, task.estimator, _VEHICLE)
    return task, [*replayed], failures, time.monotonic() - begun


_VEHICLE: str | None = None


def load(names: Sequence[str], vehicle: str | None, unknown: bool) -> None:
    """Read all logs, with fixes made where they have none."""
    global _VEHICLE
    _VEHICLE = vehicle
    for drive in all_drives(names):
        params = vehicle_of(drive.recording, vehicle)
        streams = streams_of(drive.recording, params)
        recording = as_unknown(drive.recording) if unknown else drive.recording
        if streams is not None:
            _DRIVES.append((Drive(drive.log, drive.fixes, recording), streams))


def cell(rows: Sequence[Row]) -> str:
    """Median percent and metres."""
    if not rows:
        return "     -"
    percent = np.median([100.0 * r.error_m / r.distance_m for r in rows])
    return f"{percent:6.1f} % {np.median([r.error_m for r in rows]):7.3f} m ({len(rows)})"


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.outage_trial",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("logs", nargs="*", metavar="LOG")
    parser.add_argument("--seconds", nargs="+", type=float, default=[30.0, 60.0])
    parser.add_argument("--modes", nargs="*", default=["fixed"])
    parser.add_argument("--vehicle", help="name or file; by default what the log says")
    parser.add_argument("--unknown", action="store_true", help="only wheel radius and track are known")
    parser.add_argument("--ekf", action="store_true", help="the EKF alone")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    try:
        load(given.logs or [*QUICK, *further_logs()], given.vehicle, given.unknown)
    except TerrafusionError as error:
        parser.exit(1, f"error: {error}\n")
    _run_all(given.seconds, ["EKF", *([] if given.ekf else given.modes)], given.jobs)
    return 0


def _run_all(lengths: Sequence[float], estimators: Sequence[str], jobs: int) -> None:
    begun = time.monotonic()
    tasks = [Task(i, s, e) for i in range(len(_DRIVES)) for s in lengths for e in estimators]
    names = list(dict.fromkeys(drive.name for drive, _ in _DRIVES))
    found: dict[tuple[str, float, str], list[Row]] = {}
    left = {(n, s): 0 for n in names for s in lengths}
    for task in tasks:
        left[_DRIVES[task.drive][0].name, task.seconds] += 1
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        for task, rows, failures, _ in pool.imap_unordered(run, tasks):
            name = _DRIVES[task.drive][0].name
            found.setdefault((name, task.seconds, task.estimator), []).extend(rows)
            for line in failures:
                print(f"{name} {task.estimator}: {line}")
            left[name, task.seconds] -= 1
            if not left[name, task.seconds]:
                cells = [f"{e} {cell(found.get((name, task.seconds, e), []))}" for e in estimators]
                print(f"{name:48s} {task.seconds:3g} s  " + "   ".join(cells), flush=True)
    for length in lengths:
        for estimator in estimators[1:]:
            print(_summary(found, names, length, estimator))
    print(f"{time.monotonic() - begun:.0f} s")


def _summary(
    found: dict[tuple[str, float, str], list[Row]], names: Sequence[str], length: float, estimator: str
) -> str:
    """Geometric mean over logs of the ratio of medians."""
    ratios = []
    for name in names:
        mine, theirs = (found.get((name, length, e), []) for e in (estimator, "EKF"))
        if mine and theirs:
            ratios.append(np.median([r.error_m for r in mine]) / np.median([r.error_m for r in theirs]))
    if not ratios:
        return f"{length:g} s {estimator}: nothing to compare"
    mean = float(np.exp(np.mean(np.log(ratios))))
    lost = sum(r > 1.0 for r in ratios)
    return f"{length:g} s {estimator} / EKF: geometric mean {mean:.2f}, lost {lost} of {len(ratios)} logs"


if __name__ == "__main__":
    from tests.studies import outage_trial

    raise SystemExit(outage_trial.main())  # workers know the tasks by the module's own name
