"""A run as the study's common arrays: command, truth, odometry, IMU and GNSS speed, and yaw rates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.analysis.speeds import (
    CUTOFF_HZ,
    MOVING_MPS,
    differenced_speed,
    imu_speed,
    low_pass,
    match,
    mean_percent,
)


@dataclass(frozen=True)
class Assumed:
    """What the study does not state of its processing: cut-off of the low-pass, threshold of motion."""

    cutoff_hz: float = CUTOFF_HZ
    moving_mps: float = MOVING_MPS


USUAL = Assumed()
OTHERS = (Assumed(cutoff_hz=0.5), Assumed(cutoff_hz=2.0), Assumed(moving_mps=0.05), Assumed(moving_mps=0.3))
"""Other choices, each tried alone, to see how far the assumptions matter."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """A run on the clock of its wheels; all (N,), NaN where no sample lies within 50 ms.

    Attributes:
        t_s: seconds from the recording's start.
        command: commanded speed, m/s, before the limits of acceleration.
        truth, odometry, imu, gnss: forward speeds, m/s, low-passed.
        yaw_rate: of the IMU, rad/s, low-passed; `gyro` is the same as measured.
        true_yaw_rate: of the body, rad/s.
        assumed: how they were made, and from which speed on the robot counts as moving.
    """

    t_s: Array
    command: Array
    truth: Array
    odometry: Array
    imu: Array
    gnss: Array
    yaw_rate: Array
    gyro: Array
    true_yaw_rate: Array
    assumed: Assumed = USUAL

    def moving(self) -> NDArray[np.bool_]:
        """Where the true speed is above the threshold."""
        return np.abs(self.truth) > self.assumed.moving_mps

    def slip(self) -> Array:
        """The study's proxy s = 1 - v_odom / v_gt (eq. 2), NaN at rest; negative where wheels run ahead."""
        moving = self.moving()
        return np.where(moving, 1.0 - self.odometry / np.where(moving, self.truth, 1.0), np.nan)

    def error(self, speed: Array) -> Array:
        """|v - v_gt| / |v_gt| of one of the speeds, NaN at rest."""
        moving, actual = self.moving(), np.abs(self.truth)
        return np.where(moving, np.abs(np.abs(speed) - actual) / np.where(moving, actual, 1.0), np.nan)


@dataclass(frozen=True)
class SpeedErrors:
    """A row of Tab. 4, mean percent over moving samples; NaN for a run that never moves."""

    slip: float
    odometry: float
    imu: float
    gnss: float


def speed_errors(profiles: Profiles) -> SpeedErrors:
    """The means of a run over the samples that move."""
    return SpeedErrors(
        slip=mean_percent(np.abs(profiles.slip())),
        odometry=mean_percent(profiles.error(profiles.odometry)),
        imu=mean_percent(profiles.error(profiles.imu)),
        gnss=mean_percent(profiles.error(profiles.gnss)),
    )


def profiles_of(recording: Recording, wheel_radius_m: float, assumed: Assumed = USUAL) -> Profiles:
    """The recording as the study's common arrays.

    Raises:
        ValueError: the recording lacks command, wheels, IMU, GNSS or truth with its twist.
    """
    command, wheels, imu, gnss, truth = (
        recording.command, recording.wheels, recording.imu, recording.gnss, recording.truth,
    )  # fmt: skip
    if not (command and wheels and imu and gnss and truth) or truth.twist_body is None:
        raise ValueError("the study's processing needs command, wheels, IMU, GNSS and truth with its twist")

    def clock(t_ns: NDArray[np.int64]) -> Array:
        return np.asarray((t_ns - recording.start_ns) * 1e-9)

    t_s, cutoff_hz = clock(wheels.t_ns), assumed.cutoff_hz
    t_truth, t_imu = clock(truth.t_ns), clock(imu.t_ns)
    t_gnss, v_gnss = differenced_speed(clock(gnss.t_ns), gnss.enu_m, cutoff_hz)
    odometry = wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)
    gyro = imu.gyro_radps[:, 2]
    return Profiles(
        t_s=t_s,
        command=match(clock(command.t_ns), command.v_mps, t_s),
        truth=match(t_truth, low_pass(t_truth, truth.twist_body[:, 0], cutoff_hz), t_s),
        odometry=low_pass(t_s, odometry, cutoff_hz),
        imu=match(t_imu, low_pass(t_imu, imu_speed(imu, recording.start_ns), cutoff_hz), t_s),
        gnss=match(t_gnss, v_gnss, t_s),
        yaw_rate=match(t_imu, low_pass(t_imu, gyro, cutoff_hz), t_s),
        gyro=match(t_imu, gyro, t_s),
        true_yaw_rate=match(t_truth, truth.twist_body[:, 5], t_s),
        assumed=assumed,
    )
