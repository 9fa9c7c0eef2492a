"""The log of a robot: what its encoders, IMU and receiver say, and nothing that its owner would not know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Steering, Wheels
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.trajectory import Trajectory
from tests.studies.unseen_robots.draw import Receiver, Robot
from tests.studies.unseen_robots.machine import Driven

Array = NDArray[np.float64]

START_NS = 1_750_000_000_000_000_000
GYRO_NOISE, ACCEL_NOISE = 2e-4, 3e-3
"""Densities, rad/s/sqrt(Hz) and m/s2/sqrt(Hz): an industrial MEMS unit in motion."""
ACCEL_BIAS_MPS2 = 0.03
SLOW_S = 60.0
FIXES = {"rtk": Fix.FIXED, "dgps": Fix.DGPS, "consumer": Fix.SINGLE}


def recording_of(robot: Robot, driven: Driven) -> Recording:
    """The log; truth is of the antenna, so that no estimator is judged by a lever arm it was not told."""
    rng = np.random.default_rng([robot.seed, 2])
    t_ns = START_NS + np.round(driven.t_s * 1e9).astype(np.int64)
    known = Overrides(
        wheel_radius_m=robot.radius_m, track_m=robot.track_m, drive=robot.drive,
        wheelbase_m=robot.wheelbase_m if robot.drive == "ackermann" else None,
    )  # fmt: skip
    steering = None
    if robot.drive == "ackermann":
        rows = _rows(driven, robot.wheels_hz)
        steering = Steering(t_ns[rows], driven.steering_rad[rows, None], ("angle",))
    return Recording(
        name=robot.name, start_ns=START_NS, wheels=_wheels(robot, driven, t_ns), steering=steering,
        imu=_imu(robot, driven, t_ns, rng), gnss=_gnss(robot, driven, t_ns, rng),
        truth=Trajectory(t_ns[::5], driven.antenna_m[::5], None), truth_frame="antenna",
        truth_channels=("position",), overrides=known, description=f"{robot.drive} robot in MuJoCo",
    )  # fmt: skip


def _rows(driven: Driven, rate_hz: float) -> NDArray[np.int64]:
    """Rows of a channel, as nearly at its rate as the simulation has them."""
    step = driven.t_s[1] - driven.t_s[0]
    return np.unique(np.round(np.arange(0.0, driven.t_s[-1], 1.0 / rate_hz) / step).astype(np.int64))


def _wheels(robot: Robot, driven: Driven, t_ns: NDArray[np.int64]) -> Wheels:
    """Speeds from differences of encoder counts."""
    rows = _rows(driven, robot.wheels_hz)
    unit = 2.0 * np.pi / robot.counts
    counted = np.floor(driven.wheels_rad[rows] / unit) * unit
    if robot.drive == "differential":
        counted = counted[:, :2]
    elif robot.drive == "skid_steer":
        counted = 0.5 * (counted[:, :2] + counted[:, 2:])
    speed = np.diff(counted, axis=0) / np.diff(driven.t_s[rows])[:, None]
    names = Wheels.LAYOUTS[1] if robot.drive == "ackermann" else Wheels.LAYOUTS[0]
    return Wheels(t_ns[rows[1:]], speed, names, "radps")


def _imu(robot: Robot, driven: Driven, t_ns: NDArray[np.int64], rng: np.random.Generator) -> Imu:
    """Means over the sampling interval, with scale, bias and white noise, in the IMU's own axes."""
    rows = _rows(driven, robot.imu_hz)
    gyro, force = (_means(values, rows) for values in (driven.gyro_radps, driven.force_mps2))
    n, density = len(rows) - 1, np.sqrt(robot.imu_hz)
    gyro = gyro * [1.0, 1.0, robot.gyro_scale] + [*rng.normal(0.0, 0.003, 2), robot.gyro_bias_radps]
    gyro = gyro + GYRO_NOISE * density * rng.normal(size=(n, 3))
    force = force + rng.normal(0.0, ACCEL_BIAS_MPS2, 3) + ACCEL_NOISE * density * rng.normal(size=(n, 3))
    return Imu(t_ns[rows[1:]], gyro, force)


def _means(values: Array, rows: NDArray[np.int64]) -> Array:
    return np.add.reduceat(values, rows, axis=0)[:-1] / np.diff(rows)[:, None]


def _gnss(robot: Robot, driven: Driven, t_ns: NDArray[np.int64], rng: np.random.Generator) -> Gnss:
    """Fixes of the antenna with white and slow noise, stamped late."""
    receiver = robot.receiver
    rows = _rows(driven, receiver.rate_hz)
    noise = receiver.white_m * rng.normal(size=(len(rows), 3)) + _slow(receiver, len(rows), rng)
    scale = np.array([1.0, 1.0, 2.0])
    late = t_ns[rows] + round(robot.fix_delay_s * 1e9)
    inside = late <= t_ns[-1]
    fix = np.full(len(rows), FIXES[receiver.name], dtype=np.uint8)
    sigma = np.tile(receiver.sigma_m * scale, (len(rows), 1))
    return Gnss(late, driven.antenna_m[rows] + scale * noise, sigma, fix).select(inside)


def _slow(receiver: Receiver, count: int, rng: np.random.Generator) -> Array:
    keep = np.exp(-1.0 / (receiver.rate_hz * SLOW_S))
    out = receiver.slow_m * rng.normal(size=(count, 3))
    for i in range(1, count):
        out[i] = keep * out[i - 1] + np.sqrt(1.0 - keep**2) * out[i]
    return out
