"""The start: attitude from gravity, heading and position from GNSS against dead reckoning."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.planar_alignment import planar_rotation
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.graph import slow_states
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream, turned
from terrafusion.fusion.inputs.validation import MOST_AWAY_M, MOST_HEIGHT_M, GnssFix, as_number, as_numbers
from terrafusion.fusion.noise.policy import SensorNoise

STILL_MPS = 0.01
STILL_RADPS = 0.05
WINDOW_NS = 1_000_000_000
LEVEL_SIGMA_STILL_RAD, LEVEL_SIGMA_MOVING_RAD = 0.02, 0.05
LEAST_RATIO = 0.3
"""Driven over dead-reckoned distance below which the robot is stuck and shows no heading."""
UNSEEN_BIAS_SIGMA_RADPS = 0.004
"""Least prior of the gyro's bias where the robot did not stand at the start: data sheets and drivers promise
less than is found (0.0035 rad/s on a Husky whose driver removes it at rest)."""
LEAST_SIGMA, MOST_YAW_RAD = 1e-6, 100.0
"""Of a given start: sigma in m or rad, and a heading, which more than degrees exceed."""
SLIP_SIGMA = 0.05
"""Relative error of wheel speed against GNSS velocity (assumed)."""


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
    sigmas = [level, level, yaw, *[start.position_sigma_m] * 3, *[0.1 + 0.3 * abs(start.speed_mps)] * 3]
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
        DataError: not three finite coordinates and a finite heading with positive sigmas.
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
    far_m = max(*np.abs(position[:2]).tolist(), position_sigma_m)
    if far_m > MOST_AWAY_M or abs(position[2]) > MOST_HEIGHT_M or abs(yaw_rad) > MOST_YAW_RAD:
        raise DataError(
            f"start at {position.tolist()} m with yaw {yaw_rad:g} lies beyond the earth",
            remedy="give metres east and north, and radians",
        )
    sigma_m, sigma_rad = max(position_sigma_m, LEAST_SIGMA), max(min(yaw_sigma_rad, np.pi), LEAST_SIGMA)
    return KnownStart(position, yaw_rad, sigma_m, sigma_rad)


def heading_from_motion(
    imu: ImuStream,
    wheels: WheelStream,
    fixes: list[GnssFix],
    level: Start,
    antenna_m: Array,
    ahead_m: float = 0.0,
) -> Start | None:
    """Turn and shift dead reckoning onto the fixes, and its speed onto their velocities, by least squares.

    Positions and velocities show the same turn, so their sums add up (see `planar_rotation`). None with
    fewer than three fixes, or while the fixes hardly move though the wheels do. `ahead_m`: of the `Rig`.
    """
    times = np.array([t for t in wheels.t_ns if t >= level.t_ns], dtype=np.int64)
    inside = [f for f in fixes if len(times) and level.t_ns <= f.t_ns <= min(times[-1], imu.t_ns[-1])]
    if len(inside) < 3 or len(times) < 3:
        return None
    yaw_at, path_at = _dead_reckon(imu, wheels, level)
    t_fix = np.array([f.t_ns - level.t_ns for f in inside], dtype=float) * 1e-9
    heading = np.exp(1j * yaw_at(t_fix))
    lever = complex(ahead_m + antenna_m[0], antenna_m[1])
    z = path_at(t_fix) + lever * heading
    g = np.array([f.enu_m[0] + 1j * f.enu_m[1] for f in inside])
    weight = np.array([1.0 / (f.sigma_m[0] * f.sigma_m[1]) for f in inside])
    turn, information = planar_rotation(z, g, weight)
    half = 0.1
    z_dot = (path_at(t_fix + half) - path_at(t_fix - half)) / (2.0 * half)
    z_dot = z_dot + lever * (np.exp(1j * yaw_at(t_fix + half)) - np.exp(1j * yaw_at(t_fix - half))) / 0.2
    for fix, v in zip(inside, z_dot.tolist(), strict=True):
        if fix.velocity_mps is not None and np.isfinite(fix.velocity_mps[:2].sum() + fix.sigma_v_mps):
            w = 1.0 / (max(fix.sigma_v_mps, 1e-3) ** 2 + (SLIP_SIGMA * abs(v)) ** 2)
            turn += w * np.conj(v) * complex(fix.velocity_mps[0], fix.velocity_mps[1])
            information += w * abs(v) ** 2
    if information <= 0.0 or abs(turn) < LEAST_RATIO * information:
        return None
    yaw = float(np.angle(turn))
    origin = np.average(g, weights=weight) - np.exp(1j * yaw) * np.average(z, weights=weight)
    off = _excess(g - origin - np.exp(1j * yaw) * z, z, weight)
    body = origin + ahead_m * np.exp(1j * yaw)
    heights = np.array([f.enu_m[2] for f in inside])
    height = float(np.nanmean(heights)) - antenna_m[2] if np.isfinite(heights).any() else 0.0
    return dataclasses.replace(
        level,
        position_m=np.array([body.real, body.imag, height]),
        position_sigma_m=float(5.0 * off / np.sqrt(weight.max())) + 0.05,
        yaw_rad=yaw,
        yaw_sigma_rad=off * information**0.5 / abs(turn),
    )


def _excess(left_m: NDArray[np.complex128], z: NDArray[np.complex128], weight: Array) -> float:
    """Root mean square of what the fixes leave over their sigma and slip, at least 1.

    Sigmas are scaled by it where fixes disagree (Birge ratio; Birge 1932, Phys. Rev. 40, 207).
    """
    slip_m = SLIP_SIGMA * np.abs(z - np.average(z, weights=weight))
    squares = np.abs(left_m) ** 2 / (2.0 * (1.0 / weight + slip_m**2))
    return max(1.0, float(np.sqrt(squares.sum() / (len(z) - 2))))


def _dead_reckon(imu: ImuStream, wheels: WheelStream, level: Start):  # type: ignore[no-untyped-def]
    """Yaw (rad) and complex horizontal position (m) over seconds from the start, as functions.

    The ground is taken for a plane: the path in it is projected by the attitude of the start.
    """
    t, gyro, _ = imu.window(level.t_ns, imu.t_ns[-1] + 1)
    bias = level.gyro_bias_radps[2] if level.gyro_bias_radps is not None else 0.0
    yaw = np.concatenate([[0.0], np.cumsum((gyro[1:, 2] - bias) * np.diff(t))])
    index = [i for i, x in enumerate(wheels.t_ns) if x >= level.t_ns]
    t_wheel = np.array([wheels.t_ns[i] - level.t_ns for i in index], dtype=float) * 1e-9
    distance = np.array([0.5 * (wheels.left_m[i] + wheels.right_m[i]) for i in index])
    middle = np.interp(0.5 * (t_wheel[1:] + t_wheel[:-1]), t, yaw)
    steps = np.diff(distance)
    in_plane = np.stack([steps * np.cos(middle), steps * np.sin(middle)])
    level_x, level_y = _flattened(level) @ in_plane
    path = np.concatenate([[0.0 + 0.0j], np.cumsum(level_x + 1j * level_y)])

    def yaw_at(s: Array) -> Array:
        return np.interp(s, t, yaw)

    def path_at(s: Array) -> NDArray[np.complex128]:
        return np.interp(s, t_wheel, path.real) + 1j * np.interp(s, t_wheel, path.imag)

    return yaw_at, path_at


def _flattened(level: Start) -> Array:
    """Horizontal part (2, 2) of motion in the plane the robot stands on, axes as at the start."""
    roll, pitch = level.roll_rad, level.pitch_rad
    return np.array([[np.cos(pitch), np.sin(pitch) * np.sin(roll)], [0.0, np.cos(roll)]])
