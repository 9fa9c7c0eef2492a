"""Fixes that jump as no robot moves: held off until they come back, or have traced the path for long.

A receiver with a wrong ambiguity shows the robot's motion, from another place. The robot cannot have gone
there: to cover the step between two fixes, and to move before and after it as the fixes themselves say, takes
an acceleration that no ground gives. A skid needs time: it grows while the robot drives.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

from terrafusion.fusion.estimator.dead_reckoning import FixPair

MOST_MPS2 = 10.0
"""Acceleration of a robot that skids or is pushed, at most (assumed: a friction of 1)."""
STAMP_S = 0.05
"""By which stamps of fixes may be wrong from one to the next (assumed)."""
JUMP_SIGMA, LEAST_M = 6.0, 0.1
"""Sigmas of both fixes, and distance, that a jump exceeds."""
SKID_SIGMA, SKID_LEAST_M = 3.0, 0.5
"""The same, by white errors alone, of one that exceeds what the robot can have skidded meanwhile."""
CONSTANT, SAME_PLACE = 0.2, 0.5
"""Shares of the jump by which offsets after it may differ, and up to which a fix continues them."""
BETTER = 0.5
"""Share of the sigma before: fixes as much better are believed whatever was before."""
USED = 2
"""Fixes before a jump, and rejected ones after it, that show the motion."""
LONGEST_S = 3.0
"""Between two of those fixes: later, the robot may have gone anywhere."""


@dataclass(frozen=True)
class FixJump:
    """A jump of the fixes: `offset_m` (east + i north) from the path, `heading` from path to map, and whether
    it is `impossible` for a robot; if not, the wheels may have skidded for once.
    """

    offset_m: complex
    heading: complex
    impossible: bool

    @classmethod
    def of(
        cls, before: list[FixPair], after: list[FixPair], heading: complex, scale: float, white: float
    ) -> Self | None:
        """The jump between used and rejected fixes; None where the offsets are small, or grow as in a skid.

        Sigmas are taken times `scale`; `white` is the share of their squares that is white.
        """
        if len(before) < USED or len(after) < USED:
            return None
        a, b, c, d = before[-2], before[-1], after[0], after[-1]
        led_s, step_s, then_s = ((y.t_ns - x.t_ns) * 1e-9 for x, y in ((a, b), (b, c), (c, d)))
        if not (0.0 < led_s <= LONGEST_S and 0.0 < step_s <= LONGEST_S and then_s > 0.0):
            return None
        sigma_m = scale * math.hypot(b.sigma_m, c.sigma_m)
        offset_m = residual_m(b, c, heading)
        no_skid = exceeds_skid(before, after, heading, scale * math.sqrt(white))
        large = no_skid or abs(offset_m) > max(JUMP_SIGMA * sigma_m, LEAST_M)
        if c.sigma_m < BETTER * b.sigma_m or not large:
            return None
        grown_m = max(abs(residual_m(c, one, heading)) for one in after)
        if grown_m > CONSTANT * abs(offset_m) + sigma_m:
            return None
        first, last = (b.fix - a.fix) / led_s, (d.fix - c.fix) / then_s
        beyond_m = abs((c.fix - b.fix) - 0.5 * (first + last) * step_s)
        noise_m = sigma_m * (1.0 + 0.5 * step_s * (1.0 / led_s + 1.0 / then_s))
        stamps_m = STAMP_S * max(abs(first), abs(last))
        # Speed up for half of the time and down for the other, beyond the mean of both speeds.
        most_m = 0.25 * MOST_MPS2 * step_s**2 + stamps_m + 3.0 * noise_m
        return cls(offset_m, heading, no_skid or beyond_m > most_m)

    def continued(self, last: FixPair, pair: FixPair) -> bool:
        """Whether a fix follows the `last` one held off along the path, rather than the place before."""
        near_m = SAME_PLACE * abs(self.offset_m) + math.hypot(last.sigma_m, pair.sigma_m)
        off_m = residual_m(last, pair, self.heading)
        return abs(off_m) < min(near_m, abs(off_m + self.offset_m))

    def leads_back(self, used: Iterable[FixPair], after: FixPair) -> bool:
        """Whether most fixes used before it lie on the path that the jump, with its first fix, leads to.

        Then it is the end of an error that came in unnoticed.
        """
        offs_m = [residual_m(one, after, self.heading) for one in used]
        back = sum(abs(off_m) < abs(off_m - self.offset_m) for off_m in offs_m)
        return 2 * back > len(offs_m)


def exceeds_skid(before: list[FixPair], after: list[FixPair], heading: complex, scale: float) -> bool:
    """Whether fixes before and after a jump lie further apart than a robot can have skidded between them.

    Its wheels roll for nothing, at most, while the speed it had is turned round. White errors are `scale`
    times the fixes' sigmas.
    """
    a, b, c = before[-2], before[-1], after[0]
    speed_mps = abs(b.z - a.z) / (b.t_ns - a.t_ns) * 1e9
    skidded_m = abs(c.z - b.z) + speed_mps * (c.t_ns - b.t_ns) * 1e-9
    sides = [(sum(residual_m(b, one, heading) for one in side) / len(side), side) for side in (before, after)]
    variances_m2 = [scale**2 * max(one.sigma_m for one in side) ** 2 / len(side) for _, side in sides]
    least_m = skidded_m + SKID_SIGMA * math.sqrt(sum(variances_m2))
    return abs(sides[1][0] - sides[0][0]) > max(least_m, SKID_LEAST_M)


def residual_m(one: FixPair, other: FixPair, heading: complex) -> complex:
    """What the dead-reckoned path leaves of the displacement between two fixes."""
    return (other.fix - one.fix) - heading * (other.z - one.z)
