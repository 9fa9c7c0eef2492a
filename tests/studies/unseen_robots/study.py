"""Errors in outages on robots that no part of the library made, beside a plain EKF.

    python -m tests.studies.unseen_robots.study --out FOLDER [--robots 18] [--first-seed 100] [--slick]

The robots are rigid bodies in MuJoCo (`machine`), drawn by seed (`draw`): three drive types, unknown antenna,
turned and tilted IMU, late fixes, three receivers, slick patches. terrafusion gets the log with wheel radius,
track and drive type, as an owner knows them, and runs with its defaults. What self-calibration says of a
robot after a drive with all fixes is held against the truth. With `--slick` the whole site is as slick as its
patches, and fixes are RTK. Seeds below 100 are for development.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.fusion.api.replays import replay
from tests.studies.opponents import ekf, ours
from tests.studies.opponents.drives import vehicle_of
from tests.studies.opponents.protocol import Row, scored, streams_of
from tests.studies.opponents.summary import geometric_mean, losses, ratio
from tests.studies.parts import Task, TaskWorkers, add_options, code_of, library_code, result_of, run_all
from tests.studies.unseen_robots.draw import KINDS, Robot, draw
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
class Learned:
    """A number of a robot after a drive: what self-calibration says, its sigma, and the truth."""

    robot: str
    number: str
    value: float
    sigma: float
    truth: float

    def off_sigmas(self) -> float:
        """Distance from the truth in sigmas; an angle may wrap."""
        off = self.value - self.truth
        return abs(math.remainder(off, math.tau) if self.number == "imu_yaw_rad" else off) / self.sigma


@dataclass(frozen=True)
class Work:
    """All estimators on the robot of a seed; with `slick` on slick ground alone, with RTK fixes."""

    seed: int
    lengths: tuple[float, ...]
    slick: bool = False

    def robot(self) -> Robot:
        """The robot on its site."""
        robot = draw(self.seed)
        return dataclasses.replace(robot, slick_share=1.0, receiver=KINDS["rtk"]) if self.slick else robot


def compute(work: Work) -> dict[str, list[dict[str, Any]]]:
    """Results and learned numbers of one robot."""
    robot = work.robot()
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
    truth = true_numbers(robot)
    numbers = [
        Learned(robot.name, n.state, n.value, n.sigma, truth[n.state])
        for n in replay(recording, mode="fixed").learned
        if n.state in truth
    ]
    return {"results": [asdict(one) for one in out], "numbers": [asdict(one) for one in numbers]}


def true_numbers(robot: Robot) -> dict[str, float]:
    """The numbers that self-calibration looks for. Slip makes that of the wheels larger than the tyre's.

    The body's origin lies between the driven wheels. Samples of the IMU are means up to their stamps, as the
    estimator takes them, so that no delay belongs to them.
    """
    ahead_m = 0.5 * robot.wheelbase_m if robot.drive == "differential" else 0.0
    return {
        "antenna_x_m": robot.antenna_m[0] - ahead_m,
        "antenna_y_m": robot.antenna_m[1],
        "gnss_delay_s": robot.fix_delay_s,
        "imu_yaw_rad": robot.imu_yaw_rad,
        "turn_scale": 1.0 / robot.gyro_scale - 1.0,
        "wheel_scale": robot.wheel_error - 1.0,
    }


def numbers_table(numbers: Sequence[Learned]) -> list[str]:
    """A line a number: how often it is told within two sigma, and by how many sigmas it is off."""
    lines = []
    for name in dict.fromkeys(n.number for n in numbers):
        mine = [n for n in numbers if n.number == name]
        off = np.array([n.off_sigmas() for n in mine])
        sigma = float(np.median([n.sigma for n in mine]))
        held = f"within 2 sigma {int((off <= 2.0).sum())} of {len(off)}"
        lines.append(f"{name}: {held}, sigma {sigma:.3g} (median), worst {off.max():.1f} sigma")
    return lines


def _result(
    robot: str, seconds: float, estimator: str, rows: Sequence[Row], shares: Sequence[float]
) -> Result:
    errors = np.array([row.error_m for row in rows])
    percent = 100.0 * errors / np.array([row.distance_m for row in rows])
    medians = (float(np.median(errors)), float(np.median(percent))) if rows else (math.nan, math.nan)
    return Result(robot, seconds, estimator, len(rows), *medians, float(np.mean(shares)) if shares else None)


def table(results: Sequence[Result]) -> list[str]:
    """A line a robot and length, then the summary; slow robots have no outage with a path to score."""
    results = [result for result in results if result.outages]
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
        robots = [r.robot for r in results if (r.seconds, r.estimator) == (seconds, EKF)]
        own = [ratio(*(by[robot, seconds, mode].median_m for mode in MODES[::-1])) for robot in robots]
        lines.append(
            f"adaptive over fixed, {seconds:g} s: {geometric_mean(own).text()}, worst {max(own):.2f}, "
            f"best {min(own):.2f}"
        )
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
    parser.add_argument("--slick", action="store_true", help="slick ground alone, with RTK fixes")
    add_options(parser)
    given = parser.parse_args()
    code = library_code() + code_of(
        *(HERE / f"{name}.py" for name in ("draw", "machine", "sensors", "study"))
    )
    seeds = range(given.first_seed, given.first_seed + given.robots)
    name, lengths = "slick robot" if given.slick else "robot", tuple(given.seconds)
    tasks = [Task(f"{name} {k} {given.seconds}", code, Work(k, lengths, given.slick)) for k in seeds]
    run_all(tasks, compute, given.out / "parts", TaskWorkers.of(given))
    done = [found for task in tasks if (found := result_of(task, given.out / "parts")) is not None]
    print("\n".join(table([Result(**entry) for found in done for entry in found["results"]])))
    print("\n".join(numbers_table([Learned(**entry) for found in done for entry in found["numbers"]])))
    if len(done) < len(tasks):
        print(f"{len(tasks) - len(done)} of {len(tasks)} robots not run yet")
    return 0


if __name__ == "__main__":
    from tests.studies.unseen_robots import study

    sys.exit(study.main())  # workers know the tasks by the module's own name
