"""Percentile bootstrap over independent units (Efron and Tibshirani 1993, chapters 6 and 13).

Own lines in place of `scipy.stats.bootstrap`: its import is slow, and it refuses samples of one unit.
"""

import numpy as np
from numpy.typing import NDArray


def resampled_rows(rows: int, resamples: int, seed: int) -> NDArray[np.int64]:
    """Row numbers (resamples, rows), drawn with replacement; the same seed gives the same rows."""
    return np.random.default_rng(seed).integers(rows, size=(resamples, rows))


def percentile_interval(samples: NDArray[np.float64], tail_percent: float = 2.5) -> tuple[float, float]:
    """Percentiles of the resampled statistic (R,) that leave `tail_percent` out at each end."""
    low, high = np.percentile(samples, [tail_percent, 100.0 - tail_percent])
    return float(low), float(high)
