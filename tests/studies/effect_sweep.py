"""Every effect of the catalogue in runs of the twin itself, and what the diagnosis says: a table.

    python -m tests.studies.effect_sweep --terrain medium_sand --sizes 1 3

The first form of each effect, at multiples of its typical size, is put into three simulated runs with all
sensor noise; twenty others have none. The ground's strength varies from run to run. The law is the twin's:
this tells what a drive can show and what it cannot, and is an upper bound of everything else.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.effects.catalogue import lookup
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.gap.rollout.sensitivities import Linearisation
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.parts import TaskWorkers, add_options, answers

SEGMENTS = (
    (0.5, 0.0, 0.0), (5.0, 0.8, 0.4), (5.0, 1.2, -0.5), (4.0, 0.5, 0.0), (4.0, 0.0, 0.8), (5.0, 1.4, 0.0),
    (4.0, 0.5, 0.5), (5.0, 1.0, -0.4), (3.0, 0.0, 0.0), (4.0, 1.6, 0.0), (4.0, -0.6, 0.0), (4.0, 0.0, -0.8),
    (4.0, 0.9, 0.3), (4.0, 1.3, -0.3), (4.5, 0.7, 0.0),
)  # fmt: skip
"""Seconds, m/s and rad/s: turns both ways, spins, fast, slow, in reverse, and at rest; 60 s."""
GROUND = ("soil_strength/shear", "soil_strength/bearing")
SPREAD = 0.05
"""1 sigma of the logarithm of the ground's strength and bearing from run to run (assumed)."""
HEAD = ("effect", "size", "p", "verdict", "first (probability)", "named", "found")


@dataclass(frozen=True)
class Bench:
    """A robot on a ground, and the drive of all runs."""

    vehicle: VehicleParams
    soil: str
    runs: int
    references: int
    seed: int

    def recorded(self, number: int, effects: Mapping[str, float]) -> Recording:
        """A run without a truth channel."""
        seconds, segments = sum(s[0] for s in SEGMENTS), tuple(DriveSegment(*s) for s in SEGMENTS)
        drive = Scenario("exciting", seconds, route=(RouteLeg(self.soil),), drive=segments)
        rng = np.random.default_rng([self.seed, number])
        own = {key: SPREAD * float(rng.standard_normal()) for key in GROUND}
        for key, value in effects.items():
            own[key] = own.get(key, 0.0) + value
        run = simulate(drive, vehicle=self.vehicle, seed=1000 * self.seed + number, effects=own)
        return dataclasses.replace(run, name=f"run{number}", truth=None, truth_channels=())

    def normal(self) -> list[Recording]:
        """The references of all changes."""
        return [self.recorded(i, {}) for i in range(self.references)]


@functools.lru_cache(maxsize=1)
def bench_of(
    vehicle: str, soil: str, runs: int, references: int, seed: int
) -> tuple[Bench, list[Recording], dict[str, Linearisation]]:
    """A bench, its references, and what has been computed of them in this process."""
    bench = Bench(load_vehicle(vehicle), soil, runs, references, seed)
    return bench, bench.normal(), {}


def answer(case: tuple[tuple[str, str, int, int, int], int, str, float]) -> dict[str, Any]:
    """The diagnosis of one change: bench, number of the case, parameter and size."""
    of, number, key, size = case
    bench, normal, cache = bench_of(*of)
    first = bench.references + number * bench.runs
    judged = [bench.recorded(first + k, {key: size}) for k in range(bench.runs)]
    return diagnose(judged, normal, bench.vehicle, cache=cache).to_json()


def first_forms(effects: Sequence[str] | None = None) -> dict[str, str]:
    """The first key of each effect of the catalogue, or of some.

    Raises:
        ConfigError: an effect is unknown.
    """
    found: dict[str, str] = {}
    for key in Candidates.of(effects).keys:
        found.setdefault(key.split("/")[0], key)
    return found


def row(told: Mapping[str, Any], key: str, size: float) -> str:
    """A line of the table."""
    detected = told["gap"]["detected"]
    first, unit = told["causes"][0], lookup(key)[1].unit
    number = next((c["parameters"][key] for c in told["causes"] if key in c["parameters"]), None)
    others = [name for name in first["class"] if name != first["effect"]]
    cells = (
        f"`{key}`", f"{size:.3g} {unit}".rstrip(), f"{told['gap']['p_value']:.2f}", told["verdict"],
        f"{', '.join([first['effect'], *others])} ({first['probability']:.2f})" if detected else "",
        ", ".join(told["named"]),
        f"{number['value']:.3g} +- {number['sigma'] or 0.0:.1g}" if number and detected else "",
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 0, or 1 after a known error."""
    parser = argparse.ArgumentParser(
        description="Every effect in runs of the twin itself, and what is said of it."
    )
    parser.add_argument("--vehicle", default="elevate")
    parser.add_argument("--terrain", default="medium_sand")
    parser.add_argument("--sizes", type=float, nargs="+", default=[1.0, 3.0], help="in typical sizes")
    parser.add_argument("--effects", nargs="+", help="default: the whole catalogue")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--references", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args(arguments)
    if given.runs < 1 or min(given.references, given.seed) < 0:
        parser.error("--runs is at least 1, --references and --seed at least 0")
    try:
        bench = (given.vehicle, given.terrain, given.runs, given.references, given.seed)
        cases = []
        for key in first_forms(given.effects).values():
            number = lookup(key)[1]
            cases += [(key, min(share * number.scale, number.high)) for share in given.sizes]
        trials = [(bench, number, *case) for number, case in enumerate(cases)]
        found = answers(trials, answer, TaskWorkers.of(given), given.out)
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("| " + " | ".join(HEAD) + " |\n|" + " --- |" * len(HEAD))
    for told, (key, size) in zip(found, cases, strict=True):
        print(row(told, key, size))
    return 0


if __name__ == "__main__":
    from tests.studies import effect_sweep

    sys.exit(effect_sweep.main())  # workers know the cases by the module's own name
