"""Outages soon after the start, on robots that no part of the library made.

    python -m tests.studies.unseen_robots.starts --out FOLDER [--robots 12] [--first-seed 660]

A log is begun at several moments of a drive, and fixes are withheld 8 or 20 s later, for 20 s: the estimator
has to find its first heading from what little there is, and to say how well it knows it. The robots are those
of `study`; seeds 620 to 651 were for development.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.api.replays import replay
from terrafusion.fusion.metrics.scores import Outage
from tests.studies.opponents import ekf
from tests.studies.opponents.drives import vehicle_of
from tests.studies.opponents.ours import ELLIPSE_95
from tests.studies.opponents.protocol import LEAST_M, streams_of
from tests.studies.opponents.summary import geometric_mean, ratio
from tests.studies.parts import Task, TaskWorkers, add_options, code_of, library_code, result_of, run_all
from tests.studies.unseen_robots.draw import RECEIVERS, draw
from tests.studies.unseen_robots.machine import drive
from tests.studies.unseen_robots.sensors import recording_of

BEGIN_S, WARM_S, OUTAGE_S, AFTER_S = (0.0, 35.0, 70.0, 105.0, 140.0), (8.0, 20.0), 20.0, 25.0
FAR = 9.21
"""99 % point of chi-square with two degrees of freedom."""
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Start:
    """An outage soon after a start; `inside` and `far`: shares of its errors by their ellipses."""

    receiver: str
    warm_s: float
    ekf_m: float
    error_m: float
    inside: float
    far: float


def part(recording: Recording, begin_s: float, seconds: float) -> Recording:
    """A recording that begins later and ends after so long; its truth stays whole."""
    begin_ns = recording.start_ns + round(begin_s * 1e9)
    end_ns = begin_ns + round(seconds * 1e9)
    channels: dict[str, Any] = {
        name: channel.between(begin_ns, end_ns) for name, channel in recording.channels().items()
    }
    return dataclasses.replace(recording, start_ns=begin_ns, **channels)


def compute(seed: int) -> list[dict[str, Any]]:
    """All starts of the robot of a seed; one that has not started before the end has no row."""
    robot, rows = draw(seed), []
    whole = recording_of(robot, drive(robot))
    for begin_s in BEGIN_S:
        for warm_s in WARM_S:
            run = part(whole, begin_s, warm_s + OUTAGE_S + AFTER_S)
            found = start_of(run, robot.receiver.name, warm_s)
            rows += [] if found is None else [asdict(found)]
    return rows


def start_of(run: Recording, receiver: str, warm_s: float) -> Start | None:
    """The outage of one run; None where the robot hardly moves, or nothing is estimated at its end."""
    streams = streams_of(run, vehicle_of(run, None))
    if streams is None or streams.driven_m(warm_s, OUTAGE_S) < LEAST_M:
        return None
    _, path_m = ekf.run(streams, lambda t: warm_s <= t < warm_s + OUTAGE_S)
    theirs = streams.error_m(streams.t_s, path_m, warm_s, OUTAGE_S)
    try:
        result = replay(run, mode="fixed", outages=[Outage(warm_s, OUTAGE_S)])
    except TerrafusionError:  # nothing shows where the robot is
        return None
    errors, (outage,) = result.scores.errors, result.scores.outages
    if errors is None or theirs is None or outage.end_error_m is None:
        return None
    squares = 2.0 * errors.nees()[Outage(warm_s, OUTAGE_S).covers(errors.t_ns, run.start_ns)]
    squares = squares[np.isfinite(squares)]
    inside, far = float(np.mean(squares <= ELLIPSE_95)), float(np.mean(squares > FAR))
    return Start(receiver, warm_s, theirs, outage.end_error_m, inside, far)


def table(starts: list[Start]) -> list[str]:
    """A line a receiver and time, and one for all."""
    lines = []
    for warm_s in WARM_S:
        for receiver in (*RECEIVERS, "all"):
            mine = [s for s in starts if s.warm_s == warm_s and receiver in (s.receiver, "all")]
            if not mine:
                continue
            over = geometric_mean([ratio(s.error_m, s.ekf_m) for s in mine]).text()
            errors = np.array([s.error_m for s in mine])
            inside, far = (100.0 * float(np.mean([getattr(s, k) for s in mine])) for k in ("inside", "far"))
            lines.append(
                f"{receiver}, outage {warm_s:g} s after the start ({len(mine)}): "
                f"error {np.median(errors):.2f} m, worst {errors.max():.1f}, over EKF {over}; "
                f"inside 95 % ellipses {inside:.0f} %, outside those of 99 % {far:.0f} %"
            )
    return lines


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.unseen_robots.starts", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="folder for parts")
    parser.add_argument("--robots", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=660)
    add_options(parser)
    given = parser.parse_args()
    code = library_code() + code_of(
        *(HERE / f"{name}.py" for name in ("draw", "machine", "sensors", "starts"))
    )
    seeds = range(given.first_seed, given.first_seed + given.robots)
    tasks = [Task(f"starts of robot {k}", code, k) for k in seeds]
    run_all(tasks, compute, given.out / "parts", TaskWorkers.of(given))
    done = [found for task in tasks if (found := result_of(task, given.out / "parts")) is not None]
    print("\n".join(table([Start(**row) for rows in done for row in rows])))
    if len(done) < len(tasks):
        print(f"{len(tasks) - len(done)} of {len(tasks)} robots not run yet")
    return 0


if __name__ == "__main__":
    from tests.studies.unseen_robots import starts

    sys.exit(starts.main())  # workers know the tasks by the module's own name
