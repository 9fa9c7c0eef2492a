"""Terrain features: vibration levels, slip and yaw slip of a window of about one second.

A feature that cannot be observed is NaN; the classifier marginalises it.

Vibration is the RMS inside fixed bands of physical frequency, from a Hann periodogram after removing the
line through the window. A 30 Hz and a 400 Hz stream of one motion have the same power below 14 Hz, while
an RMS over all frequencies depends on the rate. The one band above 14 Hz is missing for slow streams. A
slow stream sampled without an anti-aliasing filter still has its higher vibration folded into the low
bands.

Speed: on a random profile of displacement spectrum S(n) ~ 1/n^2 (ISO 8608:2016, waviness 2) driven at v,
the spectrum over time at f is v/f^2 times a constant, so the RMS in a fixed band grows with v^(1/2). That
factor is divided out, v being the faster of robot and wheels: wheels that spin on the spot shake, too.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array

FEATURES = ("z_low", "z_mid", "z_high", "xy", "roll_pitch", "slip", "yaw_slip")
"""log10 of band RMS at 1 m/s (m/s2; roll_pitch rad/s), then the slips (-)."""

SLIP = FEATURES.index("slip")
YAW_SLIP = FEATURES.index("yaw_slip")
BANDS_HZ = ((1.5, 3.0), (3.0, 6.0), (6.0, 10.0), (10.0, 14.0), (14.0, 20.0), (20.0, 30.0), (30.0, 45.0))
LOW_HZ, MID_HZ, HIGH_HZ = (3.0, 8.0), (8.0, 14.0), (14.0, 45.0)
AxesBand = tuple[slice, tuple[float, float]]
"""Columns of accelerometer x, y, z and gyro x, y that are added, and a band of frequency, Hz."""
HORIZONTAL, VERTICAL, ROLL_PITCH = slice(0, 2), slice(2, 3), slice(3, 5)
MIN_SPEED_MPS = 0.15
"""Below this the ground is unobservable: no vibration, and slip is a quotient of two noises."""

_MIN_YAW_RATE_RADPS = 0.15
_MIN_SPAN_S = 0.6
_WIDE_HZ = (LOW_HZ[0], MID_HZ[1])
_LEVELS: tuple[AxesBand, ...] = (
    *((VERTICAL, band) for band in (LOW_HZ, MID_HZ, HIGH_HZ)),
    (HORIZONTAL, _WIDE_HZ),
    (ROLL_PITCH, _WIDE_HZ),
)
_FLOORS = np.array([1e-3] * 4 + [1e-4])
"""Least levels of `_LEVELS`, m/s2 and rad/s."""
_LEAST_POWER = 1e-7
_TIMING_S = 0.05
_LEAST_INFORMATION = 1.0
"""Of the measurements, in units of the prior's, for the slip to count as observed."""
_SLIP_RANGE = (-1.0, 1.2)


@dataclass
class Window:
    """The last second or so of a run.

    Attributes:
        dt_s: time since the previous update.
        imu_t_s: (n,) sample times, s. gyro_radps, accel_mps2: (n, 3) body axes; NaN where the log has
            none.
        wheel_speed_mps: mean forward circumferential speed of the wheels; wheel_speed_rate_mps2: its rate.
        speed_mps: the estimator's forward speed.
        yaw_rate_wheels_radps: yaw rate of the wheels alone, or None where sides are not distinguished.
        yaw_rate_gyro_radps: mean yaw rate of the gyroscope, bias removed; NaN where unknown.
        slip, slip_sigma: slip 1 - v / (omega R) and its 1 sigma, of measurements alone: see
            `slip_without_prior` (the class prior would confirm itself); None where there are none.
    """

    dt_s: float
    imu_t_s: Array
    gyro_radps: Array
    accel_mps2: Array
    wheel_speed_mps: float
    wheel_speed_rate_mps2: float
    speed_mps: float
    yaw_rate_wheels_radps: float | None
    yaw_rate_gyro_radps: float
    slip: float | None = None
    slip_sigma: float | None = None

    def ground_speed_mps(self) -> float:
        """The faster of robot and wheels, m/s; 0 where both are unknown."""
        known = [abs(v) for v in (self.speed_mps, self.wheel_speed_mps) if not math.isnan(v)]
        return float(max(known, default=0.0))

    @functools.cached_property
    def vibration(self) -> Array:
        """Its `vibration_levels` (5,)."""
        return vibration_levels(self.imu_t_s, self.accel_mps2, self.gyro_radps)

    @functools.cached_property
    def bands(self) -> Array:
        """Its `band_levels` (42,) at 1 m/s."""
        levels = band_levels(self.imu_t_s, np.hstack([self.gyro_radps, self.accel_mps2]))
        return np.asarray(levels - 0.5 * np.log10(self.ground_speed_mps()))


def extract(window: Window, vibration: bool = True) -> tuple[Array, Array]:
    """Features (7,) in the order of `FEATURES`, and the measurement variance (7,) of each.

    Variances are those of slip and yaw slip; the scatter of vibration is part of the class densities. Where
    nobody asks for `vibration`, it is NaN.
    """
    values = np.full(len(FEATURES), np.nan)
    variances = np.zeros(len(FEATURES))
    if not window.ground_speed_mps() > MIN_SPEED_MPS:
        return values, variances
    if vibration:
        values[:SLIP] = window.vibration - 0.5 * np.log10(window.ground_speed_mps())
    wheel = window.wheel_speed_mps
    if window.slip is not None and window.slip_sigma is not None and abs(wheel) > MIN_SPEED_MPS:
        values[SLIP] = np.clip(window.slip, *_SLIP_RANGE)
        timing = _TIMING_S * window.wheel_speed_rate_mps2 / wheel
        variances[SLIP] = window.slip_sigma**2 + timing**2
    yaw = window.yaw_rate_wheels_radps
    if yaw is not None and abs(yaw) > _MIN_YAW_RATE_RADPS:
        values[YAW_SLIP] = np.clip(1.0 - window.yaw_rate_gyro_radps / yaw, *_SLIP_RANGE)
        variances[YAW_SLIP] = (0.02 / yaw) ** 2
    values[~np.isfinite(values + variances)] = np.nan
    return values, variances


def slip_without_prior(
    slip: float, sigma: float, prior_slip: float, prior_sigma: float
) -> tuple[float, float] | None:
    """Slip and 1 sigma by the measurements alone, or None where they carry little information.

    An estimate made under a prior is the product of prior and likelihood; the prior comes from the class
    that the slip is to classify, and is divided out again (the cavity of Minka 2001): 1/s^2 = 1/sigma^2 -
    1/prior_sigma^2.
    """
    left = 1.0 / max(sigma, 1e-6) ** 2 - 1.0 / prior_sigma**2
    if not left > _LEAST_INFORMATION / prior_sigma**2:
        return None
    return (slip / max(sigma, 1e-6) ** 2 - prior_slip / prior_sigma**2) / left, left**-0.5


def vibration_levels(t_s: Array, accel_mps2: Array, gyro_radps: Array) -> Array:
    """log10 band RMS (5,) of one window of samples (n,), (n, 3), (n, 3); NaN where not observed."""
    return np.asarray(0.5 * np.log10(band_powers(t_s, accel_mps2, gyro_radps, _LEVELS) + _FLOORS**2))


def band_powers(t_s: Array, accel_mps2: Array, gyro_radps: Array, bands: Sequence[AxesBand]) -> Array:
    """Mean square (k,) of one window of samples (n,), (n, 3), (n, 3) in k bands; NaN where not observed.

    Recorded times jitter more than the sampling of an IMU: samples are taken as evenly spaced, unless a
    gap shows that some are missing.
    """
    powers = np.full(len(bands), np.nan)
    rate = sample_rate_hz(t_s)
    if rate is None:
        return powers
    density = periodogram(np.hstack([accel_mps2, gyro_radps[:, :2]]), rate)
    frequency = np.arange(len(density)) * rate / len(t_s)
    for i, (axes, (low, high)) in enumerate(bands):
        if rate >= 2.1 * high:
            rows = (frequency >= low) & (frequency < high)
            powers[i] = float(density[rows, axes].sum(axis=1).mean()) * (high - low)
    powers[powers == 0.0] = np.nan  # a channel the log does not have, filled in with a constant
    return powers


def band_levels(t_s: Array, samples: Array) -> Array:
    """log10 band RMS (42,): by band, of the columns of samples (n, 6), gyro (rad/s) and accelerometer (m/s2).

    NaN where the IMU is too slow for a band or lacks an axis; all of it where samples are missing.
    """
    levels = np.full((len(BANDS_HZ), 6), np.nan)
    rate = sample_rate_hz(t_s)
    if rate is None:
        return levels.ravel()
    density = periodogram(samples, rate)
    frequency = np.arange(len(density)) * rate / len(t_s)
    for level, (low, high) in zip(levels, BANDS_HZ, strict=True):
        rows = slice(*np.searchsorted(frequency, (low, high)))
        if rate >= 2.1 * high and rows.stop > rows.start:
            power = density[rows].mean(axis=0) * (high - low)
            power[power == 0.0] = np.nan  # a channel the log does not have, filled in with a constant
            level[:] = 0.5 * np.log10(power + _LEAST_POWER)
    return levels.ravel()


def sample_rate_hz(t_s: Array) -> float | None:
    """Rate of the samples at `t_s` (n,), s; None where they are too few or have a gap."""
    n = len(t_s)
    if n < 4:
        return None
    span = float(t_s[-1] - t_s[0])
    if not span > _MIN_SPAN_S or float(np.diff(t_s).max()) > 4.0 * span / (n - 1):
        return None
    return (n - 1) / span


def periodogram(signals: Array, rate_hz: float) -> Array:
    """One-sided spectral density (n // 2 + 1, k) of signals (n, k), unit^2/Hz (Welch 1967, one segment)."""
    line, taper = _line_and_taper(len(signals))
    slope = line @ signals / (line @ line)
    detrended = (signals - signals.mean(axis=0) - line[:, None] * slope) * taper[:, None]
    spectrum = np.fft.rfft(detrended, axis=0)
    return np.asarray(2.0 * (spectrum.real**2 + spectrum.imag**2) / (rate_hz * (taper @ taper)))


@functools.lru_cache(maxsize=16)
def _line_and_taper(n: int) -> tuple[Array, Array]:
    """Centred sample numbers and Hann taper (n,) of a window."""
    line = np.arange(n) - (n - 1) / 2.0
    return np.asarray(line), np.asarray(0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n))
