"""The diagnosis on drives that its references did not make: false alarms, detection and named effects.

All runs are the twin's own, so that nothing but the drive and the effect differs from the references. The
drives, robots, soils, sizes and seeds below are fixed; nothing of the diagnosis is set on them.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

Segments = tuple[tuple[float, float, float], ...]

DRIVES: dict[str, Segments] = {
    "gentle": ((1.0, 0.0, 0.0), (7.0, 0.6, 0.1), (7.0, 0.5, -0.1), (4.0, 0.4, 0.0), (1.0, 0.0, 0.0)),
    "curves": ((1.0, 0.0, 0.0), (6.0, 0.8, 0.4), (6.0, 0.9, -0.4), (6.0, 0.6, 0.3), (1.0, 0.0, 0.0)),
    "starts and stops": (
        (1.0, 0.0, 0.0), (4.0, 1.0, 0.0), (2.0, 0.0, 0.0), (4.0, 0.7, 0.2), (3.0, 0.0, 0.5), (4.0, 1.0, -0.2),
        (2.0, 0.0, 0.0), (4.0, 0.5, 0.0), (4.0, 0.9, 0.3), (1.0, 0.0, 0.0),
    ),
}  # fmt: skip
PAIRS = (("gentle", "curves"), ("curves", "starts and stops"), ("starts and stops", "gentle"))
"""Drive of the references, drive that is judged."""
ROBOTS = (("elevate", "loose_sand"), ("husky", "grass"), ("warthog", "gravel"))
EFFECTS = {
    "wheel_radius/scale": 0.05, "track_width/scale": 0.1, "gyro_scale/scale": 0.08, "mass/at_cg": 0.25,
    "gyro_bias/constant": 0.01, "drivetrain_friction/efficiency": 0.2,
}  # fmt: skip
SPREAD = 0.05
"""1 sigma of the ground's strength from run to run, of the typical size of its parameters."""
GROUND = ("soil_strength/shear", "soil_strength/bearing")


def drive(
    name: str, robot: str, soil: str, seed: int, effects: Mapping[str, float] | None = None
) -> Recording:
    """One run without truth; the strength of the ground varies from run to run."""
    rng = np.random.default_rng(seed)
    own = {key: SPREAD * float(rng.standard_normal()) for key in GROUND}
    segments = tuple(DriveSegment(*s) for s in DRIVES[name])
    scenario = Scenario(name, sum(s.duration_s for s in segments), route=(RouteLeg(soil),), drive=segments)
    made = simulate(scenario, vehicle=robot, seed=seed, effects={**own, **(effects or {})})
    return dataclasses.replace(made, name=f"{robot} {name} {seed}", truth=None, truth_channels=())


@functools.lru_cache(maxsize=1)
def references_of(
    robot: str, name: str, soil: str, first: int, count: int
) -> tuple[list[Recording], dict[str, Any]]:  # fmt: skip
    """References of a robot, and what has been computed of them in this process."""
    return [drive(name, robot, soil, first + i) for i in range(count)], {}


def judged(trial: tuple[str, str, tuple[str, str], int, int, str, int, int]) -> dict[str, Any]:
    """The answer to one trial.

    Args:
        trial: robot, soil, pair of drives and its number; number, effect ("" for none), references and runs.
    """
    robot, soil, pair, number, index, key, count, runs = trial
    first = 1000 * (number + 1)
    references, cache = references_of(robot, pair[0], soil, first, count)
    size = {key: EFFECTS[key]} if key else None
    given = [drive(pair[1], robot, soil, first + 100 + 10 * index + k, size) for k in range(runs)]
    began = time.process_time()
    answer = diagnose(given, references, load_vehicle(robot), soil, cache=cache).to_json()
    return {
        "seconds": time.process_time() - began,
        "detected": answer["gap"]["detected"],
        "class": sorted({e for c in answer["causes"] if c["effect"] in answer["named"] for e in c["class"]}),
        "verdict": answer["verdict"],
        "named": answer["named"],
        "covered": answer["drives"]["covered"] if answer.get("drives") else None,
    }


def trials(given: argparse.Namespace) -> list[tuple[Any, ...]]:
    """All trials, robot by robot and pair by pair: clean ones, then effects in turn."""
    out: list[tuple[Any, ...]] = []
    places = [(*where, pair) for where in ROBOTS[: given.robots] for pair in PAIRS[: given.pairs]]
    keys = list(EFFECTS)
    for number, (robot, soil, pair) in enumerate(places):
        changes = [""] * given.clean
        changes += [keys[(number * given.effects + i) % len(keys)] for i in range(given.effects)]
        for index, key in enumerate(changes):
            out.append((robot, soil, pair, number, index, key, given.references, given.runs))
    return out


def main() -> int:
    """Print a line a diagnosis, then counts with intervals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--references", type=int, default=12)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--clean", type=int, default=2, help="clean trials a pair of drives and robot")
    parser.add_argument("--effects", type=int, default=1, help="trials with an effect, likewise")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    wanted = trials(given)
    found = answers(wanted, judged, TaskWorkers.of(given), given.out)
    for (robot, _, pair, _, _, key, *_), one in zip(wanted, found, strict=True):
        what = f"{robot:8s} {pair[0]} -> {pair[1]:17s} {key or 'none':30s}"
        print(f"{what} {one['verdict']:10s}", *one["named"])
    clean = [one for trial, one in zip(wanted, found, strict=True) if not trial[5]]
    changed = [(trial[5].split("/")[0], one) for trial, one in zip(wanted, found, strict=True) if trial[5]]
    for name, hits, of in (
        ("false alarms", sum(one["detected"] for one in clean), len(clean)),
        ("detected", sum(one["detected"] for _, one in changed), len(changed)),
        ("right effect in a named class", sum(key in one["class"] for key, one in changed), len(changed)),
    ):
        low, high = Rate(hits, of).interval()
        print(f"{name} {hits} of {of} ({low:.2f} to {high:.2f})")
    print(f"CPU time a diagnosis, median {np.median([one['seconds'] for one in found]):.1f} s")
    covered = [one["covered"] for one in found if one["covered"] is not None]
    if covered:
        print(f"drives covered, median {np.median(covered):.2f}")
    return 0


if __name__ == "__main__":
    from tests.studies import gap_other_drives

    raise SystemExit(gap_other_drives.main())  # workers know the trials by the module's own name
