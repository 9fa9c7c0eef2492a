"""How honest sigma is: twin drives with known numbers, calibrated, and the truth counted within two sigma.

`python -m tests.studies.coverage --cases 100` draws for each case a ground, a drive and the
true numbers (uniformly within +-20 to 30 % of the files' values), simulates it with all sensor noise,
calibrates it from the files' values and prints, for each number, how often the truth lies within two sigma.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.calibrate import calibrate
from terrafusion.twin.calibrate.identifiability import IDENTIFIED, NOT_IDENTIFIED
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run
from tests.studies.parts import TaskWorkers, add_options, answers

SOILS = ("asphalt", "loose_sand", "medium_sand", "mud")
DRIVES = ("figure_eight", "chirp", "staircase", "circle")
SECONDS = 60.0
SPREAD = {
    "soil.shear.friction_cap": 0.3,
    "soil.shear.shear_modulus_m": 0.3,
    "soil.resistance.rolling": 0.3,
    "vehicle.wheel.radius_m": 0.2,
    "vehicle.body.track_m": 0.2,
    "vehicle.body.mass_kg": 0.3,
}
"""True numbers are drawn uniformly within this share of the files' values."""


@dataclass(frozen=True)
class Outcome:
    """One number of one case: error over sigma in the fit's own coordinate, relative sigma, status."""

    case: int
    name: str
    score: float
    relative_sigma: float
    status: str


@dataclass(frozen=True)
class Case:
    """Ground, drive and the true numbers by name, as `soil.` and `vehicle.` names."""

    number: int
    soil: str
    drive: str
    truth: dict[str, float]
    seed: int

    @classmethod
    def drawn(cls, number: int, seed: int) -> Case:
        """Case `number` of the study with this seed."""
        rng = np.random.default_rng([seed, number])
        soil, drive = SOILS[rng.integers(len(SOILS))], DRIVES[rng.integers(len(DRIVES))]
        model = Model(load_vehicle("elevate"), {soil: load_soil(soil)})
        factors = {name: 1.0 + rng.uniform(-spread, spread) for name, spread in SPREAD.items()}
        truth = {name: factor * model.value(_spelt(name, soil)) for name, factor in factors.items()}
        return cls(number, soil, drive, truth, int(rng.integers(2**31)))

    def recorded(self, *, noiseless: bool = False, repeat: int = 0) -> Recording:
        """The drive with the true numbers; `repeat` changes the noise only."""
        model = Model(load_vehicle("elevate"), {self.soil: load_soil(self.soil)})
        model = model.replaced({_spelt(name, self.soil): value for name, value in self.truth.items()})
        scenario = dataclasses.replace(load_scenario(self.drive), duration_s=SECONDS)
        recording = simulate_run(
            scenario.with_ground(self.soil, None), vehicle=model.vehicle, soils=model.soils,
            seed=self.seed + repeat, noiseless=noiseless,
        ).recording  # fmt: skip
        return dataclasses.replace(recording, truth=None, truth_channels=())


def _spelt(name: str, soil: str) -> str:
    return name.replace("soil.", f"{soil}.", 1)


def outcomes(case: Case, names: Sequence[str] = tuple(SPREAD)) -> list[Outcome]:
    """The case calibrated from the files' values."""
    found = calibrate(case.recorded(), "elevate", case.soil, names)
    out = []
    for name in names:
        fitted = found[name]
        relative = fitted.sigma / abs(fitted.value)
        score = math.log(fitted.value / case.truth[name]) / relative
        out.append(Outcome(case.number, name, score, relative, fitted.status))
    return out


def answer(case: tuple[int, int]) -> list[dict[str, Any]] | str:
    """The outcomes of the case of a number and a seed, or why it failed."""
    drawn = Case.drawn(*case)
    try:
        return [dataclasses.asdict(one) for one in outcomes(drawn)]
    except TerrafusionError as error:
        return f"case {drawn.number} ({drawn.soil}, {drawn.drive}): {error}"


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    low = float(beta.ppf(0.025, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def table(found: Sequence[Outcome]) -> list[str]:
    """Coverage of each number and of all, for what was told and for what was not."""
    lines = [
        f"{'parameter':32s} {'cases':>5s} {'within 2 sigma':>24s} {'rms score':>9s} {'median sigma':>12s}"
    ]
    names = list(dict.fromkeys(o.name for o in found))
    for name in [*names, "all"]:
        mine = [o for o in found if name in ("all", o.name) and o.status == IDENTIFIED]
        lines.append(_row(name, mine))
    lines.append(
        _row("all, only in combination", [o for o in found if o.status not in (IDENTIFIED, NOT_IDENTIFIED)])
    )
    lines.append(_row("all, not identified", [o for o in found if o.status == NOT_IDENTIFIED]))
    return lines


def _row(name: str, found: Sequence[Outcome]) -> str:
    if not found:
        return f"{name:32s} {0:5d}"
    scores = np.array([o.score for o in found])
    hits = int(np.sum(np.abs(scores) <= 2.0))
    low, high = interval(hits, len(found))
    share = f"{100 * hits / len(found):5.1f} % ({100 * low:.0f} to {100 * high:.0f})"
    median = 100 * float(np.median([o.relative_sigma for o in found]))
    return f"{name:32s} {len(found):5d} {share:>24s} {np.sqrt(np.mean(scores**2)):9.2f} {median:10.3f} %"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description="coverage of calibrate on drives of the twin")
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--verbose", action="store_true", help="one line a case")
    parser.add_argument("--out", type=Path, help="folder for parts; the same command continues")
    add_options(parser)
    given = parser.parse_args(arguments)
    begun = time.perf_counter()
    cases = [(number, given.seed) for number in range(given.first, given.first + given.cases)]
    told = answers(cases, answer, TaskWorkers.of(given), given.out)
    found = [Outcome(**row) for one in told if isinstance(one, list) for row in one]
    failed = sum(isinstance(one, str) for one in told)
    for one in told:
        if isinstance(one, str):
            print(one, file=sys.stderr)
        elif given.verbose:
            scores = " ".join(f"{o['score']:6.2f}{'' if o['status'] == IDENTIFIED else '*'}" for o in one)
            print(f"{one[0]['case']:4d} {scores}")
    seconds = time.perf_counter() - begun
    print(f"seed {given.seed}, {given.cases} cases of {SECONDS:g} s, {failed} failed, {seconds:.0f} s")
    for line in table(found):
        print(line)


if __name__ == "__main__":
    from tests.studies import coverage

    coverage.main()  # workers know the cases by the module's own name
