"""Alarm of a change of ground, faster than the class of the new one.

The log-odds of the grounds in a window are compared with their mean over the seconds before, by the scatter
that they have along runs on one ground (Hotelling's T^2). Unlike probabilities they do not saturate: a change
shows even where the new ground is taken for a wrong class.
"""

from collections import deque

import numpy as np

from terrafusion.datasets.core.arrays import Array

MEMORY, LEAST = 6, 3
"""Windows before, at most and at least, with which the newest is compared."""
OVERLAP = 1
"""Windows just before the newest that share samples with it, and are left out."""
NEW_GROUND_WINDOWS = 5
"""Windows from the alarm on that count in full: few of them are of the new ground, and they must tell it."""


class ChangeAlarm:
    """Compares each window with those before.

    Args:
        precision: (k, k) of the differences of log-odds; a squared distance above 1 raises the alarm.

    Attributes:
        windows: so many since the last alarm; None before the first.
    """

    def __init__(self, precision: Array) -> None:
        self._precision = precision
        self._recent: deque[Array] = deque(maxlen=MEMORY + OVERLAP + 1)
        self.windows: int | None = None

    def raised(self, log_odds: Array) -> bool:
        """Whether a window with these log-odds (k,) is on another ground than those before it."""
        self._recent.append(log_odds)
        apart = last_difference(np.array(self._recent))
        if apart is not None and float(apart @ self._precision @ apart) > 1.0:
            self._recent.clear()
            self._recent.append(log_odds)
            self.windows = 0
            return True
        self.windows = None if self.windows is None else self.windows + 1
        return False

    @property
    def on_new_ground(self) -> bool:
        """Whether the last alarm was so short ago that windows count in full."""
        return self.windows is not None and self.windows < NEW_GROUND_WINDOWS


def last_difference(log_odds: Array) -> Array | None:
    """The last row of (n, k) less the mean of those before it; None where these are too few."""
    before = log_odds[max(len(log_odds) - 1 - OVERLAP - MEMORY, 0) : max(len(log_odds) - 1 - OVERLAP, 0)]
    return None if len(before) < LEAST else np.asarray(log_odds[-1] - before.mean(axis=0))
