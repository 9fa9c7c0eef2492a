"""The GNSS velocity factor of a calibration: the antenna swings, and where it is is a state.

Residual (3,), world frame, m/s::

    r = v + R lever_arm_velocity (lever + antenna) - measured

`v` and R are those of the keyframe, `lever_arm_velocity` is what the turning body makes of a place on it. Without a
calibration the antenna is where the vehicle file says, and the velocity of the body origin is a prior
(`factors.gnss_velocity`). With one, such priors would hold the velocity to where the antenna was thought to
be when they came: hundreds would confirm one and the same error, and the antenna never reach its place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.graph.key_state import ANTENNA, MARKOV, NAV, POSE, VELOCITY, KeyState, skew

Array = NDArray[np.float64]

_ANTENNA = slice(ANTENNA.start - NAV.stop, ANTENNA.stop - NAV.stop)


@dataclass(frozen=True, eq=False)
class GnssVelocity:
    """A receiver's velocity, carried to a keyframe.

    Attributes:
        velocity_mps: (3,) of the antenna, world.
        sigma_mps: 1 sigma of each axis, white.
        lever_m: (3,) the antenna's place in the vehicle file, body.
        lever_rate_radps: (3, 3), see `lever_arm_velocity`.
    """

    velocity_mps: Array
    sigma_mps: float
    lever_m: Array
    lever_rate_radps: Array


def lever_arm_velocity(rate_radps: Array, offset_s: float) -> Array:
    """(3, 3) from a place on a body that turns with `rate_radps` (3,) to its velocity about the origin.

    Both in the axes that the body has at the keyframe; the velocity is that of `offset_s` later (to second
    order in the angle turned meanwhile).
    """
    W = skew(rate_radps)
    return np.asarray(W + offset_s * W @ W)


def residual(told: GnssVelocity, pose: Any, velocity_mps: Array, linear: Array) -> Array:
    """The residual of the module's docstring, unwhitened; `linear` (15,) of the keyframe."""
    lever = told.lever_m + np.append(linear[_ANTENNA], 0.0)
    lever_velocity = pose.rotation().matrix() @ told.lever_rate_radps @ lever
    return np.asarray(velocity_mps + lever_velocity - told.velocity_mps)


def jacobians(told: GnssVelocity, pose: Any, linear: Array) -> tuple[Array, Array, Array]:
    """Derivatives of `residual` by the pose (3, 6; GTSAM tangent), velocity (3, 3) and `linear` (3, 15)."""
    R = pose.rotation().matrix()
    lever = told.lever_m + np.append(linear[_ANTENNA], 0.0)
    H_pose, H = np.zeros((3, 6)), np.zeros((3, MARKOV.stop - MARKOV.start))
    H_pose[:, :3] = -R @ skew(told.lever_rate_radps @ lever)
    H[:, _ANTENNA] = (R @ told.lever_rate_radps)[:, :2]
    return H_pose, np.eye(3), H


def rows(told: GnssVelocity, point: KeyState, dim: int) -> Array:
    """Whitened rows (3, dim + 1) at a keyframe's state, the last column being the right-hand side."""
    out = np.zeros((3, dim + 1))
    H_pose, H_velocity, H_linear = jacobians(told, point.pose, point.linear)
    out[:, POSE], out[:, VELOCITY], out[:, NAV.stop : dim] = H_pose, H_velocity, H_linear[:, : dim - NAV.stop]
    out[:, dim] = -residual(told, point.pose, point.velocity, point.linear)
    return out / told.sigma_mps
