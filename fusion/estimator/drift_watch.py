"""Tests whether the estimated GNSS drift moves faster than a receiver drifts: then the wheels skid.

Fixes of a stand-alone receiver are too coarse for the gate to reject them in a skid. The error of the
wheels goes into the drift state and stays there for a minute or more. In a consistent filter the estimate
of a Gauss-Markov state d with sigma s and time constant T moves in the time t by

    d(t) - a d(0) ,  a = exp(-t / T) ,  covariance  a^2 P(0) + s^2 (1 - a^2) - P(t) ,

with P its covariance (increments of a conditional mean; Gelb 1974, Applied Optimal Estimation, ch. 4.2).

A receiver that reports less than its data sheet may drift as its report or as the sheet says. So s is
learned: s^2 begins at the sheet's and is scaled by the squares of longer moves over those expected, with
falling gain (Robbins and Monro 1951, Ann. Math. Stat. 22(3)).
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import gammaincinv

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import DRIFT
from terrafusion.fusion.noise.policy import SensorNoise

WINDOW_S = 5.0
"""Over which a move is judged: a skid lasts a second or two, the smoothing window is as long (assumed)."""
SPACING_S = 0.75
"""Least time between estimates that are compared: each is another chance of a false alarm, and `LIMIT` is for
one a second. A receiver at 1 Hz may be a little early."""
LIMIT = 2.0 * float(gammaincinv(1.0, 0.95))
"""Of the normalised square: 95 % of chi-square with two degrees of freedom. The covariance taken is an upper
bound: beside wheels that lose .1 m/sqrt(s) a receiver passes it in one of ten drives of two minutes, at 5 Hz
in one of five. The wheels then count less for some seconds."""
MOST_YAW_RAD = 0.15
"""Sigma of the heading beyond which it, not the wheels, may have led astray (assumed)."""
LEAST_SHARE = 0.5
"""Share of the drift state from which fixes show it: those of RTK do not."""


LEARNED_S = 10.0
"""Time over which moves determine sigma (assumed: much longer than white errors last)."""
PRIOR_MOVES, MOST_MOVES = 3.0, 30.0
"""Moves for which the data sheet counts, and those that are remembered (assumed)."""
LARGEST_MOVE = 4.0
"""Ratio of a move's square to the expected one from which it counts no more: a skid (assumed)."""
TELLING = 0.1
"""Least share of a move that the estimate can show."""


@dataclass(frozen=True)
class DriftEstimate:
    """An estimate of the drift; `variance_m2`: mean of both axes."""

    t_ns: int
    east_m: float
    north_m: float
    variance_m2: float


@dataclass
class DriftWatch:
    """Estimates of the drift, and the sigma learned from them.

    Attributes:
        sigma_m, time_s: of the drift's Gauss-Markov process; sigma as learned.
        fresh: fixes that show the drift came into the graph since the last test.
        seen: the last estimates.
        sheet_m: sigma by the data sheet, the largest.
        _reference: estimate from which the next move is learned.
    """

    sigma_m: float
    time_s: float
    fresh: bool = False
    seen: list[DriftEstimate] = field(default_factory=list)
    sheet_m: float = field(init=False)
    _reference: DriftEstimate | None = None
    _moves: float = 0.0

    def __post_init__(self) -> None:
        self.sheet_m = self.sigma_m

    @property
    def process(self) -> tuple[float, float]:
        """1 sigma, m, each axis, and correlation time, s."""
        return self.sigma_m, self.time_s

    def _move(self, before: DriftEstimate, now: DriftEstimate) -> tuple[tuple[float, float], float, float]:
        """A move east and north, m, the variance of it that a consistent filter has, and that of the drift
        itself, m2 an axis.
        """
        kept = math.exp(-(now.t_ns - before.t_ns) * 1e-9 / self.time_s)
        new_m2 = self.sigma_m**2 * (1.0 - kept**2)
        moved_m = now.east_m - kept * before.east_m, now.north_m - kept * before.north_m
        return moved_m, kept**2 * before.variance_m2 + new_m2 - now.variance_m2, new_m2

    def learn(self, now: DriftEstimate, least_m: float) -> None:
        """Follow the moves of the drift, with sigma between `least_m` and the data sheet's."""
        if self._reference is not None:
            if now.t_ns - self._reference.t_ns < LEARNED_S * 1e9:
                return
            (x_m, y_m), expected_m2, new_m2 = self._move(self._reference, now)
            if expected_m2 > TELLING * new_m2:
                square = (x_m**2 + y_m**2) / (2.0 * expected_m2)
                self._moves = min(self._moves + 1.0, MOST_MOVES)
                gain = 1.0 / (PRIOR_MOVES + self._moves)
                sigma_m = self.sigma_m * math.sqrt(1.0 + gain * (min(square, LARGEST_MOVE) - 1.0))
                self.sigma_m = min(max(sigma_m, least_m), self.sheet_m)
        self._reference = now

    def test_wheels(
        self, chain: Chain, skid: SkidDetector, sigma_m: float, noise: SensorNoise, least_m: float
    ) -> None:
        """Refute the wheels where the drift moved too far. `sigma_m` is that of a fix, `least_m` the drift's
        by what the fixes report."""
        if not self.fresh:
            return
        P = chain.covariance_at(chain.last)
        east_m, north_m = chain.state(chain.last).of(DRIFT).tolist()
        now = DriftEstimate(chain.nodes[-1].t_ns, east_m, north_m, 0.5 * float(np.trace(P[DRIFT, DRIFT])))
        self.learn(now, least_m)
        moved = self.moved_too_far(now)
        if moved is None or P[2, 2] > MOST_YAW_RAD**2:
            return
        since_ns, moved_m = moved
        if skid.test_wheels(chain, chain.last, since_ns, [moved_m, moved_m], sigma_m, noise, rejected=False):
            self.restart()

    def moved_too_far(self, now: DriftEstimate) -> tuple[int, Array] | None:
        """Take an estimate in; since when and how far, (2,) m, it moved faster than a receiver drifts.

        None where it did not.
        """
        self.seen = [one for one in self.seen if 0 < now.t_ns - one.t_ns <= WINDOW_S * 1e9]
        if self.seen and now.t_ns - self.seen[-1].t_ns < SPACING_S * 1e9:
            return None
        found = None
        for before in self.seen:
            (x_m, y_m), expected_m2, new_m2 = self._move(before, now)
            if x_m**2 + y_m**2 > LIMIT * max(expected_m2, new_m2):
                found = before.t_ns, np.array([x_m, y_m])
                break
        self.seen.append(now)
        return found

    def restart(self) -> None:
        """Forget what was seen: the drift state is new."""
        self.seen.clear()
        self._reference = None
