"""The diagnosis on a site whose ground varies more within a run than that of the references.

All runs are the twin's own, on the references' drive and without an effect: what alarms is a false alarm. In
half of the trials the ground varies as much as the references', in the other half twice as much and within
shorter distances. Nothing of the diagnosis is set on these drives, robots, soils and seeds.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.gap.blind.rates import rate
from terrafusion.twin.gap.diagnose import SIGNIFICANCE, diagnose
from terrafusion.twin.model.ground import Variation
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.studies.gap_sets import GROUND, KINDS, SPREAD, segments
from tests.studies.parts import TaskWorkers, add_options, answers

PLACES = (
    ("elevate", "grass"), ("husky", "loose_sand"), ("warthog", "gravel"), ("elevate", "medium_sand"),
    ("husky", "grass"), ("elevate", "gravel"),
)  # fmt: skip
USUAL = Variation(strength_sigma=0.15, length_m=2.5)
SITES = {"as the references'": USUAL, "patchier": Variation(strength_sigma=0.3, length_m=1.0)}
REFERENCES, RUNS, FIRST_SEED = 8, 2, 88_000_000
OFF = {"mass/at_cg": 0.1, "track_width/scale": 0.1, "soil_strength/shear": 0.3}
"""Greatest errors of the robot's file and of the soil's label, which all runs of a trial share."""


def judged(trial: tuple[int, str]) -> dict[str, Any]:
    """The answer to one trial: number and site."""
    number, site = trial
    rng = np.random.default_rng([FIRST_SEED, number])
    robot, soil = PLACES[number % len(PLACES)]
    kind = str(rng.choice(list(KINDS)))
    drive = segments(kind, rng)
    off = {key: float(rng.uniform(-most, most)) for key, most in OFF.items()}

    def run(index: int, ground: Variation) -> Recording:
        own, seed = dict(off), FIRST_SEED + 1000 * number + index
        for key, z in zip(GROUND, np.random.default_rng(seed).standard_normal(len(GROUND)), strict=True):
            own[key] = own.get(key, 0.0) + SPREAD * float(z)
        length = sum(s.duration_s for s in drive)
        scenario = Scenario(kind, length, route=(RouteLeg(soil),), drive=drive, variation=ground)
        made = simulate(scenario, vehicle=robot, seed=seed, effects=own)
        return dataclasses.replace(made, name=f"run {seed}", truth=None, truth_channels=())

    references = [run(i, USUAL) for i in range(REFERENCES)]
    runs = [run(500 + i, SITES[site]) for i in range(RUNS)]
    answer = diagnose(runs, references, load_vehicle(robot), soil, jobs=1).to_json()
    return {key: answer["gap"][key] for key in ("detected", "p_value")} | {
        "where": f"{robot}, {soil}, {kind}",
        "place": min(cell["p_value"] for cell in answer["where"]),
    }


def main() -> int:
    """Print a line a trial, then false alarms and false places by site with their intervals."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=8, help="of each site")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args()
    wanted = [(number, site) for number in range(given.trials) for site in SITES]
    found = dict(zip(wanted, answers(wanted, judged, TaskWorkers.of(given), given.out), strict=True))
    for (_, site), one in found.items():
        print(f"{one['where']:28s} ground {site:20s} p {one['p_value']:.2g}, of a place {one['place']:.2g}")
    for site in SITES:
        some = [one for (_, own), one in found.items() if own == site]
        places = rate([one["place"] <= SIGNIFICANCE for one in some])
        for name, share in (("alarms", rate([one["detected"] for one in some])), ("places", places)):
            low, high = share.interval()
            print(f"false {name}, ground {site}: {share.hits} of {share.count} ({low:.2f} to {high:.2f})")
    return 0


if __name__ == "__main__":
    from tests.studies import gap_sites

    raise SystemExit(gap_sites.main())  # workers know the trials by the module's own name
