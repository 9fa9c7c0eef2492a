"""What links a keyframe to the one before it."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.streams import ImuSegment

Array = NDArray[np.float64]


def mean_rates(segments: list[ImuSegment]) -> tuple[Array, Array]:
    """Mean angular rate (3,) and specific force (3,) over the segments."""
    total = sum(s.dt_s for s in segments)
    gyro = sum((s.gyro_radps * s.dt_s for s in segments), np.zeros(3)) / total
    accel = sum((s.accel_mps2 * s.dt_s for s in segments), np.zeros(3)) / total
    return gyro, accel


def imu_factor(k: int, measured: gtsam.PreintegratedCombinedMeasurements) -> gtsam.CombinedImuFactor:
    """What the IMU tells between keyframes k - 1 and k."""
    return gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), measured)


def carried(before: KeyState, wheels: WheelIncrement | None, dt: float) -> KeyState:
    """The state carried over `dt` seconds by the wheels, or by its velocity where they are silent."""
    if wheels is None:
        step = gtsam.Pose3(gtsam.Rot3(), before.pose.rotation().matrix().T @ before.velocity * dt)
    else:
        turn = gtsam.Rot3.Rz(before.turning * wheels.turn_rad)
        step = gtsam.Pose3(turn, before.rolling * wheels.displacement_m)
    return KeyState(before.pose.compose(step), before.velocity, before.bias, before.linear)
