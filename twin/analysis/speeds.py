"""The study's post-processing: common arrays of command, truth, odometry, IMU and GNSS speed.

Stated by the study: streams are matched in time within 50 ms, all velocity
profiles are low-passed, the slip proxy is averaged where |v_gt| exceeds a
threshold, GNSS speed comes from differenced ENU positions and is smoothed, the
IMU is integrated after a rest of about 2 s and a 0.5 s moving average. Cut-off,
threshold and kind of smoothing are not stated: those here are assumed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Gnss, Imu
from terrafusion.datasets.core.recording import Recording

MATCH_S = 0.050
"""Samples further apart in time are not compared (the study's figure)."""
CUTOFF_HZ = 1.0
"""Usual cut-off of the low-pass on all velocity profiles (assumed)."""
MOVING_MPS = 0.1
"""Usual threshold of the true speed above which errors and slip are averaged (assumed)."""
REST_S = 2.0
"""The forward acceleration's mean over this first rest is taken off (the study's figure)."""
AVERAGE_S = 0.5
"""Moving average over the forward acceleration (the study's figure)."""


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
    t_gnss, v_gnss = gnss_speed(gnss, recording.start_ns, cutoff_hz)
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


def match(t_s: Array, values: Array, wanted_s: Array) -> Array:
    """Nearest value (M,) to each wanted time, NaN where none lies within 50 ms."""
    right = np.clip(np.searchsorted(t_s, wanted_s), 1, len(t_s) - 1)
    nearest = right - (wanted_s - t_s[right - 1] < t_s[right] - wanted_s)
    near = np.abs(t_s[nearest] - wanted_s) <= MATCH_S + 1e-9
    return np.where(near, values[nearest], np.nan)


def low_pass(t_s: Array, values: Array, cutoff_hz: float = CUTOFF_HZ) -> Array:
    """Evenly sampled values (N,) through a second-order Butterworth, forwards and backwards: no lag."""
    from scipy.signal import butter, sosfiltfilt

    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    if cutoff_hz >= 0.45 * rate_hz:
        return values
    return np.asarray(sosfiltfilt(butter(2, cutoff_hz, fs=rate_hz, output="sos"), values))


def imu_speed(imu: Imu, start_ns: int) -> Array:
    """Speed (N,), m/s, by integrating the forward acceleration (study, eq. 4).

    The mean of the rest at the start takes gravity's share and the bias off, a
    moving average smooths, the trapezoid rule integrates.
    """
    t_s = np.asarray((imu.t_ns - start_ns) * 1e-9)
    forward = imu.accel_mps2[:, 0] - imu.accel_mps2[t_s <= REST_S, 0].mean()
    width = max(1, round(AVERAGE_S / float(np.median(np.diff(t_s)))))
    smooth = np.convolve(forward, np.ones(width) / width, mode="same")
    steps = 0.5 * (smooth[1:] + smooth[:-1]) * np.diff(t_s)
    return np.concatenate([[0.0], np.cumsum(steps)])


def gnss_speed(gnss: Gnss, start_ns: int, cutoff_hz: float = CUTOFF_HZ) -> tuple[Array, Array]:
    """Times (N - 1,) s between the fixes, and speed (N - 1,), m/s, from their differences, smoothed."""
    return differenced_speed(np.asarray((gnss.t_ns - start_ns) * 1e-9), gnss.enu_m, cutoff_hz)


def differenced_speed(t_s: Array, enu_m: Array, cutoff_hz: float = CUTOFF_HZ) -> tuple[Array, Array]:
    """Horizontal speed (N - 1,) of positions (N, 2 or more), low-passed, at the middle of each interval."""
    step = np.diff(enu_m[:, :2], axis=0)
    middle = 0.5 * (t_s[1:] + t_s[:-1])
    return middle, low_pass(middle, np.hypot(step[:, 0], step[:, 1]) / np.diff(t_s), cutoff_hz)


def mean_percent(values: Array) -> float:
    """Mean of the finite shares, percent; NaN where there are none."""
    known = values[np.isfinite(values)]
    return 100.0 * float(known.mean()) if known.size else float("nan")
