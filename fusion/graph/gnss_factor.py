"""The GNSS factor: antenna position with a lever arm and a slow drift of the receiver.

Residual (3,), world frame, metres::

    r = p + R lever + share (drift, 0) - fix

A receiver repeats its error for tens of seconds (atmosphere, multipath). Were
its fixes taken for independent, their average would turn the heading and the
gyro bias after it; as a Gauss-Markov state the drift takes the blame instead
(Schmidt-Kalman tradition; Groves 2013, Principles of GNSS, ch. 14.2.6). The drift is that of a fix of
the receiver's data sheet; one of a far better class has a small `share` of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GnssPosition:
    """A fix at a keyframe: antenna `enu_m`, `lever_m` in the body frame, white 1 `sigma_m`, each (3,).

    `weight` is what a robust loss leaves of its horizontal part; `sigma_m` holds it already.
    """

    enu_m: Array
    lever_m: Array
    sigma_m: Array
    drift_share: float = 1.0
    weight: float = 1.0


def residual(fix: GnssPosition, pose: Any, drift_m: Array) -> Array:
    """The residual of the module's docstring, unwhitened."""
    antenna = pose.translation() + pose.rotation().matrix() @ fix.lever_m
    return np.asarray(antenna + np.append(fix.drift_share * drift_m, 0.0) - fix.enu_m)


def jacobians(fix: GnssPosition, pose: Any) -> tuple[Array, Array]:
    """Derivatives of `residual` by the pose (3, 6; GTSAM tangent) and by the drift (3, 2)."""
    R = pose.rotation().matrix()
    return antenna_jacobian(R, fix.lever_m), fix.drift_share * np.eye(3)[:, :2]


def antenna_jacobian(R: Array, lever: Array) -> Array:
    """Derivative (3, 6) of the antenna position in the world by the pose (GTSAM tangent)."""
    x, y, z = lever
    return np.hstack([-R @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]), R])


def as_gtsam_factor(fix: GnssPosition, pose_key: int, markov_key: int) -> gtsam.CustomFactor:
    """The same factor for GTSAM's own optimisers; `markov_key` is the vector (slip, drift e, drift n)."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        pose = values.atPose3(pose_key)
        if H is not None:
            H[0], H_drift = jacobians(fix, pose)
            H[1] = np.hstack([np.zeros((3, 1)), H_drift])
        return residual(fix, pose, values.atVector(markov_key)[1:])

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(fix.sigma_m), [pose_key, markov_key], error)
