"""Wheel noise by jittering stamps, counters read out of step with them, or coarse encoders, seen in the
increments.

A counter read a little early or late at the end of one increment is wrong by as much, with the other sign,
at the beginning of the next. With position errors p of variance s^2 an increment has 2 s^2 and the second
difference of increments, p_k - 3 p_{k-1} + 3 p_{k-2} - p_{k-3}, 20 s^2. Speeds of few counts come in pulses
that two increments share: their noise v^2 shows in second differences of every other increment, as 6 v^2.
Taken for motion, such noise looks like slip: of two sensors of a change of speed the one that is believed
too much is scaled down (errors in variables; Fuller 1987, Measurement Error Models, ch. 1).
"""

import dataclasses
import math

import numpy as np

from terrafusion.fusion.graph.wheel_factor import WheelIncrement

MEMORY = 30.0
"""Increments over which the noise is averaged."""
MOST_M, MOST_SIGMA = 0.05, 4.0
"""A second difference beyond both, the latter in its own sigmas, is a jump that the gate judges (assumed)."""
SHARE, PULSE_SHARE = math.sqrt(2.0 / 20.0), math.sqrt(1.0 / 6.0)
"""Sigma of an increment over the root mean square of second differences, of adjacent increments and of every
other one."""


class WheelJitter:
    """Keeps the mean squares of second differences of wheel increments: adjacent ones, and every other."""

    def __init__(self) -> None:
        self._last: list[float] = []
        self._adjacent_m2 = self._pulses_m2 = 0.0

    def applied(self, wheels: WheelIncrement, count_m: float = 0.0) -> WheelIncrement:
        """The increment with at least the sigma along body x that the last ones show.

        `count_m` is the travel of one step of the speeds between two samples: pulses are no larger, and
        what is, is motion.
        """
        self._last = [*self._last[-4:], wheels.distance_m]
        if len(self._last) > 2:
            self._adjacent_m2 = averaged(self._adjacent_m2, *self._last[-3:])
        if len(self._last) == 5:
            self._pulses_m2 = averaged(self._pulses_m2, *self._last[::2])
        pulses_m = min(PULSE_SHARE * math.sqrt(self._pulses_m2), count_m)
        shown_m = max(SHARE * math.sqrt(self._adjacent_m2), pulses_m)
        if shown_m <= wheels.sigma[0]:
            return wheels
        return dataclasses.replace(wheels, sigma=np.array([shown_m, *wheels.sigma[1:]]))


def averaged(square_m2: float, a: float, b: float, c: float) -> float:
    """The mean square with the second difference of `a`, `b`, `c`."""
    most_m = max(MOST_M, MOST_SIGMA * math.sqrt(square_m2))
    return square_m2 + (min(abs(a - 2.0 * b + c), most_m) ** 2 - square_m2) / MEMORY
