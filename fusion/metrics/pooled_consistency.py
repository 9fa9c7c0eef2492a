"""NEES and NIS pooled over independent runs.

The band is where the mean of a consistent estimator falls, given the effective samples of all runs together.
The interval is the percentile bootstrap's over runs (Efron 1979, Ann. Statist. 7(1)).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows
from terrafusion.fusion.metrics.consistency import CONFIDENCE, Consistency, band, verdict

RESAMPLES = 4000
IN_OUTAGE = ", outage"
TWO_DIMENSIONAL = ("position", f"position{IN_OUTAGE}", "nis gnss")
VERDICT_SIGNS = {"consistent": "=", "overconfident": "+", "cautious": "-"}


@dataclass(frozen=True)
class PooledConsistency:
    """One quantity on one ground in one mode, over all drives.

    Attributes:
        drives, effective: number of drives, and of independent samples in all of them together.
        mean: of the drives' mean NEES or NIS per dimension.
        interval: of that mean, by bootstrap over drives.
        band: in which it lies for a consistent estimator.
    """

    terrain: str
    mode: str
    quantity: str
    drives: int
    effective: float
    mean: float
    interval: tuple[float, float]
    band: tuple[float, float]

    def verdict(self) -> str:
        """ "consistent", "overconfident" or "cautious", by the band."""
        return verdict(self.mean, *self.band)


def pool(terrain: str, mode: str, drives: Sequence[tuple[Consistency, ...]]) -> list[PooledConsistency]:
    """The drives of one ground and mode together, every drive counting the same."""
    cells = []
    for quantity in dict.fromkeys(row.quantity for drive in drives for row in drive):
        rows = [row for drive in drives for row in drive if row.quantity == quantity]
        means = np.array([row.mean for row in rows])
        # The mean of M means of which each is worth n_i samples: its variance is sum(1 / n_i) / M^2.
        effective = len(rows) ** 2 / sum(1.0 / row.effective for row in rows)
        degrees = effective * (2 if quantity in TWO_DIMENSIONAL else 1)
        cells.append(
            PooledConsistency(
                terrain,
                mode,
                quantity,
                len(rows),
                effective,
                float(means.mean()),
                mean_interval(means),
                band(degrees),
            )
        )
    return cells


def mean_interval(values: Array) -> tuple[float, float]:
    """Interval of the mean of independent `values` (M,); a point where there is one value."""
    means = values[resampled_rows(len(values), RESAMPLES, 0)].mean(axis=1)
    return percentile_interval(means, 50.0 * (1.0 - CONFIDENCE))
