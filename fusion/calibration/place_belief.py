"""How far antenna and delay of the fixes may be from those in use.

A number that corrects a sensor has its stated sigma, as an antenna has that is only assumed. Of delays that
correct nothing, most are as the robot's file says and some far from it: the probability of the second follows
from the ratio of the densities, after and before the drive, of the first (Dickey 1971, Ann. Math. Statist.
42(1), 204).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    COURSE_LAG,
    GNSS_DELAY,
    TURN_SCALE,
    Knowledge,
)

PLACE = [ANTENNA_X, ANTENNA_Y, GNSS_DELAY]
"""The numbers that move the place which fixes give."""
CORRELATED = [TURN_SCALE, *PLACE, COURSE_LAG]
"""Numbers whose errors are correlated: one can look like another. Wheels slip on every ground: they are never
taken to be as on the last one."""
REFUTED_SIGMA = 4.0
"""From so many sigma on a number is no longer taken to be as before where others are not."""
ON_TIME = 0.8
"""Share of receivers that are as late as the robot's file says (assumed)."""
TIMELY_SIGMA_S = 0.03
"""1 sigma of what slip adds to the delay found on any ground (assumed)."""


@dataclass(frozen=True, eq=False)
class PlaceBelief:
    """What a drive shows of the numbers `PLACE`; each (3,), m and s.

    Attributes:
        before: as the robot's file says.
        shown, sigma: as the drive shows them, and 1 sigma.
        probability: that they are not as before.
    """

    before: Array
    shown: Array
    sigma: Array
    probability: Array

    @classmethod
    def of(
        cls, known: Knowledge, before: Knowledge, corrected: NDArray[np.bool_], antenna_assumed: bool = False
    ) -> Self:
        """By what is `known` after the drive and `before` it.

        `corrected` (3,) are the numbers of which the drive shows that they are others. An antenna of which it
        does not is where the file says, unless that is only assumed: then all that is known of it is what the
        drive leaves open.
        """
        mean, sigma, other = before.mean[PLACE], np.zeros(len(PLACE)), corrected.astype(float)
        free = [number for number, is_free in zip(PLACE, corrected.tolist(), strict=True) if is_free]
        mean[corrected], _ = known.given(free, unrefuted(known, before, free), before)
        stated = known.stated_sigma(before, known.misfit)
        sigma[corrected] = stated[free]
        if antenna_assumed:
            for row in np.flatnonzero(~corrected[:2]).tolist():
                mean[row], sigma[row], other[row] = known.mean[PLACE[row]], stated[PLACE[row]], 1.0
        if GNSS_DELAY not in free:
            late_s, sigma[-1] = _delay_shown(known, before, free)
            mean[-1] += late_s
            other[-1] = late_probability(late_s, float(sigma[-1]), float(before.sigma[GNSS_DELAY]))
        return cls(before.mean[PLACE], mean, sigma, other)

    def moments(self, used: Array) -> Array:
        """Second moments (..., 3) of the errors of numbers in use (..., 3), m2 and s2."""
        shown = (self.shown - used) ** 2 + self.sigma**2
        as_before = (self.before - used) ** 2
        return np.asarray(self.probability * shown + (1.0 - self.probability) * as_before)


def unrefuted(known: Knowledge, before: Knowledge, free: Sequence[int]) -> list[int]:
    """The numbers of `CORRELATED`, but for those `free`, that may be as before the drive."""
    near = np.abs(known.mean - before.mean) < REFUTED_SIGMA * known.sigma
    return [i for i in CORRELATED if i not in free and near[i]]


def late_probability(late_s: float, sigma_s: float, prior_s: float) -> float:
    """Probability that fixes come later or earlier than was known to `prior_s` before a drive that shows
    them to be `late_s` +- `sigma_s` later.
    """
    on_time = ON_TIME * prior_s / sigma_s * math.exp(-0.5 * (late_s / sigma_s) ** 2)
    return (1.0 - ON_TIME) / (1.0 - ON_TIME + on_time)


def _delay_shown(known: Knowledge, before: Knowledge, corrected: list[int]) -> tuple[float, float]:
    """How much later than before fixes come if other numbers are as before, and its 1 sigma, s."""
    free = [*corrected, GNSS_DELAY]
    mean, covariance = known.given(free, unrefuted(known, before, free), before)
    slip_s = TIMELY_SIGMA_S * math.sqrt(known.misfit)
    sigma_s = min(math.hypot(math.sqrt(covariance[-1, -1]), slip_s), float(before.sigma[GNSS_DELAY]))
    return float(mean[-1] - before.mean[GNSS_DELAY]), sigma_s
