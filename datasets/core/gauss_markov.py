"""First-order Gauss-Markov (Ornstein-Uhlenbeck) processes, stepped exactly.

x(t + dt) = decay x(t) + spread sigma w with unit white noise w (Uhlenbeck and Ornstein 1930, Phys. Rev. 36).
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike


def markov_decay(dt_s: ArrayLike, time_s: ArrayLike) -> Any:
    """Correlation exp(-dt / time) over a step."""
    return np.exp(-np.asarray(dt_s, dtype=float) / np.asarray(time_s, dtype=float))


def markov_spread(decay: Any) -> Any:
    """Standard deviation that a step adds, over the stationary one."""
    return np.sqrt(1.0 - decay * decay)
