"""How many integration steps a sample a robot needs.

On hard ground a wheel at rest is the stiffest part of the model: the shear of the ground is damped, and the
less it gives way, the faster. An explicit step that is too long does not diverge there, but shakes the wheels
within the give of the ground.
"""

import functools
import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import ENERGIES, INDEX, INPUTS, STATES, VEHICLE_PARAMETERS, WHEELS

MAX_STEP_S = 1.0 / 300.0
"""Longest step."""
MAX_STEP_LAGS = 5.0 / 3.0
"""Longest step in motor lags, as a rule the fastest mode of the model: RK4 is stable to 2.78 of them."""

STABLE = {3: 2.51, 4: 2.78}
"""Step times fastest rate up to which Runge-Kutta steps of an order are stable, on the real axis."""
MARGIN = 1.1  # factor on that rate (assumed): further effects may make the robot stiffer
MAX_STEPS = 1000  # a sample; more would take minutes for a short drive
DIFFERENCE = 1e-7  # of the states, for derivatives
_SUMS = {"x", "y", "yaw", "clog", "travel", "elapsed", *ENERGIES, *(f"wheel_angle_{name}" for name in WHEELS)}
_FAST = [INDEX[name] for name in STATES if name not in _SUMS]  # sums of others have no fast modes


def steps_a_sample(dt_s: float, vehicle: Array) -> int:
    """Steps in a sample interval: few enough to be fast, short enough for the vehicle's motor lag."""
    lag_s = float(vehicle[VEHICLE_PARAMETERS.index("lag_s")])
    return max(1, math.ceil(dt_s / min(MAX_STEP_S, MAX_STEP_LAGS * lag_s) - 1e-9))


def stable_steps(dt_s: float, plant: Plant, order: int) -> int:
    """Steps of a Runge-Kutta order in a sample interval with which the plant is stable at rest on all its
    soils; no fewer than `steps_a_sample`.

    Raises:
        TerrafusionError: more than `MAX_STEPS`.
    """
    effects = tuple((name, plant.effects[name]) for name in plant.effect_names())
    field = plant.route.field
    soils = [*plant.route.soil, *([] if field is None else [field.patch_soil])]
    rates = [_rate_at_rest(plant.vehicle.tobytes(), soil.tobytes(), effects) for soil in soils]
    steps = math.ceil(dt_s * MARGIN * max(rates) / STABLE[order])
    if steps > MAX_STEPS:
        raise TerrafusionError(
            f"the twin is too stiff: the fastest motion at rest takes {1e6 / max(rates):.2g} us",
            remedy="check wheel.inertia_kgm2, the speed loop and the soil's shear_modulus_m",
        )
    return max(steps_a_sample(dt_s, plant.vehicle), steps)


@functools.lru_cache(maxsize=256)
def _rate_at_rest(vehicle: bytes, soil: bytes, effects: tuple[tuple[str, float], ...]) -> float:
    """Greatest magnitude of the eigenvalues of the model at rest, 1/s."""
    numbers = np.frombuffer(vehicle), np.tile(np.frombuffer(soil), len(WHEELS))
    function = rhs(tuple(key for key, _ in effects))
    values = np.array([value for _, value in effects])
    moved = DIFFERENCE * np.eye(len(STATES))[:, _FAST]
    rates = np.asarray(function(np.hstack([moved, -moved]), np.zeros(len(INPUTS)), *numbers, values))
    if not np.isfinite(rates).all():
        return 0.0  # no step is short enough: the run says where it diverges
    ahead, behind = np.hsplit(rates[_FAST], 2)
    return float(np.abs(np.linalg.eigvals((ahead - behind) / (2.0 * DIFFERENCE))).max())
