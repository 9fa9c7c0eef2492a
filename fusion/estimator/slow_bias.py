"""A measurement with a slow bias that is no state of the graph.

z = s + H b + noise, where s is a number of the newest keyframe (its height, its heading) and b (n,) a bias
that outlives every keyframe. Given to the graph as a measurement of s with the uncertainty of b in its
noise, a hundred of them would count as independent. Here b, its covariance P and its covariance c with the
error of s are carried beside the graph (Schmidt 1966; Groves 2013, Principles of GNSS, ch. 3.4.5). From
the joint update with

    S = P_s + 2 H c + H P H' + R,    a = P_s + H c,    K_s = a / S,    K_b = (P H' + c) / S

the graph gets the independent measurement of s with the same effect on s and its variance:

    R* = P_s^2 S / a^2 - P_s >= 0,    innovation* = innovation P_s / a.

Other measurements of s shrink its error and c alike (`state_updated`) and leave b as it is, as Schmidt's
filter does; motion adds to P_s alone.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.inputs.sample_stream import MOST_WAITING

T = TypeVar("T")

LEAST_GAIN = 0.03
"""Least a / P_s: below, the measurement says almost nothing of s and only updates the bias."""

MOST_AHEAD_NS = 10_000_000_000
"""A sample stamped further ahead of the newest IMU sample has another clock; one less far waits."""


def split_by_time(
    samples: Iterable[tuple[int, T]], t_ns: int, newest_ns: int
) -> tuple[list[tuple[int, T]], deque[tuple[int, T]], int]:
    """Samples (time, value) up to `t_ns`, those to wait for, and how many have an impossible time.

    `newest_ns` is the time of the newest IMU sample.
    """
    due, waiting, count = [], deque[tuple[int, T]](), 0
    for sample in samples:
        count += 1
        if sample[0] <= t_ns:
            due.append(sample)
        elif sample[0] <= max(t_ns, newest_ns) + MOST_AHEAD_NS:
            waiting.append(sample)
    return due, waiting, count - len(due) - len(waiting)


@dataclass(frozen=True)
class Independent:
    """What a biased measurement says of s alone: innovation and its 1 sigma."""

    innovation: float
    sigma: float


@dataclass(eq=False)
class SlowBias:
    """Bias (n,), its covariance (n, n), and its covariance (n,) with the error of s."""

    mean: Array
    covariance: Array
    cross: Array

    @classmethod
    def of(cls, mean: Array, sigma: Array) -> Self:
        """A bias of which only the prior (n,) is known."""
        return cls(mean.astype(float), np.diag(np.square(sigma.astype(float))), np.zeros(len(mean)))

    def drift(self, variance: Array) -> None:
        """Random walk of the bias by this variance (n,)."""
        self.covariance = self.covariance + np.diag(variance)

    def forget(self, variance: Array) -> None:
        """The bias has jumped: uncertain by `variance` (n,) more, and uncorrelated with s."""
        self.drift(variance)
        self.cross = np.zeros(len(self.mean))

    def state_updated(self, before: float, after: float) -> None:
        """Other measurements have changed the variance of s from `before` to `after`.

        New linearisations change the variance, too, by parts in a thousand: the joint covariance is kept
        positive.
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
        """Update the bias by the innovation z - s - H b; gives what it says of s alone, None where almost
        nothing.
        """
        S = self.variance(H, state, noise)
        a = state + float(H @ self.cross)
        gain = (self.covariance @ H + self.cross) / S
        self.mean = self.mean + gain * innovation
        covariance = self.covariance - S * np.outer(gain, gain)
        self.covariance = 0.5 * (covariance + covariance.T)
        self.cross = self.cross - gain * a
        if a <= LEAST_GAIN * state:
            return None
        own = max(state * state * S / (a * a) - state, 1e-6 * state)
        return Independent(innovation * state / a, float(np.sqrt(own)))


class BiasedSensor(ABC, Generic[T]):
    """Samples (time, value) of a sensor with a slow bias, and the gate of its measurements.

    A measurement is used up to `GATE_SIGMA`; after `PATIENCE` rejected in a row the bias has jumped.
    """

    SENSOR, GATE_SIGMA, PATIENCE = "", math.inf, 1

    def __init__(self, report: Callable[[Innovation], None]) -> None:
        self.used = self.refused = 0
        self._samples: deque[tuple[int, T]] = deque()
        self._refused_in_a_row = 0
        self._on_innovation = report

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a time."""
        self._samples = deque(sample for sample in self._samples if sample[0] >= before_ns)

    def _hold(self, t_ns: int, value: T) -> None:
        """Hold a sample until a keyframe has passed it."""
        self._samples.append((t_ns, value))
        if len(self._samples) > MOST_WAITING:
            self._samples.popleft()

    def _due(self, t_ns: int, newest_ns: int, most_age_ns: int) -> list[tuple[int, T]]:
        """Take the samples up to `t_ns`, and give those that are not too old."""
        due, self._samples, impossible = split_by_time(self._samples, t_ns, newest_ns)
        self.refused += impossible
        return [sample for sample in due if t_ns - sample[0] <= most_age_ns]

    def _gated(
        self, bias: SlowBias, t_ns: int, innovation: float, H: Array, state: float, noise: float
    ) -> Independent | None:
        """What a measurement says of s alone; None where it is rejected or says almost nothing."""
        nis = innovation**2 / bias.variance(H, state, noise)
        accepted = nis <= self.GATE_SIGMA**2
        self._on_innovation(Innovation(t_ns, self.SENSOR, np.array([innovation]), nis, 1, accepted))
        if not accepted:
            self._refuse()
            return None
        self._refused_in_a_row = 0
        self.used += 1
        return bias.measure(innovation, H, state, noise)

    def _refuse(self) -> None:
        self.refused += 1
        self._refused_in_a_row += 1
        if self._refused_in_a_row >= self.PATIENCE:
            self._refused_in_a_row = 0
            self._has_jumped()

    @abstractmethod
    def _has_jumped(self) -> None:
        """Forget the bias."""
