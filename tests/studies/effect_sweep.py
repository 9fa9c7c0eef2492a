"""Every effect of the catalogue in runs of the twin itself, and what the diagnosis says: a table.

    python -m tests.studies.effect_sweep --terrain medium_sand --sizes 1 3

The first form of each effect, at multiples of its typical size, is put into three simulated runs with all
sensor noise; twenty others have none. The ground's strength varies from run to run. The law is the twin's:
this tells what a drive can show and what it cannot, and is an upper bound of everything else.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.effects.catalogue import lookup
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.diagnose import diagnose
from terrafusion.twin.gap.rollout.sensitivities import Linearisation
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

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
        drive = Scenario(
            "exciting", 60.0, route=(RouteLeg(self.soil),), drive=tuple(DriveSegment(*s) for s in SEGMENTS)
        )
        rng = np.random.default_rng([self.seed, number])
        own = {key: SPREAD * float(rng.standard_normal()) for key in GROUND}
        for key, value in effects.items():
            own[key] = own.get(key, 0.0) + value
        run = simulate(drive, vehicle=self.vehicle, seed=1000 * self.seed + number, effects=own)
        return dataclasses.replace(run, name=f"run{number}", truth=None, truth_channels=())

    def diagnoses(self, changes: Sequence[Mapping[str, float]]) -> Iterator[GapDiagnosis]:
        """One for each change, against the same references."""
        normal = [self.recorded(i, {}) for i in range(self.references)]
        cache = dict[str, Linearisation]()
        for i, change in enumerate(changes):
            first = self.references + i * self.runs
            judged = [self.recorded(first + k, change) for k in range(self.runs)]
            yield diagnose(judged, normal, self.vehicle, cache=cache)


def first_forms(effects: Sequence[str] | None = None) -> dict[str, str]:
    """The first key of each effect of the catalogue, or of some.

    Raises:
        ConfigError: an effect is unknown.
    """
    found: dict[str, str] = {}
    for key in Candidates.of(effects).keys:
        found.setdefault(key.split("/")[0], key)
    return found


def row(found: GapDiagnosis, key: str, size: float) -> str:
    """A line of the table."""
    told = found.to_json()
    first, unit = told["causes"][0], lookup(key)[1].unit
    number = next((c["parameters"][key] for c in told["causes"] if key in c["parameters"]), None)
    others = [name for name in first["class"] if name != first["effect"]]
    cells = (
        f"`{key}`", f"{size:.3g} {unit}".rstrip(), f"{told['gap']['p_value']:.2f}", told["verdict"],
        f"{', '.join([first['effect'], *others])} ({first['probability']:.2f})" if found.detected else "",
        ", ".join(told["named"]),
        f"{number['value']:.3g} +- {number['sigma'] or 0.0:.1g}" if number and found.detected else "",
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
    given = parser.parse_args(arguments)
    if given.runs < 1 or min(given.references, given.seed) < 0:
        parser.error("--runs is at least 1, --references and --seed at least 0")
    try:
        bench = Bench(load_vehicle(given.vehicle), given.terrain, given.runs, given.references, given.seed)
        cases = []
        for key in first_forms(given.effects).values():
            number = lookup(key)[1]
            cases += [(key, min(share * number.scale, number.high)) for share in given.sizes]
        head = "| " + " | ".join(HEAD) + " |\n|" + " --- |" * len(HEAD) + "\n"
        for (key, size), found in zip(cases, bench.diagnoses([dict([case]) for case in cases]), strict=True):
            print(head + row(found, key, size), flush=True)
            head = ""
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
