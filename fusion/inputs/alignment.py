"""The start: attitude from gravity, heading and position from GNSS against dead reckoning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.inputs.streams import GnssFix, ImuStream, WheelStream

Array = NDArray[np.float64]

STILL_MPS = 0.01
STILL_RADPS = 0.05


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

    Over the first second at rest the mean specific force is gravity and the
    mean rate is bias. A robot already moving gives its attitude less surely
    and no bias.
    """
    _, gyro, accel = imu.window(t_ns, t_ns + 1_000_000_000)
    rolled = wheels.travelled(t_ns, t_ns + 1_000_000_000)
    still = (
        rolled is not None
        and max(abs(rolled[0]), abs(rolled[1])) < STILL_MPS
        and len(gyro) > 3
        and float(np.abs(gyro.mean(axis=0)).max()) < STILL_RADPS
    )
    x, y, z = accel.mean(axis=0) if len(accel) else (0.0, 0.0, 9.8)
    speed = 0.0 if still else 0.5 * sum(wheels.travelled(t_ns, t_ns + 200_000_000) or (0.0, 0.0)) / 0.2
    return Start(
        t_ns=t_ns,
        position_m=np.zeros(3),
        position_sigma_m=1e-3,
        yaw_rad=0.0,
        yaw_sigma_rad=1e-3,
        roll_rad=float(np.arctan2(y, z)),
        pitch_rad=float(np.arctan2(-x, np.hypot(y, z))),
        level_sigma_rad=0.02 if still else 0.1,
        speed_mps=speed,
        gyro_bias_radps=gyro.mean(axis=0) if still else None,
    )


def heading_from_motion(
    imu: ImuStream, wheels: WheelStream, fixes: list[GnssFix], level: Start, antenna_m: Array
) -> Start | None:
    """Turn and shift dead reckoning onto the fixes by weighted least squares.

    In the plane, with dead-reckoned antenna points z_i and fixes g_i as complex
    numbers, the best turn is the argument of sum w_i conj(z_i - z) (g_i - g)
    (the planar case of Horn 1987, JOSA A 4(4)); its variance is
    1 / sum w_i |z_i - z|^2. None while fewer than three fixes are inside.
    """
    times = np.array([t for t in wheels.t_ns if t >= level.t_ns], dtype=np.int64)
    inside = [f for f in fixes if len(times) and level.t_ns <= f.t_ns <= min(times[-1], imu.t_ns[-1])]
    if len(inside) < 3 or len(times) < 3:
        return None
    yaw_at, path_at = _dead_reckon(imu, wheels, level)
    t_fix = np.array([f.t_ns - level.t_ns for f in inside], dtype=float) * 1e-9
    lever = (antenna_m[0] + 1j * antenna_m[1]) * np.exp(1j * yaw_at(t_fix))
    z = path_at(t_fix) + lever
    g = np.array([f.enu_m[0] + 1j * f.enu_m[1] for f in inside])
    weight = np.array([1.0 / (f.sigma_m[0] * f.sigma_m[1]) for f in inside])
    z_mean, g_mean = np.average(z, weights=weight), np.average(g, weights=weight)
    information = float(np.sum(weight * np.abs(z - z_mean) ** 2))
    if information <= 0.0:
        return None
    turn = np.sum(weight * np.conj(z - z_mean) * (g - g_mean))
    yaw = float(np.angle(turn))
    origin = g_mean - np.exp(1j * yaw) * z_mean
    heights = np.array([f.enu_m[2] for f in inside])
    height = float(np.nanmean(heights)) - antenna_m[2] if np.isfinite(heights).any() else 0.0
    return Start(
        t_ns=level.t_ns,
        position_m=np.array([origin.real, origin.imag, height]),
        position_sigma_m=float(5.0 / np.sqrt(weight.max())) + 0.05,
        yaw_rad=yaw,
        yaw_sigma_rad=information**-0.5,
        roll_rad=level.roll_rad,
        pitch_rad=level.pitch_rad,
        level_sigma_rad=level.level_sigma_rad,
        speed_mps=level.speed_mps,
        gyro_bias_radps=level.gyro_bias_radps,
    )


def _dead_reckon(imu: ImuStream, wheels: WheelStream, level: Start):  # type: ignore[no-untyped-def]
    """Yaw (rad) and complex position (m) over seconds from the start, as functions."""
    t, gyro, _ = imu.window(level.t_ns, imu.t_ns[-1] + 1)
    bias = level.gyro_bias_radps[2] if level.gyro_bias_radps is not None else 0.0
    yaw = np.concatenate([[0.0], np.cumsum((gyro[1:, 2] - bias) * np.diff(t))])
    index = [i for i, x in enumerate(wheels.t_ns) if x >= level.t_ns]
    t_wheel = np.array([wheels.t_ns[i] - level.t_ns for i in index], dtype=float) * 1e-9
    distance = np.array([0.5 * (wheels.left_m[i] + wheels.right_m[i]) for i in index])
    middle = np.interp(0.5 * (t_wheel[1:] + t_wheel[:-1]), t, yaw)
    path = np.concatenate([[0.0 + 0.0j], np.cumsum(np.diff(distance) * np.exp(1j * middle))])

    def yaw_at(s: Array) -> Array:
        return np.interp(s, t, yaw)

    def path_at(s: Array) -> NDArray[np.complex128]:
        return np.interp(s, t_wheel, path.real) + 1j * np.interp(s, t_wheel, path.imag)

    return yaw_at, path_at
