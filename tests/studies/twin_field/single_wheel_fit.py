"""The wheel model on a measured wheel: steady forces and sinkage of the single-wheel trials, and their fit.

The trials are those of `wheel_trials` (Pavlov and Johnson, CMU; MIT licence): a smooth wheel
pulled and pushed through dry sand at given slip and side-slip. The model takes slip, side-slip and load
and predicts tractive force, side force and sinkage; the trials were slow (1 cm/s) and the model does not
know speed, so it is evaluated at 1 m/s, above the speeds where its terms fade for a standing wheel.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.physics.layout import SOIL_PARAMETERS
from tests.studies.twin_field.wheel_trials import WheelTrials

Array = NDArray[np.float64]

RADIUS_M, WIDTH_M = 0.058, 0.050
"""The smooth wheel: Pavlov and Johnson (2024), authors' code."""
OUTPUTS = ("tractive_force_n", "side_force_n", "sinkage_m")

EXPONENT, UNIT_WEIGHT_N_PER_M3 = 1.4, 13_030.0
"""Of the trials' sand: Pavlov and Johnson (2024), authors' code (exponent of this wheel, its density)."""


@dataclass(frozen=True)
class Free:
    """A soil number that is fitted: where it starts and between what it must stay."""

    start: float
    low: float
    high: float


FREE = {
    "k_phi": Free(8.0e6, 1.0e5, 1.0e9),
    "slip_sinkage": Free(1.5, 0.0, 9.0),
    "skid_sinkage": Free(3.0, 0.0, 30.0),
    "tan_friction": Free(0.55, 0.1, 1.2),
    "shear_modulus_m": Free(0.01, 0.001, 0.06),
    "bulldozing": Free(5.0, 0.0, 40.0),
}
"""Fitted numbers; cohesion, k_c, rolling resistance and everything of mud are zero in dry sand."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted soil numbers.

    Attributes:
        values: (P,) in the order of `FREE`.
        sigma: (P,) standard errors, from the scatter of the residuals.
        correlation: (P, P).
        cost: sum of squared residuals, each in standard deviations of its output.
    """

    values: Array
    sigma: Array
    correlation: Array
    cost: float

    def named(self) -> dict[str, float]:
        """Values by name."""
        return dict(zip(FREE, self.values.tolist(), strict=True))


def conditions(trials: WheelTrials) -> NDArray[np.int64]:
    """Number (N,) of each trial's condition, the slip and side-slip asked for: repeats share it."""
    asked = np.stack([trials.commanded_rim_speed_mps, trials.commanded_side_slip_rad], axis=1)
    return np.unique(asked.round(6), axis=0, return_inverse=True)[1].reshape(-1)


def measured(trials: WheelTrials) -> Array:
    """The measured `OUTPUTS` (N, 3)."""
    return np.stack([getattr(trials, name) for name in OUTPUTS], axis=1)


def predict(values: Array, trials: WheelTrials, **fixed: float) -> Array:
    """The model's `OUTPUTS` (N, 3) with the soil numbers `values` (P,); `fixed` replaces others by name."""
    return np.asarray(_model(len(trials), tuple(fixed.items()))(values, _motion(trials))[0]).T


def fit(trials: WheelTrials, rows: NDArray[np.bool_]) -> Fit:
    """Least squares over the chosen trials (N,), the three outputs scaled by their spread there.

    Jacobians are the graph's own, bounds those of `FREE`.
    """
    from scipy.optimize import least_squares

    target = measured(trials)
    scale = target[rows].std(axis=0)
    model, motion = _model(len(trials), ()), _motion(trials)

    def residuals(values: Array) -> Array:
        return np.asarray((((np.asarray(model(values, motion)[0]).T - target) / scale)[rows]).ravel())

    def jacobian(values: Array) -> Array:
        wide = np.asarray(model(values, motion)[1]).reshape(len(OUTPUTS), len(trials), len(FREE), order="C")
        return np.asarray((wide.transpose(1, 0, 2) / scale[:, None])[rows].reshape(-1, len(FREE)))

    start = np.array([f.start for f in FREE.values()])
    bounds = [f.low for f in FREE.values()], [f.high for f in FREE.values()]
    found = least_squares(residuals, start, jac=jacobian, bounds=bounds, x_scale=start, xtol=1e-12)
    return _fit_of(found.x, np.asarray(found.jac), found.fun)


def _fit_of(values: Array, jacobian: Array, residual: Array) -> Fit:
    """Standard errors and correlations of the relative changes; a number at its bound counts as free."""
    variance = float(residual @ residual) / (len(residual) - len(values))
    scaled = jacobian * values
    covariance = np.linalg.pinv(scaled.T @ scaled) * variance
    relative = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(relative, relative)
    return Fit(values, relative * values, correlation, float(residual @ residual))


def _motion(trials: WheelTrials) -> Array:
    """Load, rim speed and hub velocity (4, N) for a travel of 1 m/s at the trial's slip and side-slip."""
    ratio = trials.rim_speed_mps / trials.travel_speed_mps
    side = trials.side_slip_rad
    return np.stack([trials.load_n, ratio, np.cos(side), np.sin(side)])


@functools.lru_cache(maxsize=8)
def _model(count: int, fixed: tuple[tuple[str, float], ...]) -> Any:
    """(values (P,), motion (4, N)) -> outputs (3, N) and derivatives (3, N P), trial by trial."""
    import casadi as ca

    from terrafusion.twin.physics.terramechanics import WheelShape
    from terrafusion.twin.physics.wheel import WheelSoil, steady_contact

    values, motion = ca.SX.sym("values", len(FREE)), ca.SX.sym("motion", 4)
    numbers: dict[str, Any] = dict.fromkeys(SOIL_PARAMETERS, 0.0)
    numbers |= {"exponent": EXPONENT, "unit_weight_n_per_m3": UNIT_WEIGHT_N_PER_M3, "friction_cap": 10.0}
    numbers |= {name: values[i] for i, name in enumerate(FREE)} | dict(fixed)
    ground = WheelSoil(*(numbers[name] for name in SOIL_PARAMETERS))
    shape = WheelShape(RADIUS_M, WIDTH_M)
    c = steady_contact(ground, motion[0], motion[1], (motion[2], motion[3]), shape)
    out = ca.vertcat(c.force_x_n, -c.force_y_n, c.sinkage_m)
    one = ca.Function("tf_wheel", [values, motion], [out, ca.jacobian(out, values)])
    # Soil numbers are the same for every trial: map would copy them.
    mapped = one.map("tf_wheel_all", "serial", count, [0], [])
    return lambda v, m: mapped(v, m)
