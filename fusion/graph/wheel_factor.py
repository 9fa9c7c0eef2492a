"""The wheel factor: displacement between two keyframes with a slip scale.

Residual (3,), in the body frame of keyframe i, metres::

    r = R_i' (p_j - p_i) - (1 - slip_j) d

`d` is what the wheels say: their travelled distance turned by the gyro while
it was travelled. Its first row is odometry with slip, its second and third
are the non-holonomic constraint with a sigma for side-slip (Dissanayake et
al. 2001, IEEE T-RA 17(5), for the constraint; the slip scale follows the
usual definition v = (1 - slip) omega R, Wong 2008, Theory of Ground Vehicles).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WheelIncrement:
    """What the wheels measured between two keyframes.

    Attributes:
        displacement_m: (3,) in the body frame of the first keyframe, slip not removed.
        sigma_m: (3,) 1 sigma along body x, y, z.
        distance_m: mean travelled wheel distance, signed.
        turn_rad: right minus left distance over the track, signed.
    """

    displacement_m: Array
    sigma_m: Array
    distance_m: float
    turn_rad: float


def residual(pose_i: Any, pose_j: Any, slip: float, displacement_m: Array) -> Array:
    """The residual (3,) of the module's docstring, unwhitened."""
    moved = pose_i.rotation().matrix().T @ (pose_j.translation() - pose_i.translation())
    return np.asarray(moved - (1.0 - slip) * displacement_m)


def jacobians(pose_i: Any, pose_j: Any, displacement_m: Array) -> tuple[Array, Array, Array]:
    """Derivatives of `residual` by pose i (3, 6), pose j (3, 6) and slip (3, 1).

    Pose tangents are GTSAM's: rotation first, both parts in the body frame.
    """
    R_body_world = pose_i.rotation().matrix().T
    x, y, z = R_body_world @ (pose_j.translation() - pose_i.translation())
    H_i = np.zeros((3, 6))
    H_i[0, 1], H_i[0, 2] = -z, y
    H_i[1, 0], H_i[1, 2] = z, -x
    H_i[2, 0], H_i[2, 1] = -y, x
    H_i[0, 3] = H_i[1, 4] = H_i[2, 5] = -1.0
    H_j = np.zeros((3, 6))
    H_j[:, 3:] = R_body_world @ pose_j.rotation().matrix()
    return H_i, H_j, displacement_m.reshape(3, 1)


def as_gtsam_factor(increment: WheelIncrement, pose_i: int, pose_j: int, markov_j: int) -> gtsam.CustomFactor:
    """The same factor for GTSAM's own optimisers; `markov_j` is the vector (slip, drift e, drift n)."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        a, b = values.atPose3(pose_i), values.atPose3(pose_j)
        if H is not None:
            H[0], H[1], H_slip = jacobians(a, b, increment.displacement_m)
            H[2] = np.hstack([H_slip, np.zeros((3, 2))])
        return residual(a, b, float(values.atVector(markov_j)[0]), increment.displacement_m)

    noise = gtsam.noiseModel.Diagonal.Sigmas(increment.sigma_m)
    return gtsam.CustomFactor(noise, [pose_i, pose_j, markov_j], error)
