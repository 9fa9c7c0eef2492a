"""A mean over runs with its interval, and the spread of single runs."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Spread:
    """A quantity over independent runs; unknown (NaN) values are left out.

    Attributes:
        mean: over the runs.
        half_width: the mean lies in mean -+ this with 95 % confidence (Student's t); NaN for one run.
        low, high: smallest and largest run.
    """

    mean: float
    half_width: float
    low: float
    high: float
    runs: int

    def text(self, digits: int = 1) -> str:
        """`mean +- half width`, as the tables show it."""
        if self.runs == 0:
            return "-"
        if math.isnan(self.half_width):
            return f"{self.mean:.{digits}f}"
        return f"{self.mean:.{digits}f} ± {self.half_width:.{digits}f}"


def spread(values: Iterable[float]) -> Spread:
    """The spread of the finite values."""
    from scipy.stats import t as student

    known = np.array([value for value in values if math.isfinite(value)])
    n = len(known)
    if n == 0:
        return Spread(math.nan, math.nan, math.nan, math.nan, 0)
    half = math.nan
    if n > 1:
        half = float(student.ppf(0.5 + 0.5 * CONFIDENCE, n - 1) * known.std(ddof=1) / math.sqrt(n))
    return Spread(float(known.mean()), half, float(known.min()), float(known.max()), n)
