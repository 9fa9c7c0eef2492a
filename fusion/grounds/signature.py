"""What a robot feels of its ground in a second: numbers relative to the robot itself.

Vibration bands are normalised by speed (`terrain.features`) and by the robot's own quiet baseline; gyro and
accelerometer are compared with the wheels. A number that the sensors do not give is NaN.
"""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.terrain.features import (
    HIGH_HZ,
    HORIZONTAL,
    LOW_HZ,
    MID_HZ,
    MIN_SPEED_MPS,
    ROLL_PITCH,
    VERTICAL,
    AxesBand,
    Window,
    band_powers,
)

VIBRATION = ("z_low", "z_mid", "z_high", "xy_low", "xy_mid", "tilt_low", "tilt_mid")
SIGNATURE = (*VIBRATION, "yaw_slip", "surge", "slide", "slip")
"""log10 of band RMS over the baseline at 1 m/s (vertical, horizontal, roll and pitch); 1 - yaw rate of the
gyro over that of the wheels; acceleration of the body over that of the wheels; probability of slippery
friction, and slip. Only fixes give the last two: they tell grounds apart that are learned."""
FELT = slice(0, SIGNATURE.index("slide"))
"""What the robot feels without fixes."""

BANDS: tuple[AxesBand, ...] = (
    *((VERTICAL, band) for band in (LOW_HZ, MID_HZ, HIGH_HZ)),
    *((axes, band) for axes in (HORIZONTAL, ROLL_PITCH) for band in (LOW_HZ, MID_HZ)),
)
"""Of `VIBRATION`."""
LEAST_YAW_RADPS, LEAST_SURGE_MPS2 = 0.15, 0.3
"""Least yaw rate and acceleration of the wheels whose share is measurable (assumed)."""
MOST_SHARE = 1.5
CLEAR_SLIP = 0.03
"""Most uncertain slip of a window that says more than the spread of slip on one ground."""
STANDS = 0.02
"""Speed, m/s, and yaw rate, rad/s, below which a robot stands."""
FLOORS = np.array([0.02] * 5 + [0.002] * 2)
"""Least baseline (m/s2, rad/s): that of a quiet MEMS IMU on a running robot (assumed)."""


class SignatureExtractor:
    """Signatures of consecutive windows; learns the quiet baseline while the robot stands."""

    def __init__(self) -> None:
        self._quiet = np.full(len(FLOORS), np.nan)

    def extract(self, window: Window, slide: float = math.nan) -> Array:
        """Signature (11,); all NaN while the robot stands."""
        powers = _band_powers(window)
        speed = window.ground_speed_mps()
        if not speed > MIN_SPEED_MPS:
            if _stands(window):
                self._quiet = np.fmin(self._quiet, powers)
            return np.full(len(SIGNATURE), np.nan)
        floor = FLOORS**2 + np.nan_to_num(self._quiet)
        out = np.full(len(SIGNATURE), np.nan)
        out[:7] = 0.5 * np.log10(np.maximum(powers - np.nan_to_num(self._quiet), 0.0) / floor + 1.0)
        out[:7] -= 0.5 * math.log10(speed)
        out[7] = _yaw_slip(window)
        out[8] = _surge_share(window)
        out[9] = slide
        if window.slip is not None and window.slip_sigma is not None and window.slip_sigma < CLEAR_SLIP:
            out[10] = window.slip
        return out


def _band_powers(window: Window) -> Array:
    """Mean square (7,) in the bands; NaN where the samples do not reach them."""
    return band_powers(window.imu_t_s, window.accel_mps2, window.gyro_radps, BANDS)


def _stands(window: Window) -> bool:
    """Whether neither robot nor wheels move or turn."""
    turns = np.array([window.yaw_rate_gyro_radps, window.yaw_rate_wheels_radps or 0.0])
    return window.ground_speed_mps() < STANDS and bool(np.abs(np.nan_to_num(turns)).max() < STANDS)


def _yaw_slip(window: Window) -> float:
    wheels = window.yaw_rate_wheels_radps
    if wheels is None or abs(wheels) < LEAST_YAW_RADPS:
        return math.nan
    return float(np.clip(1.0 - window.yaw_rate_gyro_radps / wheels, -MOST_SHARE, MOST_SHARE))


def _surge_share(window: Window) -> float:
    rate = window.wheel_speed_rate_mps2
    if abs(rate) < LEAST_SURGE_MPS2 or not len(window.accel_mps2):
        return math.nan
    return float(np.clip(window.accel_mps2[:, 0].mean() / rate, -MOST_SHARE, MOST_SHARE))
