"""Suggests manoeuvres that would identify the unresolved parameters, by their information in the twin."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.calibrate.coordinates import Coordinate, Prior
from terrafusion.twin.calibrate.log import prepare
from terrafusion.twin.calibrate.model import resolve
from terrafusion.twin.calibrate.noise_learning import first_noise
from terrafusion.twin.calibrate.problem import Problem
from terrafusion.twin.calibrate.result import Calibration
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run

SECONDS = 60.0
CANDIDATES = (
    ("straight", 0.0), ("straight", 10.0), ("circle", 0.0), ("figure_eight", 10.0), ("spin", 0.0),
    ("staircase", 0.0), ("chirp", 0.0),
)  # fmt: skip
"""Scenarios and slopes (deg) to choose from."""


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A manoeuvre, and the posterior over prior sigma of a parameter, now and with that drive added."""

    name: str
    scenario: str
    slope_deg: float
    ratio_now: float
    ratio_then: float

    def sentence(self) -> str:
        """In words."""
        slope = f" on a slope of {self.slope_deg:g} deg" if self.slope_deg else ""
        return (
            f"{self.name}: of the drives tried, '{self.scenario}'{slope} identifies it best; its sigma would "
            f"be {100.0 * self.ratio_then:.0f} % of the prior's (now {100.0 * self.ratio_now:.0f} %)"
        )


def suggest(
    calibration: Calibration, candidates: Sequence[tuple[str, float]] = CANDIDATES
) -> list[Suggestion]:
    """For each parameter that is not identified alone, the drive of `SECONDS` that would identify it best.

    A forecast for the first ground, with the fitted parameters and the (white) noise of the data sheets. A
    drive the twin cannot do is left out.
    """
    open_ones = calibration.unidentified()
    if not open_ones:
        return []
    names = [f.name for f in calibration.fitted]
    ratios = np.array([f.ratio for f in calibration.fitted])
    now = np.linalg.inv(calibration.correlation * np.outer(ratios, ratios))
    then = {}
    for scenario, slope_deg in candidates:
        information = _information(calibration, scenario, slope_deg)
        if information is not None:
            then[scenario, slope_deg] = np.sqrt(np.diag(np.linalg.inv(now + information)))
    out = []
    for f in open_ones:
        i = names.index(f.name)
        if then:
            best = min(then, key=lambda key: float(then[key][i]))
            out.append(Suggestion(f.name, *best, f.ratio, float(then[best][i])))
    return out


def _information(calibration: Calibration, scenario: str, slope_deg: float) -> Array | None:
    """Information (P, P) of a drive in units of the priors; None where the twin cannot do it."""
    model, ground = calibration.model, next(iter(calibration.model.soils))
    planned = dataclasses.replace(load_scenario(scenario), duration_s=SECONDS).with_ground(ground, slope_deg)
    try:
        run = simulate_run(planned, vehicle=model.vehicle, soils=model.soils, noiseless=True)
        sloped = dataclasses.replace(model, slope_rad=math.radians(slope_deg), aspect_rad=0.0)
        priors = {f.name: Prior(f.prior, f.prior_sigma) for f in calibration.fitted}
        coordinates = [
            Coordinate.of(name, quantity, sloped.value(name), priors[name])
            for name, quantity in resolve(tuple(priors), sloped).items()
        ]
        problem = Problem([prepare(run.recording, sloped, ground=ground)], sloped, coordinates, robust=False)
        point, P = problem.start(), len(coordinates)
        normal = problem.normal(point, problem.blocks(point), first_noise(problem))
    except TerrafusionError:
        return None
    return np.asarray(np.linalg.inv(np.linalg.inv(normal.H)[:P, :P]) - np.eye(P))
