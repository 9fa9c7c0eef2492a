"""Which of a robot's own grounds a window is of, by the spectrum of its vibration.

Multinomial logistic regression (Cox 1958; equal priors) over the levels of seven frequency bands of each
axis of gyro and accelerometer. How these differ depends on the robot and its IMU mount: the classifier is
trained on labelled logs of the robot itself, and holds for no other.
"""

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
    """Keys of the classifier in a terrain model file; weights and offsets by ground."""

    mean: _Levels
    scale: _Levels
    weights: dict[str, _Levels]
    offsets: dict[str, float]


@dataclass(frozen=True, eq=False)
class SpectrumClassifier:
    """Weights of the standardised levels.

    Attributes:
        grounds: (k,) names.
        mean, scale: (42,) of the levels in training.
        weights, offsets: (k, 42), (k,).
    """

    grounds: tuple[str, ...]
    mean: Array
    scale: Array
    weights: Array
    offsets: Array

    @classmethod
    def of_file(cls, content: SpectrumFile) -> Self:
        """The classifier of a model file."""
        grounds = tuple(content.weights)
        weights = np.array([content.weights[name] for name in grounds])
        offsets = np.array([content.offsets[name] for name in grounds])
        return cls(grounds, np.array(content.mean), np.array(content.scale), weights, offsets)

    def standardised(self, levels: Array) -> Array:
        """Levels (..., 42) less their mean, over their scale; 0 where unknown."""
        return np.nan_to_num((levels - self.mean) / self.scale)

    def log_probabilities(self, levels: Array) -> Array | None:
        """log P(ground | levels) (k,); None where no level is known."""
        if not np.isfinite(levels).any():
            return None
        logits = self.weights @ self.standardised(levels) + self.offsets
        p = np.exp(logits - logits.max())
        return np.asarray(np.log(FLOOR + (1.0 - len(p) * FLOOR) * p / p.sum()))
