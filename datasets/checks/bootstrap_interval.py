"""An estimated number with its interval, as findings report it."""

from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import percentile_interval

RESAMPLES, SEED = 400, 20_240_811
"""Of every bootstrap of the log checks."""


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
