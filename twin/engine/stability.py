"""How many integration steps a sample a stiff robot needs.

On hard ground a wheel at rest is the stiffest part of the model: the shear of the ground is damped, and the
less it gives way, the faster. An explicit step that is too long does not diverge there, but shakes the wheels
within the give of the ground.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from terrafusion.twin.engine.integrate import steps_a_sample
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import INPUTS, STATES, WHEELS

STABLE = {3: 2.51, 4: 2.78}
"""Step times fastest rate up to which Runge-Kutta steps of an order are stable, on the real axis."""
MARGIN = 1.1  # factor on that rate (assumed): further effects may make the robot stiffer
DIFFERENCE = 1e-7  # of the states, for derivatives


def stable_steps(dt_s: float, plant: Plant, order: int) -> int:
    """Steps of a Runge-Kutta order in a sample interval with which the plant is stable at rest on all its
    soils; no fewer than `steps_a_sample`."""
    effects = tuple(sorted(plant.effects.items()))
    rates = [_rate_at_rest(plant.vehicle.tobytes(), soil.tobytes(), effects) for soil in plant.route.soil]
    fastest = MARGIN * max(rates)
    return max(steps_a_sample(dt_s, plant.vehicle), math.ceil(dt_s * fastest / STABLE[order]))


@functools.lru_cache(maxsize=256)
def _rate_at_rest(vehicle: bytes, soil: bytes, effects: tuple[tuple[str, float], ...]) -> float:
    """Greatest magnitude of the eigenvalues of the model at rest, 1/s."""
    numbers = np.frombuffer(vehicle), np.tile(np.frombuffer(soil), len(WHEELS))
    function = rhs(tuple(key for key, _ in effects))
    values = np.array([value for _, value in effects])
    moved = DIFFERENCE * np.eye(len(STATES))
    rates = np.asarray(function(np.hstack([moved, -moved]), np.zeros(len(INPUTS)), *numbers, values))
    ahead, behind = np.hsplit(rates, 2)
    return float(np.abs(np.linalg.eigvals((ahead - behind) / (2.0 * DIFFERENCE))).max())
