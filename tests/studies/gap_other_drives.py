"""The diagnosis on drives that its references did not make: false alarms, detection and named effects.

All runs are the twin's own, so that nothing but the drive and the effect differs from the references. The
drives, robots, soils, sizes and seeds below are fixed; nothing of the diagnosis is set on them.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

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


@dataclass
class Counts:
    """Answers by what was wanted."""

    alarms: int = 0
    clean: int = 0
    detected: int = 0
    named: int = 0
    effects: int = 0
    covered: list[float] = dataclasses.field(default_factory=list)
    seconds: list[float] = dataclasses.field(default_factory=list)


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927)."""
    if count == 0:
        return 0.0, 1.0
    z, rate = 1.96, hits / count
    middle, half = (
        rate + z * z / (2 * count),
        z * math.sqrt(rate * (1 - rate) / count + (z / (2 * count)) ** 2),
    )
    return (middle - half) / (1 + z * z / count), (middle + half) / (1 + z * z / count)


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


def judge(
    counts: Counts, robot: str, pair: tuple[str, str], soil: str, number: int, given: argparse.Namespace
) -> None:
    """Add the answers for one robot, soil and pair of drives."""
    vehicle, first = load_vehicle(robot), 1000 * (number + 1)
    references = [drive(pair[0], robot, soil, first + i) for i in range(given.references)]
    cache: dict = {}
    trials = [""] * given.clean
    keys = list(EFFECTS)
    trials += [keys[(number * given.effects + i) % len(keys)] for i in range(given.effects)]
    for i, key in enumerate(trials):
        size = {key: EFFECTS[key]} if key else None
        runs = [drive(pair[1], robot, soil, first + 100 + 10 * i + k, size) for k in range(given.runs)]
        began = time.process_time()
        answer = diagnose(runs, references, vehicle, soil, cache=cache).to_json()
        counts.seconds.append(time.process_time() - began)
        found = answer["gap"]["detected"]
        sets = {e for c in answer["causes"] if c["effect"] in answer["named"] for e in c["class"]}
        if key:
            counts.effects += 1
            counts.detected += found
            counts.named += key.split("/")[0] in sets
        else:
            counts.clean += 1
            counts.alarms += found
        if answer.get("drives"):
            counts.covered.append(answer["drives"]["covered"])
        print(
            f"{robot:8s} {pair[0]} -> {pair[1]:17s} {key or 'none':30s} {answer['verdict']:10s}",
            *answer["named"],
            flush=True,
        )


def main(arguments: list[str] | None = None) -> Counts:
    """Print a line a diagnosis, then counts with intervals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--references", type=int, default=12)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--clean", type=int, default=2, help="clean trials a pair of drives and robot")
    parser.add_argument("--effects", type=int, default=1, help="trials with an effect, likewise")
    parser.add_argument("--pairs", type=int, default=3)
    given = parser.parse_args(arguments)
    counts, number = Counts(), 0
    for robot, soil in ROBOTS[: given.robots]:
        for pair in PAIRS[: given.pairs]:
            judge(counts, robot, pair, soil, number, given)
            number += 1
    for name, hits, of in (
        ("false alarms", counts.alarms, counts.clean),
        ("detected", counts.detected, counts.effects),
        ("right effect in a named class", counts.named, counts.effects),
    ):
        low, high = wilson(hits, of)
        print(f"{name} {hits} of {of} ({low:.2f} to {high:.2f})")
    print(f"CPU time a diagnosis, median {np.median(counts.seconds):.1f} s")
    if counts.covered:
        print(f"drives covered, median {np.median(counts.covered):.2f}")
    return counts


if __name__ == "__main__":
    main()
