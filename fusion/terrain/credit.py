"""Credit of an external source of the ground: how far wheels and IMU bear out what it claims.

The log-odds that the source tells the ground grow with each window by the Bayes factor of the claimed grounds
against grounds drawn at random. A robot that the terrain model does not know checks a claim by its slip
alone, while fixes show it.
"""

import math
from collections import deque

import numpy as np

from terrafusion.datasets.core.arrays import Array

TRUSTED = 3.0
"""Log-odds at the start, and at most; then the source is believed without reserve."""
LEAST = -60.0
"""Log-odds at least: a source that was wrong for long is believed again after about a minute."""
MOST_LOSS = 4.0
"""Most log-odds that one window takes: a ground of a class may be another than those of its training."""
WINDOWS = 3
"""Checks over which claims are averaged: the window spans a change of ground for so long."""


class SourceCredit:
    """Share, 0 to 1, by which a source is believed: the probability that it tells the ground, over that at
    the start.

    Args:
        k: number of grounds.
        unknown: index of ground without a class, a claim that cannot be checked.
    """

    def __init__(self, k: int, unknown: int) -> None:
        self._drawn, self._unknown = np.full(k, 1.0 / k), unknown
        self._odds = TRUSTED
        self._claims: deque[Array] = deque(maxlen=20)
        self._recent: deque[Array] = deque(maxlen=WINDOWS)

    @property
    def value(self) -> float:
        """The share now."""
        return (1.0 + math.exp(-TRUSTED)) / (1.0 + math.exp(-self._odds))

    @property
    def has_claims(self) -> bool:
        """Whether there are claims to check."""
        return bool(self._claims)

    def claim(self, probabilities: Array) -> None:
        """What the source says now: probabilities (k,) that sum to one."""
        self._claims.append(probabilities)

    def check(self, log_likelihood: Array) -> None:
        """Compare the claims since the last check with the log-likelihoods (k,) of a window."""
        if not self._claims:
            return
        self._recent.append(np.mean(self._claims, axis=0))
        self._claims.clear()
        claimed = np.mean(self._recent, axis=0)
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        checked = 1.0 - float(claimed[self._unknown])
        if not checked > 0.5:
            return
        borne_out = float(claimed @ likelihood) / float(self._drawn @ likelihood)
        self._odds += max(math.log(max(borne_out, 1e-9)), -MOST_LOSS)
        self._odds = min(max(self._odds, LEAST), TRUSTED)
