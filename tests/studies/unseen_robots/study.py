"""Errors in outages on robots that no part of the library made, beside a plain EKF.

    python -m tests.studies.unseen_robots.study --out FOLDER [--robots 18] [--first-seed 100]

The robots are rigid bodies in MuJoCo (`machine`), drawn by seed (`draw`): three drive types, unknown antenna,
turned and tilted IMU, late fixes, three receivers, slick patches. terrafusion gets the log with wheel radius,
track and drive type, as an owner knows them, and runs with its defaults. Seeds below 100 are for development.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.opponents import ekf, ours
from tests.studies.opponents.drives import vehicle_of
from tests.studies.opponents.parts import Task, code_of, library_code, result_of, run_all
from tests.studies.opponents.protocol import Row, scored, streams_of
from tests.studies.opponents.summary import geometric_mean, losses, ratio
from tests.studies.unseen_robots.draw import draw
from tests.studies.unseen_robots.machine import drive
from tests.studies.unseen_robots.sensors import recording_of

EKF = "EKF"
MODES = ("fixed", "adaptive")
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Result:
    """Outages of one length of one robot: median error, and share of errors inside their 95 % ellipses."""

    robot: str
    seconds: float
    estimator: str
    outages: int
    median_m: float
    percent: float
    inside: float | None


@dataclass(frozen=True)
class Work:
    """All estimators on the robot of a seed."""

    seed: int
    lengths: tuple[float, ...]


def compute(work: Work) -> list[dict[str, Any]]:
    """Results of one robot."""
    robot = draw(work.seed)
    recording = recording_of(robot, drive(robot))
    streams = streams_of(recording, vehicle_of(recording, None))
    assert streams is not None
    out = []
    for seconds in work.lengths:
        rows = scored(streams, seconds, lambda blocked: ekf.run(streams, blocked))
        out.append(_result(robot.name, seconds, EKF, rows, []))
        for mode in MODES:
            replayed, failures = ours.rows(recording, streams, seconds, mode)
            for line in failures:
                print(f"{robot.name}, {mode}: {line}", file=sys.stderr)
            shares = [row.share_inside for row in replayed if row.share_inside is not None]
            out.append(_result(robot.name, seconds, mode, replayed, shares))
    return [asdict(result) for result in out]


def _result(
    robot: str, seconds: float, estimator: str, rows: Sequence[Row], shares: Sequence[float]
) -> Result:
    errors = np.array([row.error_m for row in rows])
    percent = 100.0 * errors / np.array([row.distance_m for row in rows])
    medians = float(np.median(errors)), float(np.median(percent))
    return Result(robot, seconds, estimator, len(rows), *medians, float(np.mean(shares)) if shares else None)


def table(results: Sequence[Result]) -> list[str]:
    """A line a robot and length, then the summary."""
    lines = [
        f"{'robot':28s} {'s':>3s} outages   EKF, m  "
        + "  ".join(f"{m + ', m':>11s}  ratio  inside" for m in MODES)
    ]
    by = {(r.robot, r.seconds, r.estimator): r for r in results}
    for robot, seconds in dict.fromkeys((r.robot, r.seconds) for r in results):
        theirs = by[robot, seconds, EKF]
        mine = [by[robot, seconds, mode] for mode in MODES]
        cells = [
            f"{m.median_m:11.2f}  {ratio(m.median_m, theirs.median_m):5.2f}  "
            + ("     -" if m.inside is None else f"{100.0 * m.inside:4.0f} %")
            for m in mine
        ]
        lines.append(
            f"{robot:28s} {seconds:3g} {theirs.outages:7d}  {theirs.median_m:7.2f}  " + "  ".join(cells)
        )
    for seconds in sorted({r.seconds for r in results}):
        for mode in MODES:
            pairs = [
                ratio(r.median_m, by[r.robot, seconds, EKF].median_m)
                for r in results
                if (r.seconds, r.estimator) == (seconds, mode)
            ]
            inside = [
                r.inside
                for r in results
                if (r.seconds, r.estimator) == (seconds, mode) and r.inside is not None
            ]
            lost = f"lost {losses(pairs)} of {len(pairs)}, worst {max(pairs):.2f}"
            held = f"inside 95 % ellipses {100.0 * float(np.mean(inside)):.0f} %"
            lines.append(f"{mode} over EKF, {seconds:g} s: {geometric_mean(pairs).text()}, {lost}, {held}")
    return lines


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.unseen_robots.study", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="folder for parts")
    parser.add_argument("--robots", type=int, default=18)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--seconds", nargs="+", type=float, default=(10.0, 30.0))
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after this time")
    given = parser.parse_args()
    code = library_code() + code_of(
        *(HERE / f"{name}.py" for name in ("draw", "machine", "sensors", "study"))
    )
    seeds = range(given.first_seed, given.first_seed + given.robots)
    tasks = [Task(f"robot {seed} {given.seconds}", code, Work(seed, tuple(given.seconds))) for seed in seeds]
    run_all(tasks, compute, given.out / "parts", given.jobs, 60.0 * given.minutes)
    done = [found for task in tasks if (found := result_of(task, given.out / "parts")) is not None]
    print("\n".join(table([Result(**entry) for found in done for entry in found])))
    if len(done) < len(tasks):
        print(f"{len(tasks) - len(done)} of {len(tasks)} robots not run yet")
    return 0


if __name__ == "__main__":
    from tests.studies.unseen_robots import study

    sys.exit(study.main())  # workers know the tasks by the module's own name
