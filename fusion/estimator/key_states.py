"""From the state of a keyframe in the graph to the reported `State`, and back."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import gtsam_to_ros_covariance
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.graph.body_twist import bias_sigma, twist_covariance
from terrafusion.fusion.graph.key_state import POSE, SLIP, VELOCITY, KeyState, linear_sigma, quaternion_of


def key_state_of(state: State) -> KeyState:
    """The keyframe's state in the graph behind a reported one."""
    x, y, z, w = state.quaternion
    pose = gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), state.position_m)
    bias = gtsam.imuBias.ConstantBias(state.accel_bias_mps2, state.gyro_bias_radps)
    return KeyState(pose, state.velocity_mps, bias, state.linear)


def covariance_fields(P: Array, R: Array, velocity_mps: Array, gyro_sigma_radps: Array) -> dict[str, Any]:
    """Fields of a `State`, or of several, that follow from the covariance P (..., dim, dim) of its tangent.

    Args:
        R: (..., 3, 3) body to world.
        velocity_mps: (..., 3) world.
        gyro_sigma_radps: (..., 3) white noise of the rates.
    """
    return {
        "covariance": gtsam_to_ros_covariance(P[..., POSE, POSE], R),
        "velocity_covariance": P[..., VELOCITY, VELOCITY].copy(),
        "twist_covariance": twist_covariance(P, R, velocity_mps, gyro_sigma_radps),
        "bias_sigma": bias_sigma(P),
    }


def key_fields(key: KeyState, gyro_radps: Array) -> dict[str, Any]:
    """Fields of a `State` that follow from a keyframe and the gyro's reading (3,)."""
    return {
        "position_m": np.asarray(key.pose.translation()),
        "quaternion": quaternion_of(key.pose),
        "velocity_mps": key.velocity.copy(),
        "angular_velocity_radps": key.rate(gyro_radps),
        "gyro_bias_radps": np.asarray(key.bias.gyroscope()),
        "accel_bias_mps2": np.asarray(key.bias.accelerometer()),
        "linear": key.linear.copy(),
    }


def state_fields(key: KeyState, P: Array, gyro_radps: Array, gyro_sigma_radps: Array) -> dict[str, Any]:
    """Fields of a `State` that follow from a keyframe, its covariance P and the gyro's reading (3,)."""
    return {
        **key_fields(key, gyro_radps),
        "linear_sigma": linear_sigma(P),
        "slip_sigma": float(np.sqrt(P[SLIP, SLIP])),
        **covariance_fields(P, key.rotation, key.velocity, gyro_sigma_radps),
    }


def smoothed(
    live: Sequence[State], was: Sequence[KeyState], keys: Sequence[KeyState], P: Array, sigma_radps: Array
) -> list[State]:
    """The live states of n keyframes (`was` in the graph), by the batch solution `keys` and their covariances
    P (n, dim, dim); white noise of the rates (n, 3).
    """
    R, velocity = np.array([key.rotation for key in keys]), np.array([key.velocity for key in keys])
    several = covariance_fields(P, R, velocity, sigma_radps)
    several |= {"linear_sigma": linear_sigma(P), "slip_sigma": np.sqrt(P[:, SLIP, SLIP]).tolist()}
    own = [dict(zip(several, values, strict=True)) for values in zip(*several.values(), strict=True)]
    return [
        dataclasses.replace(
            state,
            slip=key.slip + (state.slip - float(state.linear[0])),
            **key_fields(key, before.reading(state.angular_velocity_radps)),
            **fields,
        )
        for state, before, key, fields in zip(live, was, keys, own, strict=True)
    ]
