"""Which of a robot's own grounds a window is of, by the spectrum of its vibration.

Multinomial logistic regression (Cox 1958; equal priors) over the levels of seven frequency bands of each
axis of gyro and accelerometer. How these differ depends on the robot and its IMU mount: the classifier is
trained on labelled logs of the robot itself, and holds for no other.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.quantity import Quantity
from terrafusion.fusion.terrain.features import Window, periodogram, sample_rate_hz

BANDS_HZ = ((1.5, 3.0), (3.0, 6.0), (6.0, 10.0), (10.0, 14.0), (14.0, 20.0), (20.0, 30.0), (30.0, 45.0))
LEVELS = 6 * len(BANDS_HZ)
FLOOR = 1e-3
"""Least probability of a ground, so that no single window excludes it."""
_LEAST_POWER = 1e-7

_Levels = Annotated[tuple[float, ...], Quantity("", size=LEVELS)]


def band_levels(window: Window) -> Array:
    """log10 band RMS at 1 m/s (42,): by band, of gyro x, y, z in rad/s, then accelerometer x, y, z in m/s2.

    NaN where the IMU is too slow for a band or lacks an axis; all of it where samples are missing.
    """
    levels = np.full((len(BANDS_HZ), 6), np.nan)
    rate = sample_rate_hz(window.imu_t_s)
    if rate is None:
        return levels.ravel()
    density = periodogram(np.hstack([window.gyro_radps, window.accel_mps2]), rate)
    frequency = np.arange(len(density)) * rate / len(window.imu_t_s)
    for level, (low, high) in zip(levels, BANDS_HZ, strict=True):
        rows = slice(*np.searchsorted(frequency, (low, high)))
        if rate >= 2.1 * high and rows.stop > rows.start:
            power = density[rows].mean(axis=0) * (high - low)
            power[power == 0.0] = np.nan  # a channel the log does not have, filled in with a constant
            level[:] = 0.5 * np.log10(power + _LEAST_POWER)
    return np.asarray(levels.ravel() - 0.5 * np.log10(window.ground_speed_mps()))


@dataclass(frozen=True)
class SpectrumFile:
    """Keys of the classifier in a terrain model file; weights, offsets and rows of the alarm by ground."""

    mean: _Levels
    scale: _Levels
    weights: dict[str, _Levels]
    offsets: dict[str, float]
    alarm: dict[str, tuple[float, ...]]

    def problems(self, grounds: set[str]) -> Iterator[str]:
        """What is wrong beyond single values, in a model of these grounds."""
        for name in ("weights", "offsets", "alarm"):
            if set(getattr(self, name)) != grounds:
                yield f"'spectrum.{name}' has not the grounds of 'classes'"
        if any(len(row) != len(self.alarm) for row in self.alarm.values()):
            yield "'spectrum.alarm' is not square"
        if not min(self.scale) > 0.0:
            yield "'spectrum.scale' must be positive"


@dataclass(frozen=True, eq=False)
class SpectrumClassifier:
    """Weights of the standardised levels.

    Attributes:
        grounds: (k,) names.
        mean, scale: (42,) of the levels in training.
        weights, offsets: (k, 42), (k,).
        alarm: (k, k) precision of `ChangeAlarm`; zeros raise none.
    """

    grounds: tuple[str, ...]
    mean: Array
    scale: Array
    weights: Array
    offsets: Array
    alarm: Array

    @classmethod
    def of_file(cls, content: SpectrumFile) -> Self:
        """The classifier of a model file."""
        grounds = tuple(content.weights)
        mean, scale = np.array(content.mean), np.array(content.scale)
        rows = (content.weights, content.offsets, content.alarm)
        return cls(grounds, mean, scale, *(np.array([by[name] for name in grounds]) for by in rows))

    def standardised(self, levels: Array) -> Array:
        """Levels (..., 42) less their mean, over their scale; 0 where unknown."""
        return np.nan_to_num((levels - self.mean) / self.scale)

    def log_odds(self, window: Window) -> Array | None:
        """Log-odds (k,) of the grounds against their geometric mean; None where no level is known."""
        levels = band_levels(window)
        if not np.isfinite(levels).any():
            return None
        logits = self.weights @ self.standardised(levels) + self.offsets
        return np.asarray(logits - logits.mean())


def log_probabilities(log_odds: Array) -> Array:
    """log P(ground | window) (k,) of log-odds (k,)."""
    p = np.exp(log_odds - log_odds.max())
    return np.asarray(np.log(FLOOR + (1.0 - len(p) * FLOOR) * p / p.sum()))
