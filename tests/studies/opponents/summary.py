"""Medians, ratios and their bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows

Array = NDArray[np.float64]

RESAMPLES, SEED = 2000, 0
LEAST_UNITS = 3
"""Fewer values have no interval."""
LEAST_ERROR_M = 0.01
"""Smaller medians count as a centimetre in ratios: fixes and truth are no better."""
LOST = 1.05


@dataclass(frozen=True)
class Interval:
    """A value and its 95 % interval; none where there are too few."""

    value: float
    low: float | None
    high: float | None

    def text(self, digits: int = 2) -> str:
        """As in `0.71 [0.60, 0.83]`."""
        if self.low is None or self.high is None:
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"


def median(values: Sequence[float]) -> Interval:
    """Median and percentile bootstrap."""
    return _bootstrap(np.asarray(values, dtype=float), np.median)


def geometric_mean(ratios: Sequence[float]) -> Interval:
    """Geometric mean over logs, logs resampled."""
    found = _bootstrap(np.log(np.asarray(ratios, dtype=float)), np.mean)
    low, high = (None if x is None else float(np.exp(x)) for x in (found.low, found.high))
    return Interval(float(np.exp(found.value)), low, high)


def ratio(mine: float, theirs: float) -> float:
    """Of two errors in m."""
    return max(mine, LEAST_ERROR_M) / max(theirs, LEAST_ERROR_M)


def losses(ratios: Sequence[float]) -> int:
    """How many are more than 5 % worse."""
    return sum(r > LOST for r in ratios)


def _bootstrap(values: Array, statistic: object) -> Interval:
    assert callable(statistic)
    value = float(statistic(values))
    if len(values) < LEAST_UNITS:
        return Interval(value, None, None)
    draws = [float(statistic(values[rows])) for rows in resampled_rows(len(values), RESAMPLES, SEED)]
    return Interval(value, *percentile_interval(np.array(draws)))
