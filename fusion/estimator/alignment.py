"""The start: attitude from gravity, or a given pose, and the first state of the graph with its prior."""

import dataclasses
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.graph import slow_states
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream, turned
from terrafusion.fusion.inputs.validation import MOST_AWAY_M, MOST_HEIGHT_M, as_number, as_numbers
from terrafusion.fusion.noise.policy import SensorNoise

STILL_MPS = 0.01
STILL_RADPS = 0.05
WINDOW_NS = 1_000_000_000
LEVEL_SIGMA_STILL_RAD, LEVEL_SIGMA_MOVING_RAD = 0.02, 0.05
UNSEEN_BIAS_SIGMA_RADPS = 0.004
"""Least prior of the gyro's bias where the robot did not stand at the start: data sheets and drivers promise
less than is found (0.0035 rad/s on a Husky whose driver removes it at rest)."""
LEAST_SIGMA, MOST_YAW_RAD = 1e-6, 2.0 * np.pi
"""Of a given start: sigma in m or rad, and a heading, which most degrees exceed."""


@dataclass(frozen=True, eq=False)
class Start:
    """The robot at `t_ns`: yaw with its 1 sigma, body origin (3,), roll and pitch, speed, gyro bias (3,)."""

    t_ns: int
    position_m: Array
    position_sigma_m: float
    yaw_rad: float
    yaw_sigma_rad: float
    roll_rad: float
    pitch_rad: float
    level_sigma_rad: float
    speed_mps: float
    gyro_bias_radps: Array | None


def level_start(imu: ImuStream, wheels: WheelStream, t_ns: int) -> Start:
    """Attitude and gyro bias at the start; position zero and yaw zero (a local frame).

    Over the first second at rest the mean specific force is gravity and the mean rate is bias. For a
    moving robot the bias is unknown, and the acceleration by its wheels and its turn, dv/dt forward and v
    r to the left, is subtracted from the mean force.
    """
    gyro, accel = imu.levelled(t_ns, t_ns + WINDOW_NS)
    rolled = wheels.travelled(t_ns, t_ns + WINDOW_NS)
    still = (
        rolled is not None
        and max(abs(rolled[0]), abs(rolled[1])) < STILL_MPS
        and len(gyro) > 3
        and float(np.abs(gyro.mean(axis=0)).max()) < STILL_RADPS
    )
    force = accel.mean(axis=0) if len(accel) else np.array([0.0, 0.0, 9.8])
    speed = 0.0
    if not still:
        fifth = WINDOW_NS // 5
        speed = _mean_speed_mps(wheels, t_ns, t_ns + fifth)
        gained = _mean_speed_mps(wheels, t_ns + 4 * fifth, t_ns + 5 * fifth) - speed
        yaw_rate = float(gyro[:, 2].mean()) if len(gyro) else 0.0
        mean_speed = 0.5 * sum(rolled or (0.0, 0.0)) / (WINDOW_NS * 1e-9)
        if imu.six_axis:  # without an accelerometer the force is that of a level robot
            force = force - np.array([gained / 0.8, mean_speed * yaw_rate, 0.0])
            # The mean was felt half a second later, by a robot that had turned on.
            force = turned(force, 0.5e-9 * WINDOW_NS * yaw_rate)
    x, y, z = force
    return Start(
        t_ns=t_ns,
        position_m=np.zeros(3),
        position_sigma_m=1e-3,
        yaw_rad=0.0,
        yaw_sigma_rad=1e-3,
        roll_rad=float(np.arctan2(y, z)),
        pitch_rad=float(np.arctan2(-x, np.hypot(y, z))),
        level_sigma_rad=LEVEL_SIGMA_STILL_RAD if still else LEVEL_SIGMA_MOVING_RAD,
        speed_mps=speed,
        gyro_bias_radps=gyro.mean(axis=0) if still else None,
    )


def _mean_speed_mps(wheels: WheelStream, start_ns: int, end_ns: int) -> float:
    rolled = wheels.travelled(start_ns, end_ns)
    return 0.0 if rolled is None else 0.5 * sum(rolled) / ((end_ns - start_ns) * 1e-9)


def initial_state(
    start: Start, noise: SensorNoise, imu: ImuSpec, drift_sigma_m: float, from_fixes: bool
) -> tuple[KeyState, Array]:
    """State of the first keyframe and its prior 1 sigmas (DIM,).

    `from_fixes`: the heading came from fixes that enter the graph, too, and is given a wider prior.
    """
    rotation = gtsam.Rot3.RzRyRx(start.roll_rad, start.pitch_rad, start.yaw_rad)
    gyro_bias = start.gyro_bias_radps if start.gyro_bias_radps is not None else np.zeros(3)
    linear, linear_sigma = slow_states.prior(noise, float(rotation.matrix()[2, 0]), drift_sigma_m)
    state = KeyState(
        gtsam.Pose3(rotation, start.position_m),
        rotation.matrix() @ np.array([start.speed_mps, 0.0, 0.0]),
        gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias),
        linear,
    )
    level = float(np.hypot(start.level_sigma_rad, imu.accel_bias_sigma_mps2 / GRAVITY_MPS2))
    yaw = max(0.3, 2.0 * start.yaw_sigma_rad) if from_fixes else start.yaw_sigma_rad
    # A velocity along an unknown heading has an unknown direction, too: this prior must not tell it.
    speed = float(np.hypot(0.1 + 0.3 * abs(start.speed_mps), 3.0 * yaw * start.speed_mps))
    sigmas = [level, level, yaw, *[start.position_sigma_m] * 3, *[speed] * 3]
    seen = start.gyro_bias_radps is not None or imu.gyro_bias_sigma_radps == 0.0
    least_bias = 0.0 if seen else UNSEEN_BIAS_SIGMA_RADPS
    gyro_bias_sigma = max(imu.gyro_bias_sigma_radps, least_bias)
    sigmas += [imu.accel_bias_sigma_mps2 + 1e-6] * 3 + [gyro_bias_sigma + 1e-6] * 3
    return state, np.array([*sigmas, *linear_sigma.tolist()])


@dataclass(frozen=True, eq=False)
class KnownStart:
    """A known position (3,) and heading, ENU, with 1 sigmas."""

    position_m: Array
    yaw_rad: float
    position_sigma_m: float
    yaw_sigma_rad: float

    def at(self, level: Start) -> Start:
        """The start there, with attitude, speed and bias of `level`."""
        return dataclasses.replace(level, **vars(self))


def checked_start(
    position_m: ArrayLike, yaw_rad: float, position_sigma_m: float, yaw_sigma_rad: float
) -> KnownStart:
    """A given start.

    Raises:
        DataError: not three finite coordinates and a heading within a turn, with positive sigmas.
    """
    position = as_numbers(position_m, "start", "start")
    yaw_rad, position_sigma_m, yaw_sigma_rad = (
        as_number(value, "yaw or sigma of the start", "start")
        for value in (yaw_rad, position_sigma_m, yaw_sigma_rad)
    )
    if position.shape != (3,) or not np.isfinite(position.sum() + yaw_rad):
        raise DataError(
            f"start at {position.tolist()} with yaw {yaw_rad} is no pose", remedy="give x, y, z and yaw"
        )
    if not (0.0 < position_sigma_m < np.inf and 0.0 < yaw_sigma_rad < np.inf):
        raise DataError(
            f"sigmas {position_sigma_m} m, {yaw_sigma_rad} rad of the start are not positive",
            remedy="give 1 sigma",
        )
    if abs(yaw_rad) > MOST_YAW_RAD:
        raise DataError(
            f"yaw {yaw_rad:g} rad of the start is more than a turn", remedy="give radians, 0 to the east"
        )
    far_m = max(*np.abs(position[:2]).tolist(), position_sigma_m)
    if far_m > MOST_AWAY_M or abs(position[2]) > MOST_HEIGHT_M:
        raise DataError(
            f"start at {position.tolist()} m lies beyond the earth", remedy="give metres east and north"
        )
    sigma_m, sigma_rad = max(position_sigma_m, LEAST_SIGMA), max(min(yaw_sigma_rad, np.pi), LEAST_SIGMA)
    return KnownStart(position, yaw_rad, sigma_m, sigma_rad)
