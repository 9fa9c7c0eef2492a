"""One ground as one robot knows it: its signature, and what it does to wheels, heading and path."""

import dataclasses
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.grounds.signature import SIGNATURE

SPREAD = np.array([0.15] * 7 + [0.05, 0.5, 0.2, 0.03])
"""Spread on one ground of the mean signature of 4 s, before any is known (learn runs of
tests/studies/ground_split.yaml; that of slip is assumed)."""
WINDOW_VARIANCE = 4.0
"""Variance of single windows about that mean, in its own (learn runs)."""
SPREAD_WINDOWS = 40.0
"""Windows that `SPREAD` counts for."""
MOST_WINDOWS = 2000.0
"""Windows and stretches that are remembered: an older one fades, so that a ground may change."""
FREEDOM = 8.0
"""Degrees of freedom of Student's t for signatures: some are outliers (kerbs, stones)."""
FRICTION_MPS2 = np.array([0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6])
"""Friction limits of the bank (`estimator.friction`): mu g from ice to dry ground."""
FRICTION_MODELS = len(FRICTION_MPS2) + 1
"""These and, last, rolling."""
SLIPPERY_MODELS = 6
"""The first ones: limits of ice, wet and snowy ground, up to 2 m/s2."""
MOST_SLIP = 1.0
"""Largest slip or side-slip of a stretch that is learned."""


@dataclass(frozen=True, eq=False)
class Tally:
    """Count, mean and mean square deviation of a number (or of several, (d,)), weighted.

    Older entries fade beyond `MOST_WINDOWS`.
    """

    count: Array
    mean: Array
    square: Array

    @classmethod
    def empty(cls, size: int) -> "Tally":
        """Of `size` numbers, none seen yet."""
        return cls(np.zeros(size), np.zeros(size), np.zeros(size))

    def plus(self, values: Array, weight: float = 1.0, noise: float = 0.0) -> "Tally":
        """With one more entry (d,); NaN is skipped. `noise` is the variance of its measurement."""
        seen = np.isfinite(values)
        count = np.minimum(self.count, MOST_WINDOWS) + weight * seen
        gain = np.where(seen, weight, 0.0) / np.maximum(count, 1e-12)
        off = np.where(seen, values, self.mean) - self.mean
        square = (1.0 - gain) * (self.square + gain * off**2) - gain * noise
        return Tally(count, self.mean + gain * off, np.where(seen, square, self.square))

    def merged(self, other: "Tally") -> "Tally":
        """Of both together."""
        count = self.count + other.count
        share = np.where(count > 0.0, other.count / np.maximum(count, 1e-12), 0.0)
        off = other.mean - self.mean
        square = (1.0 - share) * self.square + share * other.square + share * (1.0 - share) * off**2
        return Tally(count, self.mean + share * off, square)


@dataclass(frozen=True, eq=False)
class Ground:
    """A ground of one robot, or of robots of one type.

    Attributes:
        name: given by its user, else "ground 1" and so on.
        signature: of `SIGNATURE`, by windows of half a second.
        motion: slip and side-slip (2,), by stretches of several metres with good fixes.
        friction: (10,) probabilities of the friction limits of `estimator.friction` and of rolling.
        friction_windows: windows that gave them.
        first, last: dates (YYYY-MM-DD) of the first and the last drive on it, "" where not known.
        origin: mark of the windows by which it was found; "" where not known.
    """

    name: str
    signature: Tally
    motion: Tally
    friction: Array
    friction_windows: float = 0.0
    first: str = ""
    last: str = ""
    origin: str = ""

    @classmethod
    def new(cls, name: str, origin: str = "") -> "Ground":
        """Nothing is known of it."""
        even = np.full(FRICTION_MODELS, 1.0 / FRICTION_MODELS)
        return cls(name, Tally.empty(len(SIGNATURE)), Tally.empty(2), even, origin=origin)

    @property
    def windows(self) -> float:
        """Windows on this ground."""
        return float(self.signature.count.max())

    def variance(self) -> Array:
        """(11,) of a window's signature, shrunk to `SPREAD`."""
        n = self.signature.count
        known = np.maximum(self.signature.square, 0.0)
        return np.asarray((SPREAD_WINDOWS * SPREAD**2 + n * known) / (SPREAD_WINDOWS + n))

    def log_likelihood(self, signature: Array, wider: float = 1.0) -> float:
        """Of a mean signature by Student's t, its variance `wider` times that of 4 s.

        Numbers that ground or signature lack say nothing.
        """
        n = self.signature.count
        variance = self.variance() * (wider + 1.0 / np.maximum(n, 1.0))
        return student_t(signature, self.signature.mean, variance, n > 0.0)

    def seen(self, signature: Array, weight: float, date: str) -> "Ground":
        """With one more window."""
        first = self.first or date
        return dataclasses.replace(
            self, signature=self.signature.plus(signature, weight), first=first, last=date or self.last
        )

    def with_friction(self, friction: Array, weight: float) -> "Ground":
        """With friction probabilities (10,) of one more window."""
        n = min(self.friction_windows, MOST_WINDOWS) + weight
        mean = self.friction + weight / n * (friction - self.friction)
        return dataclasses.replace(self, friction=mean, friction_windows=n)

    def without_slip(self) -> "Ground":
        """As it feels, without what it does to the wheels."""
        count = np.where(np.array(SIGNATURE) == "slip", 0.0, self.signature.count)
        signature = dataclasses.replace(self.signature, count=count)
        return dataclasses.replace(self, signature=signature, motion=Tally.empty(2))

    def same_as(self, other: "Ground") -> bool:
        """Whether both are one ground at different times, or hold the same numbers, by whatever name."""
        mine, others = (
            [*vars(g.signature).values(), *vars(g.motion).values(), g.friction] for g in (self, other)
        )
        return (self.origin == other.origin != "") or all(map(np.array_equal, mine, others))

    def merged(self, other: "Ground") -> "Ground":
        """This ground with what `other` knows of the same one."""
        windows = self.friction_windows + other.friction_windows
        share = other.friction_windows / windows if windows else 0.0
        named = self.name if is_given(self.name) else other.name
        dates = [d for d in (self.first, other.first, self.last, other.last) if d]
        return Ground(
            named if is_given(named) else self.name,
            self.signature.merged(other.signature),
            self.motion.merged(other.motion),
            (1.0 - share) * self.friction + share * other.friction,
            windows,
            min(dates, default=""),
            max(dates, default=""),
            self.origin or other.origin,
        )


def is_given(name: str) -> bool:
    """Whether a user gave a name: a ground that was found is "ground" and a number."""
    return re.fullmatch(r"ground \d+", name) is None


def student_t(values: Array, mean: Array, variance: Array, known: NDArray[np.bool_]) -> float:
    """Log density of independent Student's t with `FREEDOM`, up to a constant, where `known` and finite."""
    seen = known & np.isfinite(values)
    square = (values[seen] - mean[seen]) ** 2 / variance[seen]
    return float(np.sum(-0.5 * (FREEDOM + 1.0) * np.log1p(square / FREEDOM) - 0.5 * np.log(variance[seen])))
