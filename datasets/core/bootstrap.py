"""Percentile bootstrap over independent units (Efron and Tibshirani 1993, chapters 6 and 13).

Own lines in place of `scipy.stats.bootstrap`: its import is slow, and it refuses samples of one unit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

RESAMPLES, SEED = 400, 20_240_811
"""Of every bootstrap of the log checks."""


def resampled_rows(rows: int, resamples: int = RESAMPLES, seed: int = SEED) -> NDArray[np.int64]:
    """Row numbers (resamples, rows), drawn with replacement; the same seed gives the same rows."""
    return np.random.default_rng(seed).integers(rows, size=(resamples, rows))


def percentile_interval(samples: NDArray[np.float64], tail_percent: float = 2.5) -> tuple[float, float]:
    """Percentiles of the resampled statistic (R,) that leave `tail_percent` out at each end."""
    low, high = np.percentile(samples, [tail_percent, 100.0 - tail_percent])
    return float(low), float(high)


@dataclass(frozen=True)
class BootstrapInterval:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def is_beyond(self, limit: float) -> bool:
        """Whether the whole interval is further from zero than `limit`."""
        return self.low > limit or self.high < -limit


def interval_of(value: float, drawn: Array, units: int) -> BootstrapInterval:
    """An estimate from bootstrap draws (R,) over `units` independent parts.

    Few parts make the percentile interval too short: it is widened about as much as Student's t is wider
    than the normal distribution.
    """
    low, high = percentile_interval(drawn)
    wider = float(np.sqrt(units / (units - 1.0))) * (1.0 + 2.5 / (units - 1.0))
    return BootstrapInterval(value, value - wider * (value - low), value + wider * (high - value))
