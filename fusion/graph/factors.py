"""Factors of the localisation graph, each made from one measurement."""

import math

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.noise.policy import SensorNoise

NO_MOTION_SIGMAS = np.array([2e-4, 2e-4, 2e-4, 1e-3, 1e-3, 1e-3])
"""Motion of a robot at rest between two keyframes: rotation (rad), then translation (m)."""
UP_SIDE_RATIO = 0.05
"""Vertical over forward displacement in the body frame (1 sigma): wheels follow the ground."""
YAW_SIGMA_RADPS, YAW_SIGMA_SHARE = 1.0, 0.3
"""Yaw rate of skid-steered wheels: 1 sigma per keyframe of 0.1 s, and share of the rate. Unequal wheels turn
a robot by 0.03 rad/s for a minute (assumed), like white noise of 0.03 sqrt(2 60 / 0.1)."""
FLOOR_M = 2e-3
"""Least sigma of a wheel displacement across the rolling direction, m per keyframe."""
SURGE_SPEED_MPS = 0.3
"""Wheels that accelerate slip as if they were so much faster (assumed; in the twin straight on 0.07 m/s on
asphalt, 0.44 on loose sand)."""


def wheel_increment(
    travelled_m: tuple[float, float],
    segments: list[ImuSegment],
    gyro_bias_z: float,
    track_m: float,
    quantum_m: float,
    noise: SensorNoise,
    speed_change_mps: float = 0.0,
    surging: bool = False,
    course_lag_s: tuple[float, float] = (0.0, 0.0),
) -> WheelIncrement:
    """Displacement of the body origin and turn by wheels and gyro.

    The travelled distance is spread evenly over the interval and turned by the yaw integrated from the
    gyro (bias removed), exactly for constant rates. `surging`: with the part that the acceleration asks
    for. `course_lag_s`: in a turn at rate w the body drifts outwards by the angle `course_lag_s` w;
    mean, and 1 sigma between grounds.
    """
    left, right = travelled_m
    distance = 0.5 * (left + right)
    total = sum(segment.dt_s for segment in segments)
    x = y = yaw = 0.0
    for segment in segments:
        turn = (float(segment.gyro_radps[2]) - gyro_bias_z) * segment.dt_s
        step = distance * segment.dt_s / total
        chord = step * (1.0 - turn * turn / 24.0)
        x += chord * math.cos(yaw + 0.5 * turn)
        y += chord * math.sin(yaw + 0.5 * turn)
        yaw += turn
    lag_s, lag_sigma_s = course_lag_s
    y -= lag_s * yaw / total * distance
    forward = math.hypot(noise.wheel_sigma_mps * total, quantum_m)
    across = noise.side_slip_sigma * abs(distance) + FLOOR_M
    up = UP_SIDE_RATIO * abs(distance) + FLOOR_M
    turn = (right - left) / track_m
    turn_sigma = YAW_SIGMA_RADPS * total + YAW_SIGMA_SHARE * abs(turn) + quantum_m / track_m
    sigma = np.array([forward, across, up, turn_sigma])
    asking_m = abs(distance) + SURGE_SPEED_MPS * total if surging else 0.0
    surge_m = asking_m * speed_change_mps / (GRAVITY_MPS2 * total)
    return WheelIncrement(
        np.array([x, y, 0.0]), sigma, distance, turn, yaw, speed_change_mps, surge_m,
        course_lag_sigma_s=lag_sigma_s,
    )  # fmt: skip


def no_motion_factor(k: int) -> gtsam.NonlinearFactor:
    """Zero translation and rotation between two keyframes."""
    return gtsam.BetweenFactorPose3(
        X(k - 1), X(k), gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(NO_MOTION_SIGMAS)
    )


def antenna_lever(
    state: KeyState, dt_s: float, gyro_radps: Array, accel_world_mps2: Array, antenna_m: Array
) -> Array:
    """Antenna position (3,) at `dt_s` from the keyframe, in the body frame of the keyframe, m.

    Within half a keyframe the body is propagated by its velocity, acceleration and rate, so that the fix
    keeps its own time.
    """
    R_body_world = state.rotation.T
    moved = R_body_world @ (state.velocity * dt_s + 0.5 * accel_world_mps2 * dt_s**2)
    turned = gtsam.Rot3.Expmap(gyro_radps * dt_s).matrix() @ antenna_m
    return np.asarray(moved + turned)


def mean_rates(segments: list[ImuSegment]) -> tuple[Array, Array]:
    """Mean angular rate (3,) and specific force (3,) over the segments."""
    dt_s = np.array([s.dt_s for s in segments])[:, None]
    readings = np.concatenate([a for s in segments for a in (s.gyro_radps, s.accel_mps2)]).reshape(-1, 6)
    mean = (readings * dt_s).sum(axis=0) / sum(s.dt_s for s in segments)
    return mean[:3], mean[3:]


def imu_factor(k: int, measured: gtsam.PreintegratedCombinedMeasurements) -> gtsam.CombinedImuFactor:
    """The preintegrated IMU between keyframes k - 1 and k."""
    return gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), measured)
