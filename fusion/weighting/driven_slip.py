"""Slip of each ground class as the drive itself shows it while fixes are good.

The policy's slip is that of many drives; on one drive soil, load and tyres are the same, and the slip of a
ground comes back. Mean and variance are the posterior of a normal with unknown mean and variance (conjugate:
Gelman et al. 2013, Bayesian Data Analysis, sec. 3.3) whose prior is the policy's and counts for
`PRIOR_MEAN` and `PRIOR_SPREAD` observations. A window counts by its length over twice the slip's correlation
time, by the probability of the class, and less where the slip is measured badly.
"""

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.noise.policy import Policy

PRIOR_MEAN, PRIOR_SPREAD = 2.0, 4.0
"""Independent observations that the policy's mean and spread count for: on loose sand of training drives the
means of drives scatter by .026, slips in a drive by .035 (assumed for all grounds)."""


class DrivenSlip:
    """Count, mean and summed square deviation of the slip on each class of a policy, on the level."""

    def __init__(self, policy: Policy) -> None:
        self._prior, self._prior_sigma, self._per_grade, self._time_s = policy.slips()
        k = len(self._prior)
        self._count, self._mean, self._square = np.zeros(k), np.zeros(k), np.zeros(k)

    def add(self, shares: Array, slip: float, sigma: float, grade: float, dt_s: float) -> None:
        """One window: class probabilities (k,), slip by the measurements alone with its 1 sigma, grade."""
        informative = self._prior_sigma**2 / (self._prior_sigma**2 + sigma * sigma)
        weight = shares * informative * dt_s / (2.0 * self._time_s)
        count = self._count + weight
        off = slip - self._per_grade * grade - self._mean
        gain = weight / np.maximum(count, 1e-12)
        self._square = self._square + weight * (1.0 - gain) * off**2
        self._count, self._mean = count, self._mean + gain * off

    def posterior(self) -> tuple[Array, Array]:
        """Mean and 1 sigma (k,) of the slip to expect on each class."""
        n, off = self._count, self._mean - self._prior
        mean = self._prior + n / (n + PRIOR_MEAN) * off
        square = self._square + n * PRIOR_MEAN / (n + PRIOR_MEAN) * off**2
        within = self._prior_sigma**2 / (1.0 + 1.0 / PRIOR_MEAN)  # the policy's spread holds that of means
        variance = (PRIOR_SPREAD * within + square) / (PRIOR_SPREAD + n) * (1.0 + 1.0 / (n + PRIOR_MEAN))
        return mean, np.where(n > 0.0, np.sqrt(variance), self._prior_sigma)
