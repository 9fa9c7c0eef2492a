"""The IMU beside gravity and the wheels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.doctor.finding import Finding, Patient
from terrafusion.datasets.frames import GRAVITY_MPS2

Array = NDArray[np.float64]

DEGREES_SLOPE = 15.0
"""Gyro rate over the difference of the side speeds, 1/m: the inverse track, 0.3 to 4, unless in deg/s."""


def check_gravity(patient: Patient) -> Iterator[Finding]:
    """Specific force must average to +g on z: anything else is a wrong mounting, sign or unit."""
    imu = patient.recording.imu
    if imu is None or not imu.has_accel() or len(imu) < 10:
        return
    mean = np.nanmean(imu.accel_mps2, axis=0)
    size = float(np.linalg.norm(mean))
    evidence = f"mean specific force ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) m/s2"
    if 0.8 < size < 1.2:
        yield Finding(
            "accel-in-g",
            "error",
            "imu",
            "acceleration looks like g, not m/s2",
            evidence,
            "multiply by 9.80665",
        )
    elif not 0.85 * GRAVITY_MPS2 < size < 1.15 * GRAVITY_MPS2:
        yield Finding(
            "accel-magnitude",
            "error",
            "imu",
            f"mean specific force is {size:.2f} m/s2, not 9.8",
            evidence,
            "give raw accelerometer data in m/s2, gravity included",
        )
    elif mean[2] < np.cos(np.radians(30.0)) * size:
        axis = int(np.argmax(np.abs(mean)))
        where = f"{'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}"
        yield Finding(
            "imu-axes",
            "error",
            "imu",
            f"gravity stands on {where}, not on +z",
            evidence,
            "give the vehicle (its IMU mounting), or rotate the IMU to x forward, y left, z up",
        )


def check_yaw_sign(patient: Patient) -> Iterator[Finding]:
    """The gyro's yaw rate must rise and fall with that of the wheels."""
    wheels, imu = patient.recording.wheels, patient.recording.imu
    if wheels is None or imu is None or not wheels.has_sides() or len(imu) < 20:
        return
    rate = imu.gyro_radps[:, 2]
    if np.isnan(rate).all():
        return
    sides = wheels.side_speeds_mps(patient.wheel_radius_m() or 0.15)
    turn = sides[:, 1] - sides[:, 0]
    origin = max(int(wheels.t_ns[0]), int(imu.t_ns[0]))
    common_s = (min(int(wheels.t_ns[-1]), int(imu.t_ns[-1])) - origin) * 1e-9
    grid: Array = np.arange(0.0, common_s, 0.5)
    if len(grid) < 20:
        return
    by_wheels = _mean_between(grid, (wheels.t_ns - origin).astype(float) * 1e-9, turn)
    by_gyro = _mean_between(grid, (imu.t_ns - origin).astype(float) * 1e-9, rate)
    if by_wheels.std() < 0.02 or by_gyro.std() < 0.02:
        return
    r = float(np.corrcoef(by_wheels, by_gyro)[0, 1])
    evidence = f"correlation {r:.2f} of the half-second means"
    slope = abs(r) * float(by_gyro.std() / by_wheels.std())
    if slope > DEGREES_SLOPE and abs(r) > 0.5:
        yield Finding(
            "gyro-in-degrees",
            "error",
            "imu",
            "gyro z is far larger than the wheels' yaw rate: it looks like deg/s",
            f"{slope:.0f} rad/s for each m/s between the sides; {evidence}",
            "multiply by pi / 180, and check the wheel radius",
        )
    elif r < -0.5:
        yield Finding(
            "yaw-sign",
            "error",
            "imu",
            "gyro z turns against the wheels",
            evidence,
            "change the sign of the gyro (z up, left turn positive), or swap left and right wheels",
        )
    elif r < 0.3 and by_wheels.std() > 0.05 and by_gyro.std() > 0.05:
        yield Finding(
            "yaw-unrelated",
            "warning",
            "imu",
            "gyro z does not follow the wheels",
            evidence,
            "check the IMU's axes and the two clocks; on slippery ground it may be real",
        )


def _mean_between(grid_s: Array, t_s: Array, values: Array) -> Array:
    """Means of a signal over the intervals of the grid, (len(grid) - 1,)."""
    known = np.isfinite(values)
    t_s, values = t_s[known], values[known]
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    return np.diff(np.interp(grid_s, t_s, area)) / np.diff(grid_s)
