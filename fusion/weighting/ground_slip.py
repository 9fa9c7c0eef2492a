"""Slip of the grounds that a robot has found by itself, where no model knows its grounds.

The ground memory tells grounds apart by what the robot feels (`grounds.memory`). While fixes are good, each
of them shows its slip. Where a ground is recognised again, in an outage too, its own slip is expected; on
ground that was never met, the slip of the whole drive.
"""

import math
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.grounds.ground import Ground
from terrafusion.fusion.grounds.memory import MOST_GROUNDS
from terrafusion.fusion.weighting.driven_slip import DrivenSlip, SlipPrior

WINDOWS_PER_OBSERVATION = 20.0
"""Estimates of slip are correlated over about 10 s, as receivers drift; windows come twice a second."""
LEAST_STRETCHES = 3.0
"""Stretches from which the slip of a ground on earlier drives counts."""
WITHIN, TIME_S = 0.04, 5.0
"""1 sigma of the slip on one ground during a drive, and how long it lasts: those of sand in the policy."""
BETWEEN_DRIVES = 0.03
"""1 sigma of the mean slip of one ground between drives: weather, load and tyre pressure (assumed)."""
CLEAR = 0.5
"""Share of what a drive has shown in the slip that is expected, from which that is the ground's own."""
STALE = 3.0
"""Sigmas by which the slip of the drive on a ground contradicts the memory, which then is not believed."""


class GroundSlip:
    """Mean and 1 sigma of the slip to expect, by the belief which ground the robot is on.

    Args:
        mean, sigma, per_grade, time_s: of the slip of the whole drive, before it is seen: mean and 1 sigma on
            the level, slope over the grade, correlation time.
        known: the grounds of earlier drives, in the order of the memory.

    Attributes:
        mean, sigma: of the slip on the level, now.
        per_grade: slope of the slip over the grade.
    """

    def __init__(
        self, mean: float, sigma: float, per_grade: float, time_s: float, known: Sequence[Ground] = ()
    ) -> None:
        k = 1 + MOST_GROUNDS
        self._known = {i: g for i, g in enumerate(known, 1) if g.motion.count[0] >= LEAST_STRETCHES}
        self._belief = np.eye(k)[0]
        self.per_grade = per_grade
        self._slip = DrivenSlip(self._prior(mean, sigma, time_s), np.zeros(k))
        self._followed = mean  # the mean that the slip of the robot follows
        self.expect(mean, sigma, time_s)

    def expect(self, mean: float, sigma: float, time_s: float) -> None:
        """Another slip of the whole drive."""
        self._whole = mean, sigma, time_s
        self._slip.prior = self._prior(mean, sigma, time_s)
        self._blend()

    def _prior(self, mean: float, sigma: float, time_s: float) -> SlipPrior:
        """The slip of the whole drive for each ground; on those of earlier drives their own."""
        whole = (mean, sigma, min(WITHIN, sigma), sigma, min(TIME_S, time_s))
        prior = SlipPrior(*(np.full(1 + MOST_GROUNDS, x) for x in whole))
        for i, ground in self._known.items():
            prior.mean[i], prior.between[i] = ground.motion.mean[0], BETWEEN_DRIVES
            prior.sigma[i] = math.hypot(math.sqrt(max(float(ground.motion.square[0]), 0.0)), BETWEEN_DRIVES)
        return prior

    def recognise(self, belief: Array) -> None:
        """Take over the probability (1 + K,) of new ground, then of each known one."""
        self._belief = np.zeros(1 + MOST_GROUNDS)
        self._belief[: len(belief)] = belief
        self._blend()

    def learn(self, slip: float, sigma: float, grade: float, dt_s: float) -> list[int]:
        """Slip with its 1 sigma, as measured for `dt_s` on the ground that the robot is on.

        Returns:
            places in the memory of grounds whose slip on earlier drives it contradicts.
        """
        known = np.append(0.0, self._belief[1:])
        level = slip - self.per_grade * grade
        self._slip.add(known, level, sigma * math.sqrt(WINDOWS_PER_OBSERVATION), 0.0, dt_s)
        stale = [i for i in self._known if self._slip.contradicted(STALE)[i]]
        if stale:
            self.distrust()
        return [i - 1 for i in stale]

    @property
    def remembers(self) -> bool:
        """Whether slip of earlier drives is expected."""
        return bool(self._known)

    def distrust(self) -> None:
        """Expect no slip of earlier drives: other tyres change that of every ground."""
        self._known = {}
        self.expect(*self._whole)

    def clear(self, place: int) -> None:
        """Another ground has taken a place in the memory."""
        self._slip.clear(1 + place)
        if self._known.pop(1 + place, None) is not None:
            self.expect(*self._whole)

    def known(self) -> dict[int, tuple[float, float]]:
        """Slip and its 1 sigma of the grounds that the drive has shown clearly, by place in the memory."""
        means, sigmas = self._slip.posterior()
        clear = np.flatnonzero(self._slip.shares()[1:] > CLEAR).tolist()
        return {i: (float(means[1 + i]), float(sigmas[1 + i])) for i in clear}

    def take_switch(self) -> float:
        """Share of the slip to renew: 0 where it follows the mean that is now expected, 1 where that mean
        is many sigma away.
        """
        apart = (self.mean - self._followed) / self.sigma
        share = -math.expm1(-0.5 * apart * apart)
        self._followed += share * (self.mean - self._followed)
        return share

    def _blend(self) -> None:
        """Moments of the mixture of the grounds."""
        means, sigmas = self._slip.posterior()
        self.mean = float(self._belief @ means)
        self.sigma = math.sqrt(float(self._belief @ (sigmas**2 + (means - self.mean) ** 2)))
