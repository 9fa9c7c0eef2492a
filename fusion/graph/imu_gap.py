"""Keyframes in a gap of the IMU: the wheels carry the robot on, as surely as they alone know its turn.

After a pause of all samples it is where it was, as uncertain as it may have driven.

The scale of their turn was learned beside the gyro. Its error, a share of the turn, lasts for a time T, like
white noise of sqrt(2 T) times its rate.
"""

import math

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.streams import ImuSegment

UNKNOWN_DENSITY_RADPS, STRAIGHT_DENSITY_RADPS = 0.3, 0.02
"""Yaw noise without wheels that tell a turn, and with them on a straight, rad/s/sqrt(Hz) (assumed)."""
PAUSE_MPS, PAUSE_YAW_RAD = 1.0, 1.0
"""Speed of a robot while no sample comes, at least, and how far it turns: 1 sigma each (assumed)."""
TURN_SHARE, TURN_TIME_S = 0.1, 10.0
"""1 sigma of the wheels' turn as a share, and the time for which it lasts (assumed: a long turn)."""

_isotropic = gtsam.noiseModel.Isotropic.Sigma


def readings_in_gap(before: KeyState, turn_rad: float, dt_s: float) -> ImuSegment:
    """What an IMU would read on a robot that turns by `turn_rad` at a steady speed."""
    rate = np.array([0.0, 0.0, turn_rad / dt_s])
    force = before.rotation.T @ np.array([0.0, 0.0, GRAVITY_MPS2])
    return ImuSegment(dt_s, before.bias.gyroscope() + rate, before.bias.accelerometer() + force)


def bridge(
    k: int, before: KeyState, wheels: WheelIncrement | None, turn_rad: float | None, dt_s: float
) -> tuple[KeyState, gtsam.NonlinearFactorGraph, WheelIncrement | None]:
    """The state after `dt_s` by the wheels, or by its velocity where they are silent; loose links to it; and
    what the wheels still say: their turn is in the links where they alone show it.
    """
    after = _carried(before, wheels, dt_s)
    sigmas = np.array([0.05, 0.05, 0.0, 0.3, 0.3, 0.1]) * math.sqrt(dt_s) + 1e-3
    sigmas[2] += _yaw_sigma(turn_rad, dt_s)
    step = before.pose.between(after.pose)
    link = _loose_link(k, step, sigmas, np.zeros(3), 2.0 * math.sqrt(dt_s))
    return after, link, wheels if wheels is None or turn_rad is None else wheels.without_turn()


def pause(k: int, before: KeyState, dt_s: float) -> tuple[KeyState, gtsam.NonlinearFactorGraph]:
    """State and link after a time without samples: the old place, uncertain by what it may have driven."""
    speed = max(float(np.linalg.norm(before.velocity)), PAUSE_MPS)
    sigmas = np.array([0.1, 0.1, PAUSE_YAW_RAD, *[speed * dt_s] * 2, 0.1 * speed * dt_s])
    link = _loose_link(k, gtsam.Pose3(), sigmas, -before.velocity, speed)
    return KeyState(before.pose, np.zeros(3), before.bias, before.linear), link


def _loose_link(
    k: int, step: gtsam.Pose3, sigmas: Array, speed_up_mps: Array, sigma_mps: float
) -> gtsam.NonlinearFactorGraph:
    """Keyframe k after k - 1 by a step with `sigmas` (6,) and a change of velocity; the biases stay."""
    link = gtsam.NonlinearFactorGraph()
    link.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), step, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    link.add(gtsam.BetweenFactorVector(V(k - 1), V(k), speed_up_mps, _isotropic(3, sigma_mps)))
    same = gtsam.imuBias.ConstantBias()
    link.add(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), same, _isotropic(6, 1e-3)))
    return link


def _yaw_sigma(turn_rad: float | None, dt_s: float) -> float:
    if turn_rad is None:
        return UNKNOWN_DENSITY_RADPS * math.sqrt(dt_s)
    lasting = TURN_SHARE * abs(turn_rad) * math.sqrt(2.0 * TURN_TIME_S / dt_s)
    return math.hypot(lasting, STRAIGHT_DENSITY_RADPS * math.sqrt(dt_s))


def _carried(before: KeyState, wheels: WheelIncrement | None, dt_s: float) -> KeyState:
    if wheels is None:
        step = gtsam.Pose3(gtsam.Rot3(), before.rotation.T @ before.velocity * dt_s)
    else:
        turn = gtsam.Rot3.Rz(before.turning * wheels.turn_rad)
        step = gtsam.Pose3(turn, before.rolling * wheels.displacement_m)
    return KeyState(before.pose.compose(step), before.velocity, before.bias, before.linear)
