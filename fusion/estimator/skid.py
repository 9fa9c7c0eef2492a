"""Skid detector: GNSS fixes that contradict the wheels inflate the variance of the wheels' displacement.

In a skid, slip and side-slip exceed what the noise of the ground allows within a second. The gate then
rejects good fixes, and after each accepted one the wheels pull the estimate off again. But a robot can have
skidded no further than its wheels rolled and its speed carried it since the last used fix. Rejected fixes
that lie on one side of the estimate and within that reach refute the wheels, not the receiver. The variance
that explains them (a random walk, m2 per second of driving) is kept, and adapted by the innovations of
accepted fixes (Mehra 1972, IEEE T-AC 17(5)). The velocity is wrong, too: its sigma becomes the speed that
leads to the rejected fixes.
"""

import math

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.friction import FrictionEstimator
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import VELOCITY, KeyState
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise

SAME_SIDE = 0.5
"""Least cosine between the offsets of two rejected fixes that lie on one side."""
REACH_SIGMA = 3.0
"""Sigmas of a fix by which it may lie beyond the robot's reach."""
LEAST_M2PS = 1e-4
"""Rate below which a skid is over: a centimetre after a second."""
MEMORY_S = 10.0
"""Time constant of the variance rate while the robot drives and fixes are accepted (assumed: a few turns)."""
FORGOTTEN_S = 20.0
"""Time constant without fixes (assumed: the next ground is another one)."""
SLIDE_S = 1.0
"""Time for which wheels that slipped through an outage err alike afterwards (assumed)."""
UNAIDED_S, NO_SKID_S = 5.0, 30.0
"""Driving without an accepted fix from which the mean rate of the drive holds at least; and the driving
without a skid that the mean begins with (assumed)."""
COARSE_M2 = 1.0
"""Variance of a fix, both axes, above which it shows little of a skid: .7 m each (assumed)."""
LEAST_GAP_S = 0.1
"""Time from the last used fix over which a velocity carries the robot to a rejected one, at least."""
DRIVING_MPS = 0.3
"""Speed, of the robot or its wheels, at which half of the time counts as driven; at rest none does."""

_Passed = tuple[int, WheelIncrement | None, gtsam.NonlinearFactorGraph]


class SkidDetector:
    """Variance of the wheels' displacement in a skid, beyond their noise.

    Attributes:
        friction: friction estimator, where there is one.
        rate_m2ps: variance of the wheels' displacement, each axis, per second of driving.
        refutations: how often rejected fixes refuted the wheels.
        suspicions: how often the drift of accepted fixes did; some by chance, on any ground.
        by_rejection: whether one of them, in the skid under way, was by fixes that the gate rejected.
    """

    def __init__(self, friction: FrictionEstimator | None = None) -> None:
        self.friction = friction
        self.rate_m2ps = 0.0
        self.refutations = self.suspicions = 0
        self.by_rejection = False
        self._before: tuple[float, bool, list[_Passed]] = (0.0, False, [])
        self._driven_s = 0.0
        self._aided_s, self._skidded_m2, self._this_skid_m2 = NO_SKID_S, 0.0, 0.0
        self._before_m = np.zeros(2)
        self._last_ns: int | None = None

    def test_wheels(
        self,
        chain: Chain,
        k: int,
        since_ns: int | None,
        refused: list[Array],
        sigma_m: float,
        noise: SensorNoise,
        rejected: bool = True,
    ) -> bool:
        """Whether rejected fixes, the last at keyframe k, refute the wheels; doubts wheels and velocity then.

        It takes two rejected fixes in a row; one in a skid, where it is larger than its rate explains.

        Args:
            chain: the past before `since_ns` is cut off; its wheel increments from there to k are inflated.
            k: keyframe of the newest rejected fix.
            since_ns: time of the last fix used.
            refused: offsets (2,), m, of the consecutive rejected fixes from the estimate.
            sigma_m: 1 sigma of the newest fix.
            noise: of the ground.
            rejected: False where the gate accepted the fixes, and only the drift of the receiver, as
                estimated, moved by `refused`.
        """
        if since_ns is None or len(refused) < (1 if self.rate_m2ps else 2) or not _on_one_side(refused[-2:]):
            return False
        begin = chain.at_or_after(since_ns)
        begin = chain.first if begin is None else begin
        nodes = [chain.node(i) for i in range(begin + 1, k + 1)]
        if all(node.wheels is None for node in nodes):
            return False
        steps_s = np.diff([chain.node(i).t_ns for i in range(begin, k + 1)]) * 1e-9
        steps = list(zip(steps_s, nodes, strict=True))
        seconds, driven_s = sum(steps_s), sum(dt * driving(n.point, n.wheels, dt) for dt, n in steps)
        off_m, reach_m = float(np.linalg.norm(refused[-1])), _reach_m(nodes, seconds)
        if off_m > reach_m + REACH_SIGMA * sigma_m:
            return False
        skidded_m = min(off_m, reach_m)  # what is beyond reach is the fix's own error
        more_m2ps = max(0.5 * skidded_m**2 / max(driven_s, 1e-9) - self.rate_m2ps, 0.0)
        if len(refused) > 1:
            doubt = np.zeros(chain.dim)
            doubt[VELOCITY][:2] = (skidded_m / max(seconds, LEAST_GAP_S)) ** 2
            chain.restart(doubt, begin)
        elif more_m2ps == 0.0:
            return False
        passed = [(i, n.wheels, n.link) for i, n in enumerate(nodes, begin + 1)]
        self._before = self.rate_m2ps, self.by_rejection, passed
        self.by_rejection |= rejected
        # Over a long outage wheels err in one direction: within a second that is less than a random walk.
        unaided_s = (chain.node(k).t_ns - since_ns) * 1e-9
        share = driven_s * SLIDE_S / unaided_s**2 if unaided_s > UNAIDED_S else 1.0
        self.rate_m2ps += share * more_m2ps
        self.refutations += rejected
        self.suspicions += not rejected
        # Over all of the time: wheels that are locked do not say when a robot stops.
        m2ps = float(more_m2ps * driven_s / max(seconds, 1e-9))
        for i, (dt_s, node) in enumerate(steps, begin + 1):
            if node.wheels is not None:
                inflated = self.friction.inflated_link(chain, i, m2ps, noise) if self.friction else None
                chain.revise(i, wheels=node.wheels.with_extra_variance(m2ps * dt_s), link=inflated)
        chain.smooth(chain.last - begin + 1)
        return True

    def restart(self) -> None:
        """Forget the skid: it was the heading, or the angle of the IMU, that the fixes refuted."""
        self.rate_m2ps, self.by_rejection = 0.0, False
        self._skidded_m2 -= self._this_skid_m2
        self._this_skid_m2 = 0.0
        if self.friction is not None:
            self.friction.restart()

    def undo(self, chain: Chain) -> None:
        """Undo the last refutation: inflated wheels do not lead to the fix either."""
        self.rate_m2ps, self.by_rejection, passed = self._before
        self.refutations -= 1
        for i, wheels, link in passed:
            chain.revise(i, wheels=wheels, link=link)

    def with_extra_variance(self, wheels: WheelIncrement, before: KeyState, dt_s: float) -> WheelIncrement:
        """The increment over `dt_s` with the variance of the skid; unchanged where there is none.

        Without fixes a robot that has skidded now and then will do so again: its mean rate is the least.
        """
        driven_s = dt_s * driving(before, wheels, dt_s)
        self._driven_s += driven_s
        self.rate_m2ps *= math.exp(-driven_s / FORGOTTEN_S)
        usual_m2ps = self._skidded_m2 / self._aided_s if self._driven_s > UNAIDED_S else 0.0
        rate_m2ps = max(self.rate_m2ps, usual_m2ps)
        return wheels.with_extra_variance(rate_m2ps * driven_s) if rate_m2ps else wheels

    def accepted(self, t_ns: int, innovation_m: Array, predicted_m2: Array, fix_m2: float) -> None:
        """Adapt the rate to a fix that is used: `innovation_m` (2,), the variances (2,) predicted for it, and
        its own, the sum of both axes.

        Wheels that are trusted too much leave innovations on one side; the innovations of the right filter
        are white. Coarse fixes say nothing of a rate that adds up to less than their variance.
        """
        before_ns = self._last_ns
        if before_ns is not None and t_ns <= before_ns:
            return
        self._last_ns, driven_s, self._driven_s = t_ns, self._driven_s, 0.0
        if driven_s <= UNAIDED_S:
            self._aided_s += driven_s
            self._skidded_m2 += self.rate_m2ps * driven_s
            self._this_skid_m2 += self.rate_m2ps * driven_s
        before_m, self._before_m = self._before_m, innovation_m
        telling = fix_m2 <= max(2.0 * self.rate_m2ps * MEMORY_S, COARSE_M2)
        if self.rate_m2ps and driven_s > 0.0 and telling:
            more_m2 = 0.5 * min(float(innovation_m @ before_m), float(np.sum(innovation_m**2 - predicted_m2)))
            beyond = more_m2 / driven_s
            rate = self.rate_m2ps + (1.0 - math.exp(-driven_s / MEMORY_S)) * beyond
            self.rate_m2ps = rate if rate > LEAST_M2PS else 0.0
        if not self.rate_m2ps:
            self._this_skid_m2, self.by_rejection = 0.0, False


def driving(before: KeyState, wheels: WheelIncrement | None, dt_s: float) -> float:
    """Share in [0, 1) of a time in which a robot drives: 0 where neither it nor its wheels move."""
    rolled_mps = 0.0 if wheels is None else abs(wheels.distance_m) / dt_s
    square = max(rolled_mps, math.sqrt(before.velocity @ before.velocity)) ** 2
    return square / (square + DRIVING_MPS**2)


def _reach_m(nodes: list[Node], seconds: float) -> float:
    """How far a robot can have skidded up to the keyframes `nodes`: its wheels' distance and its speed's."""
    rolled_m = sum(abs(node.wheels.distance_m) for node in nodes if node.wheels is not None)
    return rolled_m + max(float(np.linalg.norm(node.point.velocity)) for node in nodes) * seconds


def _on_one_side(refused: list[Array]) -> bool:
    """Whether offsets (2,), one or two, point the same way."""
    first, last = refused[0], refused[-1]
    return float(first @ last) >= SAME_SIDE * float(np.linalg.norm(first) * np.linalg.norm(last))
