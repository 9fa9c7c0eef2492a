"""Wheel noise by jittering stamps, or counters read out of step with them, seen in the increments.

A counter read a little early or late at the end of one increment is wrong by as much, with the other sign,
at the beginning of the next. With position errors p of variance s^2 an increment has 2 s^2 and the second
difference of increments, p_k - 3 p_{k-1} + 3 p_{k-2} - p_{k-3}, 20 s^2. Taken for motion, such noise looks
like slip: of two sensors of a change of speed the one that is believed too much is scaled down (errors in
variables; Fuller 1987, Measurement Error Models, ch. 1).
"""

import dataclasses
import math

import numpy as np

from terrafusion.fusion.graph.wheel_factor import WheelIncrement

MEMORY = 30.0
"""Increments over which the noise is averaged."""
MOST_M, MOST_SIGMA = 0.05, 4.0
"""A second difference beyond both, the latter in its own sigmas, is a jump that the gate judges (assumed)."""
SHARE = math.sqrt(2.0 / 20.0)
"""Sigma of an increment over the root mean square of the second differences."""


class WheelJitter:
    """Keeps the mean square of the second differences of wheel increments."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._square_m2 = 0.0

    def applied(self, wheels: WheelIncrement) -> WheelIncrement:
        """The increment with at least the sigma along body x that the last ones show."""
        self._last = [*self._last[-2:], wheels.distance_m]
        if len(self._last) == 3:
            a, b, c = self._last
            most_m = max(MOST_M, MOST_SIGMA * math.sqrt(self._square_m2))
            bend_m = min(abs(a - 2.0 * b + c), most_m)
            self._square_m2 += (bend_m**2 - self._square_m2) / MEMORY
        shown_m = SHARE * math.sqrt(self._square_m2)
        if shown_m <= wheels.sigma[0]:
            return wheels
        return dataclasses.replace(wheels, sigma=np.array([shown_m, *wheels.sigma[1:]]))
