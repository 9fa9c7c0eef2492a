"""The diagnosis on robots in MuJoCo: false alarms, effects detected and effects named.

    python -m tests.studies.unseen_gap.study --out FOLDER [--robots 2] [--first-seed 100]

References are 12 runs of a minute between random way points, judged are three. The owner states mass, wheel
radius, track, wheelbase and the places of the sensors, and calls the ground grass; all else of the twin is
the generic vehicle. Each change of `changes` comes small on every other robot and large on the others. Seeds
below 100 are for development.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from tests.studies.parts import TaskWorkers, add_options, answers
from tests.studies.unseen_gap.changes import FOREIGN, SIZES, Change, Machine, machine
from tests.studies.unseen_gap.plant import ACCEL_MPS2, YAW_ACCEL_RADPS2, Style, run

REFERENCES, RUNS = 12, 3
USUAL, OTHER = Style(1.0, 6.0), Style(0.6, 3.0)
"""Drives of the references, and slower ones with tighter turns."""
CLEAN = 3
"""Clean trials a robot, of each style."""
SOIL = "grass"
DRAG = 0.1
"""The dragged load's share of the weight."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """What is judged: robot, change, whether the drives are other ones than the references', and a number."""

    seed: int
    change: Change
    other: bool
    number: int


def trials(seeds: Sequence[int]) -> list[Trial]:
    """All trials, robot by robot."""
    out = []
    for k, seed in enumerate(seeds):
        changes = [(Change(), other) for other in (False, True) for _ in range(CLEAN)]
        changes += [
            (Change(name, sizes[(i + k) % 2]), False) for i, (name, sizes) in enumerate(SIZES.items())
        ]
        changes += [(Change(name, DRAG), False) for name in FOREIGN]
        out += [Trial(seed, change, other, n) for n, (change, other) in enumerate(changes)]
    return out


def vehicle_of(robot: Machine) -> VehicleParams:
    """What the owner writes of the robot, on the generic vehicle."""
    known = load_vehicle("generic")
    share = robot.mass_kg * robot.radius_m / (known.body.mass_kg * known.wheel.radius_m)
    lift = 1.5 * robot.radius_m
    suite = known.sensors
    return dataclasses.replace(
        known, name=f"robot {robot.seed}",
        body=dataclasses.replace(
            known.body, mass_kg=robot.mass_kg, track_m=robot.track_m, wheelbase_m=robot.wheelbase_m,
            yaw_inertia_kgm2=known.body.yaw_inertia_kgm2 * robot.mass_kg / known.body.mass_kg
            * (robot.track_m / known.body.track_m) ** 2,
            payload_max_kg=robot.mass_kg, cg_height_m=1.2 * robot.radius_m,
        ),
        wheel=dataclasses.replace(known.wheel, radius_m=robot.radius_m),
        drive=dataclasses.replace(
            known.drive, max_accel_mps2=ACCEL_MPS2, max_yaw_accel_radps2=YAW_ACCEL_RADPS2,
            speed_loop_p_nms=known.drive.speed_loop_p_nms * share,
            speed_loop_i_nm=known.drive.speed_loop_i_nm * share,
            torque_limit_nm=known.drive.torque_limit_nm * share,
            stall_torque_nm=known.drive.stall_torque_nm * share,
        ),
        odometry=dataclasses.replace(known.odometry, wheel_radius_m=robot.radius_m, track_m=robot.track_m),
        sensors=dataclasses.replace(
            suite,
            imu=dataclasses.replace(suite.imu, position_m=(*robot.imu_m[:2], robot.imu_m[2] + lift)),
            wheels=dataclasses.replace(
                suite.wheels, rate_hz=robot.wheels_hz, quantum_rad=2.0 * np.pi / robot.counts
            ),
            gnss=dataclasses.replace(
                suite.gnss, sigma_horizontal_m=0.02, sigma_vertical_m=0.04,
                antenna_m=(*robot.antenna_m[:2], robot.antenna_m[2] + lift),
            ),
        ),
    )  # fmt: skip


@functools.lru_cache(maxsize=1)
def references_of(seed: int) -> tuple[list[Recording], dict[str, Any]]:
    """References of a robot, and what has been computed of them in this process."""
    return [run(machine(seed), Change(), USUAL, k) for k in range(REFERENCES)], {}


def judged(trial: Trial) -> dict[str, Any]:
    """The answer to one trial."""
    references, cache = references_of(trial.seed)
    robot, style = machine(trial.seed), OTHER if trial.other else USUAL
    runs = [run(robot, trial.change, style, 1000 + 10 * trial.number + k) for k in range(RUNS)]
    began = time.process_time()
    answer = diagnose(runs, references, vehicle_of(robot), SOIL, cache=cache, jobs=1).to_json()
    return {
        "seconds": time.process_time() - began,
        "detected": answer["gap"]["detected"],
        "p": answer["gap"]["p_value"],
        "verdict": answer["verdict"],
        "named": answer["named"],
        "sets": [one["effects"] for one in answer["sets"] if one["named"]],
        "covered": answer["drives"]["covered"] if answer["drives"] else None,
    }


def lines(wanted: Sequence[Trial], found: Sequence[dict[str, Any]]) -> list[str]:
    """A line a trial, then counts with intervals."""
    out, counts = [], dict[str, list[bool]]()
    for trial, one in zip(wanted, found, strict=True):
        name = trial.change.name
        right = any(name in members for members in one["sets"])
        if not name:
            counts.setdefault("false alarms, " + ("other" if trial.other else "same") + " drives", []).append(
                one["detected"]
            )
        elif name in FOREIGN:
            counts.setdefault("outside the catalogue, called unknown", []).append(one["verdict"] == "unknown")
        else:
            size = "small" if trial.change.size == SIZES[name][0] else "large"
            counts.setdefault(f"{size}, detected", []).append(one["detected"])
            counts.setdefault(f"{size}, right effect in a named set", []).append(one["detected"] and right)
        what = f"{trial.seed} {name or 'none':24s} {trial.change.size:5g} {'other' if trial.other else '':5s}"
        sets = "; ".join(" | ".join(members) for members in one["sets"])
        out.append(f"{what} p {one['p']:.3f} {one['verdict']:10s} {sets}".rstrip())
    for name, hits in counts.items():
        low, high = Rate(sum(hits), len(hits)).interval()
        out.append(f"{name}: {sum(hits)} of {len(hits)} ({low:.2f} to {high:.2f})")
    sizes = [len(members) for one in found for members in one["sets"]]
    out.append(f"mean credible set {np.mean(sizes):.1f}" if sizes else "no effect was named")
    out.append(f"CPU time a diagnosis, median {np.median([one['seconds'] for one in found]):.1f} s")
    return out


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.unseen_gap.study", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for parts; the same command continues"
    )
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=100)
    add_options(parser)
    given = parser.parse_args()
    wanted = trials(range(given.first_seed, given.first_seed + given.robots))
    found = answers(wanted, judged, TaskWorkers.of(given), given.out)
    print("\n".join(lines(wanted, found)))
    return 0


if __name__ == "__main__":
    from tests.studies.unseen_gap import study

    raise SystemExit(study.main())  # workers know the trials by the module's own name
