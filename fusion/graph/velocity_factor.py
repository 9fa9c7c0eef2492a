"""The GNSS velocity factor: a prior of the velocity or, in a calibration, with the lever arm as a state.

Residual (3,), world frame, m/s::

    r = v + R L (lever + antenna) - measured

`v` and R are those of the keyframe, L (`lever_arm_velocity`) gives the velocity of a point of the turning
body. Without a calibration the measured velocity is that of the body origin and L is missing: r = v -
measured. In a calibration such priors would hold the velocity to the lever arm assumed when they came.
"""

from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.key_state import (
    ANTENNA,
    MARKOV,
    NAV,
    POSE,
    VELOCITY,
    KeyState,
    among_linear,
    skew,
)

_AXES = np.arange(3)
_ANTENNA = among_linear(ANTENNA)


@dataclass(frozen=True, eq=False)
class GnssVelocity:
    """A receiver's velocity, propagated to a keyframe.

    Attributes:
        velocity_mps: (3,) of the antenna, or of the body origin, world.
        sigma_mps: 1 sigma (3,), white; large along an axis that is not measured.
        lever_m: (3,) the antenna's place in the vehicle file, body.
        velocity_by_lever: (3, 3), see `lever_arm_velocity`; zero where the velocity is the body origin's.
    """

    velocity_mps: Array
    sigma_mps: Array
    lever_m: Array = field(default_factory=lambda: np.zeros(3))
    velocity_by_lever: Array = field(default_factory=lambda: np.zeros((3, 3)))


def lever_arm_velocity(rate_radps: Array, offset_s: float) -> Array:
    """(3, 3) from a point of a body that turns with `rate_radps` (3,) to its velocity about the origin.

    Both in the axes of the body at the keyframe; the velocity is that `offset_s` later, to second order.
    """
    W = skew(rate_radps)
    return np.asarray(W + offset_s * W @ W)


def linearised(velocity: GnssVelocity, at: KeyState) -> tuple[Array, Array, Array]:
    """The residual of the module's docstring, unwhitened, and its derivatives by the pose (3, 6; GTSAM
    tangent) and by the linear states (3, 15); that by the velocity is one.
    """
    R, L = at.rotation, velocity.velocity_by_lever
    lever = velocity.lever_m + np.append(at.linear[_ANTENNA], 0.0)
    H_pose, H = np.zeros((3, 6)), np.zeros((3, MARKOV.stop - MARKOV.start))
    H_pose[:, :3] = -R @ skew(L @ lever)
    H[:, _ANTENNA] = (R @ L)[:, :2]
    return at.velocity + R @ L @ lever - velocity.velocity_mps, H_pose, H


def rows(velocity: GnssVelocity, point: KeyState, dim: int) -> Array:
    """Whitened rows (3, dim + 1) at a keyframe's state, the last column being the right-hand side."""
    out = np.zeros((3, dim + 1))
    if not velocity.velocity_by_lever.any():
        out[_AXES, VELOCITY.start + _AXES] = 1.0 / velocity.sigma_mps
        out[:, dim] = (velocity.velocity_mps - point.velocity) / velocity.sigma_mps
        return out
    left, H_pose, H_linear = linearised(velocity, point)
    out[:, POSE], out[:, VELOCITY], out[:, NAV.stop : dim] = H_pose, np.eye(3), H_linear[:, : dim - NAV.stop]
    out[:, dim] = -left
    return out / velocity.sigma_mps[:, None]
