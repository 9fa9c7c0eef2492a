"""Which learned numbers correct a sensor: those that the drive clearly shows to be others than before."""

import math

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    GNSS_DELAY,
    IMITATED,
    TURN_SCALE,
    Knowledge,
)
from terrafusion.fusion.calibration.place_belief import PLACE, REFUTED_SIGMA, TIMELY_SIGMA_S, unrefuted

CORRECTED = [TURN_SCALE, ANTENNA_X, ANTENNA_Y, GNSS_DELAY]
"""Numbers that correct a sensor; the others only describe its noise or belong to another state."""
_DELAY = CORRECTED.index(GNSS_DELAY)
_PLACE = [CORRECTED.index(number) for number in PLACE]
LEAST_CORRECTION = np.array([0.008, 0.15, 0.15, 0.1])
"""Corrections below these (turn share, m, m, s) are left to the noise: side-slip and a wandering centre of
rotation look alike (assumed)."""
SLIP_IMITATES = np.array([0.0, 0.0, *IMITATED[[ANTENNA_Y, GNSS_DELAY]]])
"""What wheels that skid make of a drive, for residuals with the variance of their noise and as much again; a
correction is twice that. The place ahead is seen in every turn."""
UNMODELLED_SIGMA = np.array([0.0, 0.03, 0.03, TIMELY_SIGMA_S])
"""1 sigma of what slip adds to these numbers on any ground (turn share, m, m, s; assumed)."""
CLEAR_SIGMA, STILL_CLEAR = np.array([5.0, 5.0, 5.0, 4.0]), 0.5
"""A correction begins where a number differs by so many sigma from what was known, and ends at half of them:
the sigmas hold for rolling wheels and a receiver with white noise and drift, and are too small for others."""
MOST_SPREAD = 0.1
"""Spread of slip beyond which the wheels do not roll, and a skid looks like a delay (assumed)."""
LEAST_LATE_S, LEAST_LATE_TURNING_S, TURNING_RAD, MOST_MISFIT = 0.3, 0.15, 3.0, 10.0
"""Fixes later than the first (wheels that spin look less late), or than the second where the robot turned by
so much, another antenna or another gyro can look like a skid; they explain it if the fixes then lie within
about three of their sigma: a skid leaves a hundred and more (assumed)."""


class CorrectionRule:
    """Decides which of the numbers `CORRECTED` are taken from the drive.

    Attributes:
        before: what was known of the robot before it drove.
        clear: (4,) whether each of `CORRECTED` is taken from the drive now.
    """

    def __init__(self, before: Knowledge, skids: bool) -> None:
        self.before, self.clear = before, np.zeros(len(CORRECTED), dtype=bool)
        self._skids = skids

    @property
    def clear_places(self) -> NDArray[np.bool_]:
        """(3,) the same of the numbers `PLACE`."""
        return self.clear[_PLACE]

    def corrections(self, known: Knowledge) -> Array:
        """The numbers (4,) of `CORRECTED`: as known before, but where the drive clearly shows others.

        At one speed an antenna further ahead and fixes that come earlier look alike: what is shown
        is conditional on those numbers being as before that the drive does not refute.
        """
        off, sigma = known.mean - self.before.mean, known.sigma
        corrected, size = self.before.mean[CORRECTED], np.abs(off[CORRECTED])
        limit = np.where(self.clear, STILL_CLEAR, 1.0) * CLEAR_SIGMA
        limit = limit * np.hypot(sigma[CORRECTED], UNMODELLED_SIGMA)
        least = LEAST_CORRECTION
        if self._skids:
            least = np.maximum(least, 2.0 * math.sqrt(known.misfit - 1.0) * SLIP_IMITATES)
        self.clear = clear = (size > limit) & (size > least) & wheels_roll(known)
        shown = [i for i, is_clear in zip(CORRECTED, clear.tolist(), strict=True) if is_clear]
        corrected[clear], _ = known.given(shown, unrefuted(known, self.before, shown), self.before)
        return corrected

    def uncorrected_delay_s(self, known: Knowledge) -> tuple[float, float] | None:
        """The fixes' delay by the drive, and its 1 sigma, where it is not corrected; else None."""
        if self.clear[_DELAY]:
            return None
        delay_s = known.mean[GNSS_DELAY] - self.before.mean[GNSS_DELAY]
        slip_s = math.sqrt(known.misfit - 1.0) * SLIP_IMITATES[_DELAY] if self._skids else 0.0
        return float(delay_s), math.hypot(float(known.sigma[GNSS_DELAY]), slip_s)

    def explains_skid(self, known: Knowledge, turned_rad: float) -> bool:
        """Whether other numbers of a robot with rolling wheels explain a drive that looks like a skid.

        `turned_rad` is how much the robot turned meanwhile, to either side.
        """
        if known.misfit > MOST_MISFIT or not wheels_roll(known):
            return False
        least = np.maximum(REFUTED_SIGMA * known.sigma[CORRECTED], LEAST_CORRECTION)
        least[_DELAY] = LEAST_LATE_TURNING_S if turned_rad > TURNING_RAD else LEAST_LATE_S
        return bool((np.abs(known.mean - self.before.mean)[CORRECTED] > least).any())


def wheels_roll(known: Knowledge) -> bool:
    """Whether slip scatters no more than that of wheels that roll."""
    return known.slip_spread < MOST_SPREAD
