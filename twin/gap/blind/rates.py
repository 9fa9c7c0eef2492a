"""Shares with their intervals, and how well stated confidence agrees with what came true."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BINS = 10


@dataclass(frozen=True)
class Rate:
    """`hits` of `count`, with the 95 % interval of Wilson (1927)."""

    hits: int
    count: int

    @property
    def value(self) -> float | None:
        """The share; None of nothing."""
        return self.hits / self.count if self.count else None

    def interval(self) -> tuple[float, float]:
        """Bounds of the true share; 0 to 1 where nothing was counted."""
        if not self.count:
            return 0.0, 1.0
        from scipy.stats import binomtest

        found = binomtest(self.hits, self.count).proportion_ci(method="wilson")
        return float(found.low), float(found.high)

    def to_json(self) -> dict[str, float | int | None]:
        low, high = self.interval()
        return {"hits": self.hits, "count": self.count, "rate": self.value, "low": low, "high": high}


@dataclass(frozen=True)
class Reliability:
    """Stated confidence against outcome.

    `bins` holds (mean confidence, share that came true, count) of the bins that are not empty. ECE weighs the
    distances of both by the count (Naeini et al. 2015); Brier (1950) is the mean square of confidence less
    outcome.
    """

    ece: float | None
    brier: float | None
    count: int
    bins: list[list[float]]


def reliability(confidence: Sequence[float], outcomes: Sequence[bool]) -> Reliability:
    """In `BINS` bins of equal width."""
    if not confidence:
        return Reliability(None, None, 0, [])
    p, y = np.asarray(confidence, dtype=float), np.asarray(outcomes, dtype=float)
    which = np.minimum((p * BINS).astype(int), BINS - 1)
    groups = [which == b for b in range(BINS) if (which == b).any()]
    bins = [[float(p[g].mean()), float(y[g].mean()), int(g.sum())] for g in groups]
    ece = sum(count * abs(stated - true) for stated, true, count in bins) / len(p)
    return Reliability(float(ece), float(np.mean((p - y) ** 2)), len(p), bins)
