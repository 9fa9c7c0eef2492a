"""Errors of speed by odometry, IMU and GNSS, with the post-processing of the study that the twin starts from.

Stated by the study: streams are matched in time within 50 ms, all velocity
profiles are low-passed, the slip proxy is averaged where |v_gt| exceeds a
threshold, GNSS speed comes from differenced ENU positions and is smoothed, the
IMU is integrated after a rest of about 2 s and a 0.5 s moving average. Cut-off,
threshold and kind of smoothing are not stated: those here are assumed.
"""

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.recording import Recording

MATCH_S = 0.050
"""Samples further apart in time are not compared (the study's figure)."""
CUTOFF_HZ = 1.0
"""Usual cut-off of the low-pass on all velocity profiles (assumed)."""
MOVING_MPS = 0.1
"""Usual threshold of the true speed above which errors and slip are averaged (assumed)."""
LEAST_FILTERED = 10
"""The filter is continued by 9 samples at both ends, which a series has to have."""
REST_S = 2.0
"""The forward acceleration's mean over this first rest is taken off (the study's figure)."""
AVERAGE_S = 0.5
"""Moving average over the forward acceleration (the study's figure)."""


def speed_errors(recording: Recording, wheel_radius_m: float) -> dict[str, float]:
    """Mean of |v - v_gt| / |v_gt|, percent, over samples of the wheels that move; NaN without any, or
    without fixes then.

    Of the speeds by "odometry", "imu" and "gnss", all low-passed.

    Raises:
        ValueError: the recording lacks wheels, IMU, GNSS or truth with its twist.
    """
    wheels, imu, gnss, truth = recording.wheels, recording.imu, recording.gnss, recording.truth
    if wheels is None or imu is None or gnss is None or truth is None or truth.twist_body is None:
        raise ValueError("errors of speed need wheels, IMU, GNSS and truth with its twist")
    t_s, t_truth, t_imu, t_gnss = (
        np.asarray((one.t_ns - recording.start_ns) * 1e-9) for one in (wheels, truth, imu, gnss)
    )
    t_gnss, v_gnss = differenced_speed(t_gnss, gnss.enu_m)
    actual = np.abs(match(t_truth, low_pass(t_truth, truth.twist_body[:, 0]), t_s))
    moving = actual > MOVING_MPS
    speeds = {
        "odometry": low_pass(t_s, wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)),
        "imu": match(t_imu, low_pass(t_imu, imu_speed(imu, recording.start_ns)), t_s),
        "gnss": match(t_gnss, v_gnss, t_s),
    }
    return {
        name: mean_percent(np.abs(np.abs(speed[moving]) - actual[moving]) / actual[moving])
        for name, speed in speeds.items()
    }


def match(t_s: Array, values: Array, wanted_s: Array) -> Array:
    """Nearest value (M,) to each wanted time, NaN where none lies within 50 ms."""
    if not len(t_s):
        return np.full(len(wanted_s), np.nan)
    right = np.clip(np.searchsorted(t_s, wanted_s), 1, len(t_s) - 1)
    nearest = right - (wanted_s - t_s[right - 1] < t_s[right] - wanted_s)
    near = np.abs(t_s[nearest] - wanted_s) <= MATCH_S + 1e-9
    return np.where(near, values[nearest], np.nan)


def low_pass(t_s: Array, values: Array, cutoff_hz: float = CUTOFF_HZ) -> Array:
    """Evenly sampled values (N,) through a second-order Butterworth, forwards and backwards: no lag.

    A series too short for the filter stays as it is.
    """
    from scipy.signal import butter, sosfiltfilt

    if len(values) < LEAST_FILTERED:
        return values
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


def differenced_speed(t_s: Array, enu_m: Array, cutoff_hz: float = CUTOFF_HZ) -> tuple[Array, Array]:
    """Horizontal speed (N - 1,) of positions (N, 2 or more), low-passed, at the middle of each interval."""
    step = np.diff(enu_m[:, :2], axis=0)
    middle = 0.5 * (t_s[1:] + t_s[:-1])
    return middle, low_pass(middle, np.hypot(step[:, 0], step[:, 1]) / np.diff(t_s), cutoff_hz)


def mean_percent(values: Array) -> float:
    """Mean of the finite shares, percent; NaN where there are none."""
    known = values[np.isfinite(values)]
    return 100.0 * float(known.mean()) if known.size else float("nan")
