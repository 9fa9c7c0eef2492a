"""The factors of the chain as GTSAM's own, for comparisons with its optimisers."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.graph import gnss_factor, velocity_factor, wheel_factor
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.velocity_factor import GnssVelocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement

Array = NDArray[np.float64]


def _state(
    values: gtsam.Values, pose_key: int, linear_key: int, velocity_mps: Array | None = None
) -> KeyState:
    velocity = np.zeros(3) if velocity_mps is None else velocity_mps
    bias = gtsam.imuBias.ConstantBias()
    return KeyState(values.atPose3(pose_key), velocity, bias, values.atVector(linear_key))


def markov_factor(step: MarkovStep, key_i: int, key_j: int) -> gtsam.CustomFactor:
    """The same step between two vector variables, for GTSAM's own optimisers."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        if H is not None:
            H[0], H[1] = -np.diag(step.decay), np.eye(len(step.decay))
        return step.residual(values.atVector(key_i), values.atVector(key_j))

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(step.sigma), [key_i, key_j], error)


def gnss_position_factor(fix: GnssPosition, pose_key: int, linear_key: int) -> gtsam.CustomFactor:
    """The same factor for GTSAM's own optimisers; `linear_key` is the vector of the linear states."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        left, *jacobians = gnss_factor.linearised(fix, _state(values, pose_key, linear_key))
        if H is not None:
            H[0], H[1] = jacobians
        return left

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(fix.sigma_m), [pose_key, linear_key], error)


def gnss_velocity_factor(
    velocity: GnssVelocity, pose_key: int, velocity_key: int, linear_key: int
) -> gtsam.CustomFactor:
    """The same factor for GTSAM's own optimisers; `linear_key` is the vector of the linear states."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        at = _state(values, pose_key, linear_key, values.atVector(velocity_key))
        left, *jacobians = velocity_factor.linearised(velocity, at)
        if H is not None:
            H[0], H[1], H[2] = jacobians[0], np.eye(3), jacobians[1]
        return left

    noise = gtsam.noiseModel.Diagonal.Sigmas(velocity.sigma_mps)
    return gtsam.CustomFactor(noise, [pose_key, velocity_key, linear_key], error)


def wheel_factor_of(wheels: WheelIncrement, pose_i: int, pose_j: int, linear_j: int) -> gtsam.CustomFactor:
    """The same factor for GTSAM's own optimisers; `linear_j` is the vector of the linear states."""

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        before, now = (_state(values, pose, linear_j) for pose in (pose_i, pose_j))
        left, *jacobians = wheel_factor.linearised(before, now, wheels)
        if H is not None:
            H[0], H[1], H[2] = jacobians
        return left

    noise = gtsam.noiseModel.Diagonal.Sigmas(wheels.sigma)
    return gtsam.CustomFactor(noise, [pose_i, pose_j, linear_j], error)
