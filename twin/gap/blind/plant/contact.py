"""Wheel on ground, in the plant's own laws. Arrays are (4, B): wheel by run; SI units."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PEAK_SHARE = 0.4
"""Where the pressure under a wheel is highest, over the entry angle (Wong and Reece 1967: c1 about 0.43)."""
RESIDUAL = 0.95  # shear stress far past the hump over that at the hump (assumed; Wong 2008 has 0.4 to 1)
HUMP = 1.0 / (1.0 - np.exp(-1.0)) - RESIDUAL
REST_MPS = 0.005
"""Slip counts against this speed where nothing moves: a parked robot creeps no faster than about 1e-5 m/s."""
RELAXATION_SHARE = 1.0 / 3.0
"""Relaxation length over contact length: mean delay of a row of bristles that enters unstressed."""


@functools.lru_cache(maxsize=256)
def stress_integrals(exponent: float) -> tuple[float, float]:
    """Vertical and horizontal integral (I, J) of the radial stress, per unit entry angle.

    Stress (cos t - cos t1)^n from entry t1 to the peak at c1 t1, mirrored onto the rear part from there to
    the bottom (Wong and Reece 1967), small angles: 1 - x^2 over the share x = t / t1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    front = 0.5 * (1.0 - PEAK_SHARE) * nodes + 0.5 * (1.0 + PEAK_SHARE)
    rear = 0.5 * PEAK_SHARE * (nodes + 1.0)
    mirrored = 1.0 - rear * (1.0 - PEAK_SHARE) / PEAK_SHARE
    w_front, w_rear = 0.5 * (1.0 - PEAK_SHARE) * weights, 0.5 * PEAK_SHARE * weights
    stress_front, stress_rear = (1.0 - front**2) ** exponent, (1.0 - mirrored**2) ** exponent
    vertical = w_front @ stress_front + w_rear @ stress_rear
    along = w_front @ (front * stress_front) + w_rear @ (rear * stress_rear)
    return float(vertical), float(along)


def static_sinkage(load: Array, n: dict[str, Any], radius: Array, stiffness: Array) -> Array:
    """Sinkage in balance with the load, m: W = b R k (R/2)^n I t1^(2n+1), z = R t1^2 / 2."""
    per_angle = n["width_m"] * radius * stiffness * (0.5 * radius) ** n["exponent"] * n["stress_vertical"]
    entry = (load / per_angle) ** (1.0 / (2.0 * n["exponent"] + 1.0))
    return np.asarray(0.5 * radius * entry * entry)


def lyasko(driven_slip: Array) -> Array:
    """Growth of the sinkage with driven slip: (1 + i) / (1 - i/2) (Lyasko 2010)."""
    return np.asarray((1.0 + driven_slip) / (1.0 - 0.5 * driven_slip))


def skidded(skid: Array, gain: Array) -> Array:
    """Growth of the sinkage of a wheel that skids by the share `skid` (own form)."""
    return np.asarray(1.0 + gain * skid * skid / (skid + 0.3))


def compaction_drag(load: Array, sinkage: Array, n: dict[str, Any], radius: Array) -> Array:
    """Horizontal part of the radial stress, N: W J / I t1, t1 = sqrt(2 z / R)."""
    entry = np.sqrt(2.0 * sinkage / radius)
    return np.asarray(load * n["stress_along"] / n["stress_vertical"] * entry)


def mean_shear_over_share(x: Array) -> Array:
    """Mean shear stress under the wheel over its peak, divided by x = j / K_w, j the shear at the rear end.

    Local law K_r (1 + (1 / (K_r (1 - 1/e)) - 1) e^(1 - x)) (1 - e^-x) (Wong and Preston-Thomas 1983),
    integrated over displacements that grow linearly from 0 to j.
    """
    x = np.maximum(x, 1e-3)
    fallen = np.exp(-x)
    rising = 1.0 - fallen
    return np.asarray((RESIDUAL * (x - rising) + 0.5 * np.e * HUMP * rising * rising) / (x * x))


INITIAL_SLOPE = RESIDUAL + np.e * HUMP  # twice the slope of the mean shear at x = 0


def hump_modulus(modulus: Array, strength: Array, mohr: Array) -> Array:
    """K_w for which the law starts as steeply as an exponential one of strength `mohr` and modulus K."""
    return np.asarray(modulus * INITIAL_SLOPE * strength / mohr)


def joined(mohr: Array, cap: Array) -> Array:
    """The lesser of Mohr-Coulomb strength and cap, rounded where they meet."""
    return np.asarray((mohr**-6.0 + cap**-6.0) ** (-1.0 / 6.0))


def passive_sides(n: dict[str, Any], sinkage: Array, chord: Array) -> tuple[Array, Array]:
    """Passive force on front and on one side of a sunken wheel, N (Rankine 1857, Bell 1915)."""
    root = n["tan_friction"] + np.sqrt(1.0 + n["tan_friction"] ** 2)
    constant, growing = 2.0 * n["cohesion_pa"] * root, n["unit_weight"] * root * root
    front = n["width_m"] * sinkage * (constant + 0.5 * growing * sinkage)
    side = sinkage * chord * (4.0 / 3.0 * constant + 8.0 / 15.0 * growing * sinkage)
    return n["bulldozing"] * front, n["bulldozing"] * side
