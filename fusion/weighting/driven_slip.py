"""Slip of each ground class as the drive itself shows it while fixes are good.

The policy's slip is that of many drives; on one drive soil, load and tyres are the same, and the slip of a
ground comes back. The mean on this drive has the policy's as its prior, with the spread of slip over all
grounds: one that looks like a class of the policy may be another ground. Slip measured over a time T differs
from the mean by the errors of the measurement and by the slip's own changes, of which a correlation time t
leaves the variance sigma^2 2 t / (T + 2 t). The spread about the mean is the posterior of a normal's variance
(conjugate: Gelman et al. 2013, Bayesian Data Analysis, sec. 3.3) whose prior counts for `PRIOR_SPREAD`
observations.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.noise.policy import Policy

WITHIN = 2.0 / 3.0
"""Share of a ground's variance of slip that a single drive shows; the rest is between means of drives (on
loose sand of training drives means scatter by .026, slips in a drive by .035; assumed for all grounds)."""
PRIOR_SPREAD = 4.0
WINDOW_S = 1.0
"""Duration of a window; those that overlap share their measurement."""


@dataclass(frozen=True, eq=False)
class SlipPrior:
    """What is expected of the slip on each of k grounds, on the level, before it is seen; (k,) each.

    Attributes:
        mean, sigma: of the slip.
        within: its 1 sigma during a drive, about the mean of that drive.
        between: 1 sigma of the means of drives, or grounds, about `mean`.
        time_s: correlation time on one ground.
    """

    mean: Array
    sigma: Array
    within: Array
    between: Array
    time_s: Array


class DrivenSlip:
    """Time, mean and scatter of the slip on each of k grounds, on the level.

    Attributes:
        prior: what is expected; another one may take its place, and what was seen stays.
    """

    def __init__(self, prior: SlipPrior, per_grade: Array) -> None:
        """`per_grade` (k,): slope of the slip over the grade."""
        self.prior, self._per_grade = prior, per_grade
        k = len(prior.mean)
        self._driven_s, self._known, self._mean = np.zeros(k), np.zeros(k), np.zeros(k)
        self._count, self._square = np.zeros(k), np.zeros(k)

    @classmethod
    def of_policy(cls, policy: Policy) -> "DrivenSlip":
        """Of the classes of a policy; what looks like one of them may be another ground."""
        mean, sigma, per_grade, time_s = policy.slips()
        between = np.full(len(mean), policy.fixed.slip_sigma)
        return cls(SlipPrior(mean, sigma, math.sqrt(WITHIN) * sigma, between, time_s), per_grade)

    def add(self, probabilities: Array, slip: float, sigma: float, grade: float, dt_s: float) -> None:
        """One window: class probabilities (k,), slip by the measurements alone with its 1 sigma, grade.

        A window counts for a class as far as that is more likely than not: the slip of mud, counted by a
        third for sand, could outweigh what the sand itself has shown.
        """
        shares = np.maximum(2.0 * probabilities - 1.0, 0.0)
        weight = shares * dt_s / WINDOW_S / sigma**2
        self._driven_s = self._driven_s + shares * dt_s
        self._known = self._known + weight
        off = slip - self._per_grade * grade - self._mean
        gain = weight / np.maximum(self._known, 1e-12)
        informative = self.prior.sigma**2 / (self.prior.sigma**2 + sigma * sigma)
        count = shares * informative * dt_s / (2.0 * self.prior.time_s)
        self._count, self._square = self._count + count, self._square + count * (1.0 - gain) * off**2
        self._mean = self._mean + gain * off

    def clear(self, ground: int) -> None:
        """Forget what was seen of one ground."""
        for tally in (self._driven_s, self._known, self._mean, self._count, self._square):
            tally[ground] = 0.0

    def posterior(self) -> tuple[Array, Array]:
        """Mean and 1 sigma (k,) of the slip to expect on each ground."""
        prior, share, variance = self.prior, self.shares(), self._variance()
        spread = (PRIOR_SPREAD * prior.within**2 + self._square) / (PRIOR_SPREAD + self._count)
        sigma = np.sqrt(spread + share * variance)
        return prior.mean + share * (self._mean - prior.mean), np.where(share > 0.0, sigma, prior.sigma)

    def shares(self) -> Array:
        """How far (k,) what the drive has shown counts against what was expected, 0 to 1."""
        between = self.prior.between**2
        return np.where(self._known > 0.0, between / (between + self._variance()), 0.0)

    def contradicted(self, sigmas: float) -> NDArray[np.bool_]:
        """On which grounds (k,) the slip of the drive is so many sigmas from what was expected."""
        apart = (self._mean - self.prior.mean) ** 2 / (self.prior.between**2 + self._variance())
        return np.asarray((self._known > 0.0) & (apart > sigmas**2))

    def _variance(self) -> Array:
        """Of the mean slip (k,) that the drive has shown."""
        lasts_s = 2.0 * self.prior.time_s
        changes = self.prior.within**2 * lasts_s / (self._driven_s + lasts_s)
        return 1.0 / np.where(self._known > 0.0, self._known, 1.0) + changes
