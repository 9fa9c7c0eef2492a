"""When a quantity of the twin agrees with the study: rules that decide, and say what they decide by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from terrafusion.twin.study.spread import Spread

AGREE, PARTLY, DISAGREE = "agree", "partly", "disagree"
VERDICTS = (AGREE, PARTLY, DISAGREE)

POINTS, SHARE, FACTOR = 1.0, 0.1, 2.0
"""A published mean is met within one point or a tenth of it, and partly within a factor of two."""


class Criterion(Protocol):
    """A rule for one measured quantity."""

    def verdict(self, found: Spread) -> str:
        """One of `VERDICTS`; what could not be measured disagrees."""

    def words(self, unit: str) -> str:
        """The rule in words."""

    def wanted(self, unit: str) -> str:
        """What the study says, short."""


@dataclass(frozen=True)
class Near:
    """The mean lies within `agree` of `target`; within `partly` it agrees in part."""

    target: float
    agree: float
    partly: float

    def verdict(self, found: Spread) -> str:
        return _rank(
            abs(found.mean - self.target) <= self.agree, abs(found.mean - self.target) <= self.partly
        )

    def words(self, unit: str) -> str:
        return f"within {_both(self.agree, self.partly, unit)}"

    def wanted(self, unit: str) -> str:
        return _told(self.target, unit)


@dataclass(frozen=True)
class AtLeast:
    """The mean is at least `agree`; at least `partly` agrees in part."""

    agree: float
    partly: float

    def verdict(self, found: Spread) -> str:
        return _rank(found.mean >= self.agree, found.mean >= self.partly)

    def words(self, unit: str) -> str:
        return f"at least {_both(self.agree, self.partly, unit)}"

    def wanted(self, unit: str) -> str:
        return ""


@dataclass(frozen=True)
class AtMost:
    """The mean is at most `agree`; at most `partly` agrees in part."""

    agree: float
    partly: float

    def verdict(self, found: Spread) -> str:
        return _rank(found.mean <= self.agree, found.mean <= self.partly)

    def words(self, unit: str) -> str:
        return f"at most {_both(self.agree, self.partly, unit)}"

    def wanted(self, unit: str) -> str:
        return ""


@dataclass(frozen=True)
class Published:
    """A mean of the study's Tab. 4, which is one run of each: near the twin's mean, or among its single runs.

    A target inside the range of single runs counts only where chance moves them by more than a point.
    """

    target: float

    def verdict(self, found: Spread) -> str:
        near = abs(found.mean - self.target) <= max(POINTS, SHARE * self.target)
        scattered = found.runs > 1 and found.high - found.low > POINTS
        among = scattered and found.low <= self.target <= found.high
        ratio = found.mean / self.target
        return _rank(near or among, 1.0 / FACTOR <= ratio <= FACTOR)

    def words(self, unit: str) -> str:
        return f"±{POINTS:g} point or ±{100 * SHARE:g} %, or among single runs (partly: factor {FACTOR:g})"

    def wanted(self, unit: str) -> str:
        return _told(self.target, unit)


def _rank(agrees: bool, partly: bool) -> str:
    return AGREE if agrees else PARTLY if partly else DISAGREE


def _both(agree: float, partly: float, unit: str) -> str:
    return _told(agree, unit) + (f" (partly: {_told(partly, unit)})" if partly != agree else "")


def _told(value: float, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()
