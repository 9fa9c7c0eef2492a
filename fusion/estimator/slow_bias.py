"""A measurement with a slow bias that is no state of the graph.

z = s + H b + noise, where s is a number of the newest keyframe (its height, its heading) and b (n,) a bias
that outlives every keyframe. Were each z given to the graph as a measurement of s with the uncertainty
of b added to its noise, a hundred of them would be taken for a hundred independent opinions. Here b, its
covariance P and its covariance c with the error of s are carried beside the graph (Schmidt 1966;
Groves 2013, Principles of GNSS, ch. 3.4.5). From the joint update with

    S = P_s + 2 H c + H P H' + R,    a = P_s + H c,    K_s = a / S,    K_b = (P H' + c) / S

the graph gets the independent measurement of s that moves it just so far, and makes it just so sure:

    R* = P_s^2 S / a^2 - P_s >= 0,    innovation* = innovation P_s / a.

Other measurements of s shrink its error and c alike (`told`; b itself is left as it is, as Schmidt's
filter leaves parameters it only considers); motion adds to P_s alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
T = TypeVar("T")

LEAST_SHARE = 0.03
"""Below this a / P_s the measurement tells next to nothing new of s: it only teaches the bias."""

AHEAD_NS = 10_000_000_000
"""A sample stamped so far ahead of the newest IMU sample has a clock of its own; one less far waits."""


def split(
    samples: Iterable[tuple[int, T]], t_ns: int, newest_ns: int
) -> tuple[list[tuple[int, T]], deque[tuple[int, T]], int]:
    """Samples (time, value) up to `t_ns`, those to wait for, and how many have an impossible time.

    `newest_ns` is how far the IMU has come: an estimate that has just started is behind by its wait.
    """
    due, waiting, count = [], deque[tuple[int, T]](), 0
    for sample in samples:
        count += 1
        if sample[0] <= t_ns:
            due.append(sample)
        elif sample[0] <= max(t_ns, newest_ns) + AHEAD_NS:
            waiting.append(sample)
    return due, waiting, count - len(due) - len(waiting)


@dataclass(frozen=True)
class Independent:
    """What a biased measurement tells of s alone: innovation and its 1 sigma."""

    innovation: float
    sigma: float


@dataclass(eq=False)
class SlowBias:
    """Bias (n,), its covariance (n, n), and its covariance (n,) with the error of s."""

    mean: Array
    covariance: Array
    cross: Array

    @classmethod
    def of(cls, mean: Array, sigma: Array) -> SlowBias:
        """A bias that nothing but its prior (n,) is known of."""
        return cls(mean.astype(float), np.diag(np.square(sigma.astype(float))), np.zeros(len(mean)))

    def drift(self, variance: Array) -> None:
        """The bias has moved by random steps of this variance (n,)."""
        self.covariance = self.covariance + np.diag(variance)

    def forget(self, variance: Array) -> None:
        """The bias is another one: less sure by `variance` (n,), and no longer tied to s."""
        self.drift(variance)
        self.cross = np.zeros(len(self.mean))

    def told(self, before: float, after: float) -> None:
        """Others have told of s: its variance was `before` and is `after`.

        New linearisations move the variance, too, by parts in a thousand: what would then be no joint
        covariance any more is brought back to one.
        """
        if after < before:
            self.cross = self.cross * (after / before)
        P = self.covariance + np.diag(1e-12 * np.diag(self.covariance) + 1e-40)
        needed = float(self.cross @ np.linalg.solve(P, self.cross))
        if needed > after:
            self.cross = self.cross * float(np.sqrt(after / needed))

    def variance(self, H: Array, state: float, noise: float) -> float:
        """Variance S of an innovation, for the variances of s and of the noise."""
        return float(state + 2.0 * H @ self.cross + H @ self.covariance @ H + noise)

    def measure(self, innovation: float, H: Array, state: float, noise: float) -> Independent | None:
        """Take z - s - H b into the bias; gives what it tells of s alone, None where that is nothing."""
        S = self.variance(H, state, noise)
        a = state + float(H @ self.cross)
        gain = (self.covariance @ H + self.cross) / S
        self.mean = self.mean + gain * innovation
        covariance = self.covariance - S * np.outer(gain, gain)
        self.covariance = 0.5 * (covariance + covariance.T)
        self.cross = self.cross - gain * a
        if a <= LEAST_SHARE * state:
            return None
        own = max(state * state * S / (a * a) - state, 1e-6 * state)
        return Independent(innovation * state / a, float(np.sqrt(own)))
