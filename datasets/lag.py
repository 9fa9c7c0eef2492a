"""The lag between two signals of different clocks, by correlation, with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_S = 0.01
"""Resolution of the search; the peak is refined by a parabola."""


@dataclass(frozen=True)
class Lag:
    """Seconds by which the second signal lags the first, their 95 % interval, and the correlation there."""

    seconds: float
    low_s: float
    high_s: float
    r: float


def lag_between(t_a_s: Array, a: Array, t_b_s: Array, b: Array, *, reach_s: float = 2.0) -> Lag | None:
    """How much later `b` tells what `a` tells.

    Args:
        t_a_s, a: times (N,) s and values (N,) of the first signal; NaN values are left out.
        t_b_s, b: the same of the second, (M,).
        reach_s: largest lag that is looked for, either way.

    Returns:
        Lag, or None where the common time is too short, a signal is constant, or no peak stands
        inside the reach. A positive lag is repaired by subtracting it from the times of `b`.

    The interval is a block bootstrap over stretches of the common time (Kuensch 1989), which keeps the
    correlation inside a stretch.
    """
    raise NotImplementedError
