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
from terrafusion.fusion.terrain.features import BANDS_HZ, Window

LEVELS = 6 * len(BANDS_HZ)
FLOOR = 1e-3
"""Least probability of a ground, so that no single window excludes it."""

_Levels = Annotated[tuple[float, ...], Quantity("", size=LEVELS)]


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
        levels = window.bands
        if not np.isfinite(levels).any():
            return None
        logits = self.weights @ self.standardised(levels) + self.offsets
        return np.asarray(logits - logits.mean())


def log_probabilities(log_odds: Array) -> Array:
    """log P(ground | window) (k,) of log-odds (k,)."""
    p = np.exp(log_odds - log_odds.max())
    return np.asarray(np.log(FLOOR + (1.0 - len(p) * FLOOR) * p / p.sum()))
