"""Dead reckoning beside the filter: an independent check of heading and of the receiver's reported sigma.

The filter is slow to see that its own heading was wrong or that a receiver is optimistic. Wheels and gyro
alone trace the shape of the path; aligned with the fixes of the last half minute it shows the heading
error and the scatter of the fixes, independently of the filter.
"""

from __future__ import annotations

import bisect
import cmath
import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.planar_alignment import planar_rotation
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import yaw_of
from terrafusion.fusion.inputs.validation import GnssFix

KEPT_S = 30.0
SCATTER_FIXES, LEAST_FIXES = 21, 8
"""Fixes over which the scatter is taken, and the fewest that show it."""
RAYLEIGH_MEDIAN = 2.0 * float(np.log(2.0))
"""Median of x^2 + y^2 where x and y have variance 1 (chi-square of two)."""
LEAST_DIFFERENCES, MOST_DIFFERENCES = 8.0, 300.0
"""Second differences from which the white share is known, and how many are remembered (assumed)."""
CENSORED = 3.0
"""Squared second differences over their expectation are censored here (assumed)."""
MARGIN, TOP_MPS = 1.2, 2.0
"""Driven over wheel distance, at most (tyre radius, a skid), and least top speed of a robot whose wheels are
unknown for a time (assumed)."""
SLIP_CHANGE = 0.1
"""Change of slip from fix to fix, which bends the dead-reckoned path (assumed)."""
LEAST_RATIO, MOST_RATIO = 0.3, 1.7
"""Range of driven over dead-reckoned distance in which a path shows the heading."""
TURN_SIGMA_RAD = 0.15
LEAST_TURN_RAD = 0.35
MOST_JERK_MPS3, SMOOTH_SIGMA = 10.0, 3.0
"""A wheeled robot changes its acceleration by at most 2 m/s2 in 0.2 s (assumed)."""
CONFIRMED = 3
"""Consecutive fixes that must show the same heading error."""


@dataclass(frozen=True)
class PathFit:
    """The dead-reckoned path aligned with the fixes.

    Attributes:
        turn: from the path to the fixes; its size is driven over dead-reckoned distance.
        sigma_rad: 1 sigma of its angle.
        middle, fix_middle: means of path and fixes, which are laid onto each other.
        residual_m: median distance that is left.
    """

    turn: complex
    sigma_rad: float
    middle: complex
    fix_middle: complex
    residual_m: float

    def at(self, z: complex) -> complex:
        """A point of the path on the map."""
        return self.fix_middle + self.turn * (z - self.middle)


@dataclass(eq=False)
class FixPair:
    """A fix (east + i north, m), its reported sigma, and the dead-reckoned antenna `z` (m) then.

    `reach_m`: how far the robot can have driven in all by then; `usable`: the fix may show the heading;
    `alone`: it can be reached neither from the path nor from a fix refused before.
    """

    t_ns: int
    z: complex
    fix: complex
    sigma_m: float
    reach_m: float = 0.0
    usable: bool = True
    alone: bool = False


@dataclass(frozen=True, eq=False)
class _Columns:
    """Pairs as arrays (n,)."""

    t_ns: NDArray[np.int64]
    z: NDArray[np.complex128]
    fix: NDArray[np.complex128]
    sigma_m: Array

    @classmethod
    def of(cls, pairs: list[FixPair]) -> _Columns:
        """Columns of pairs."""
        return cls(
            np.array([p.t_ns for p in pairs], dtype=np.int64),
            np.array([p.z for p in pairs], dtype=complex),
            np.array([p.fix for p in pairs], dtype=complex),
            np.array([p.sigma_m for p in pairs], dtype=float),
        )

    def and_then(self, pair: FixPair) -> _Columns:
        """The columns with one more pair."""
        return _Columns(
            np.concatenate([self.t_ns, [pair.t_ns]]),
            np.concatenate([self.z, [pair.z]]),
            np.concatenate([self.fix, [pair.fix]]),
            np.concatenate([self.sigma_m, [pair.sigma_m]]),
        )


class DeadReckoning:
    """The dead-reckoned path of the antenna and the fixes along it, for the last `KEPT_S`."""

    def __init__(self, antenna_m: Array) -> None:
        self.lever = complex(antenna_m[0], antenna_m[1])
        self._t_ns: list[int] = []
        self._z: list[complex] = []
        self._yaw: list[float] = []
        self._reach_m: list[float] = []
        self._top_mps = TOP_MPS
        self.pairs: list[FixPair] = []
        self._yaw_chain = 0.0
        self._confirmed = 0
        self._forgotten = np.zeros(2)

    @property
    def reach_m(self) -> float:
        """How far the robot can have driven in all, m."""
        return self._reach_m[-1] if self._reach_m else 0.0

    @property
    def heading(self) -> complex:
        """Turn from the dead-reckoned path to the map by the filter's heading."""
        return cmath.exp(1j * (self._yaw_chain - self._yaw[-1]))

    def step(self, chain: Chain, skids: bool = False) -> None:
        """Extend the path to the newest keyframe by its wheels, or its velocity where they are rejected."""
        node, state = chain.nodes[-1], chain.state(chain.last)
        R = state.rotation
        self._yaw_chain = yaw_of(R)
        if not self._t_ns or len(chain.nodes) < 2:
            self._append(node.t_ns, self._z[-1] if self._z else 0j, self._yaw[-1] if self._yaw else 0.0, 0.0)
            return
        dt = (node.t_ns - self._t_ns[-1]) * 1e-9
        speed_mps = math.sqrt(state.velocity @ state.velocity)
        if node.wheels is not None and math.isfinite(node.wheels.sigma[0]):
            moved, known = node.wheels.displacement_m, not skids
            speed_mps = max(speed_mps, abs(node.wheels.distance_m) / dt)
            if known:  # in a skid the fixes, right or wrong, make the speed
                self._top_mps = max(self._top_mps, speed_mps)
        else:
            moved, known = R.T @ state.velocity * dt, False
        east, north, _ = (R @ moved).tolist()
        turn = float(R[2] @ state.rate(node.gyro_radps)) * dt
        level = complex(east, north) * cmath.exp(-1j * self._yaw_chain)
        self._append(
            node.t_ns,
            self._z[-1] + level * cmath.exp(1j * self._yaw[-1]),
            self._yaw[-1] + turn,
            MARGIN * (speed_mps if known else max(speed_mps, self._top_mps)) * dt,
        )

    def _append(self, t_ns: int, z: complex, yaw: float, further_m: float = 0.0) -> None:
        self._t_ns.append(t_ns)
        self._z.append(z)
        self._yaw.append(yaw)
        self._reach_m.append(self.reach_m + further_m)
        old = bisect.bisect_left(self._t_ns, t_ns - round(KEPT_S * 1e9))
        if old > 50:
            del self._t_ns[:old], self._z[:old], self._yaw[:old], self._reach_m[:old]
            kept = [p for p in self.pairs if p.t_ns >= self._t_ns[0]]
            # The differences that go with them, which their two neighbours complete.
            self._forgotten += self._difference_sums(slice(0, len(self.pairs) - len(kept) + 2))
            self._forgotten *= min(MOST_DIFFERENCES / max(self._forgotten[1], 1.0), 1.0)
            self.pairs = kept
            vars(self).pop("_columns", None)

    def add(self, fix: GnssFix) -> None:
        """Keep a fix with the path at its time."""
        pair = self.pair(fix)
        if pair is not None:
            self.keep(pair)

    def keep(self, pair: FixPair) -> None:
        """Keep a pair, in order of time."""
        bisect.insort(self.pairs, pair, key=lambda p: p.t_ns)
        columns: _Columns | None = vars(self).pop("_columns", None)
        if columns is not None and pair is self.pairs[-1]:
            vars(self)["_columns"] = columns.and_then(pair)

    def pair(self, fix: GnssFix) -> FixPair | None:
        """A fix with the path at its time; None where that is not known."""
        if len(self._t_ns) < 2 or fix.t_ns < self._t_ns[0]:
            return None
        i = min(bisect.bisect_left(self._t_ns, fix.t_ns, 1), len(self._t_ns) - 1)
        begin, end = self._t_ns[i - 1], self._t_ns[i]
        share = min((fix.t_ns - begin) / (end - begin), 1.0)
        z = self._z[i - 1] + share * (self._z[i] - self._z[i - 1])
        yaw = self._yaw[i - 1] + share * (self._yaw[i] - self._yaw[i - 1])
        at = z + self.lever * complex(math.cos(yaw), math.sin(yaw))
        reach_m = self._reach_m[i - 1] + share * (self._reach_m[i] - self._reach_m[i - 1])
        there = complex(fix.enu_m[0], fix.enu_m[1])
        return FixPair(fix.t_ns, at, there, fix.horizontal_sigma_m, reach_m)

    def scatter(self) -> float:
        """Scatter of the last fixes about the path over their reported sigma; NaN with too few.

        From second differences of fix minus path: an offset, a slow drift, a heading error or steady slip
        do not show in them, white noise of variance s^2 does with 6 s^2. Fixes that no other supports
        are left out where they are the fewer, of all and of the newest: each spoils three differences, a
        fifth of them the median.
        """
        begin = max(len(self.pairs) - SCATTER_FIXES, 0)
        recent = self.pairs[begin:]
        taken: slice | list[int] = slice(begin, None)
        supported = [i for i, pair in enumerate(recent, begin) if not pair.alone]
        if len(supported) < len(recent) and not any(map(_mostly_alone, (recent, recent[-LEAST_FIXES:]))):
            taken, recent = supported, recent[: len(supported)]
        if len(recent) < LEAST_FIXES:
            return math.nan
        squares, bend, reported = self._second_differences(taken)
        if len(squares) < 6:
            return math.nan
        return math.sqrt(_median(np.maximum(2.0 * squares / RAYLEIGH_MEDIAN - bend, 0.0) / reported))

    def white_share(self) -> float:
        """Variance that is white over the reported one; NaN with too few fixes.

        The mean of the second differences, of which many are remembered. Squares of white noise are
        exponential, and those beyond `CENSORED` are censored there (Epstein and Sobel 1953, J. Am. Stat.
        Assoc. 48). Where slip may have bent the path by more than the reported sigma, a difference is left
        out.
        """
        total, counted = self._forgotten + self._difference_sums(slice(None))
        return float(total / counted) if counted >= LEAST_DIFFERENCES else math.nan

    def _difference_sums(self, at: slice) -> Array:
        """Sum and number (2,) of squared second differences over the reported variance."""
        if len(self.pairs[at]) < 3:
            return np.zeros(2)
        squares, bend, reported = self._second_differences(at)
        share = (squares / reported)[bend < reported]
        return np.array([np.minimum(share, CENSORED).sum(), np.count_nonzero(share < CENSORED)])

    def _second_differences(self, at: slice | list[int]) -> tuple[Array, Array, Array]:
        """Squares (m2, each axis) of second differences of fix minus path where fixes come evenly, what slip
        may add to them, and their expectation by the reported sigma.
        """
        columns = self._columns
        t_ns, z, fix, sigma_m = columns.t_ns[at], columns.z[at], columns.fix[at], columns.sigma_m[at]
        t_s = (t_ns - t_ns[0]) * 1e-9
        gap = t_s[1:] - t_s[:-1]
        even = np.abs(gap[1:] - gap[:-1]) < 0.5 * np.minimum(gap[1:], gap[:-1])
        left_m = fix - self.heading * z
        squares = 0.5 * _square(left_m[2:] - 2.0 * left_m[1:-1] + left_m[:-2])
        bend = 0.5 * SLIP_CHANGE**2 * _square(z[2:] - z[:-2])
        reported = 6.0 * sigma_m[1:-1] ** 2
        return squares[even], bend[even], reported[even]

    @functools.cached_property
    def _columns(self) -> _Columns:
        """The pairs as arrays; dropped where `pairs` changes otherwise than at its end."""
        return _Columns.of(self.pairs)

    def extent_m(self) -> float:
        """Distance between the first and the last of the fixes over which the scatter is taken."""
        recent = self.pairs[-SCATTER_FIXES:]
        return abs(recent[-1].z - recent[0].z) if recent else 0.0

    def smooth_at(self, t_ns: int) -> bool:
        """Whether the fix at `t_ns` continues the parabola through the three before it, within reported
        sigmas and `MOST_JERK_MPS3`; False with fewer.
        """
        last = bisect.bisect_right(self.pairs, t_ns, key=lambda p: p.t_ns)
        recent = self.pairs[max(last - 4, 0) : last]
        if len(recent) < 4:
            return False
        a, b, c, t = ((p.t_ns - recent[0].t_ns) * 1e-9 for p in recent)
        if not a < b < c < t:
            return False
        weights = (
            (t - b) * (t - c) / ((a - b) * (a - c)),
            (t - a) * (t - c) / ((b - a) * (b - c)),
            (t - a) * (t - b) / ((c - a) * (c - b)),
        )
        led = sum(w * p.fix for w, p in zip(weights, recent, strict=False))
        reported = [w * p.sigma_m for w, p in zip((*weights, 1.0), recent, strict=True)]
        jerk = MOST_JERK_MPS3 / 6.0 * (t - a) * (t - b) * (t - c)
        return abs(recent[3].fix - led) <= SMOOTH_SIGMA * math.hypot(*reported) + jerk

    def heading_correction(self, yaw_sigma_rad: float, scale: float) -> float | None:
        """Turn of the filter's heading that agrees with the motion, rad, once confirmed; else None."""
        turn = self._heading_error(yaw_sigma_rad, scale)
        self._confirmed = self._confirmed + 1 if turn is not None else 0
        return turn if self._confirmed >= CONFIRMED else None

    def restart(self) -> None:
        """Forget the fixes: the filter has been corrected."""
        self.pairs.clear()
        vars(self).pop("_columns", None)
        self._confirmed = 0

    def _heading_error(self, yaw_sigma_rad: float, scale: float) -> float | None:
        fit = self.fit(scale, TURN_SIGMA_RAD)
        if fit is None:
            return None
        error = self.error_of(fit)
        limit = max(LEAST_TURN_RAD, 4.0 * math.hypot(fit.sigma_rad, min(yaw_sigma_rad, 0.3)))
        return error if abs(error) > limit else None

    def error_of(self, fit: PathFit) -> float:
        """Angle, rad, by which the chain's heading must turn to agree with the fit."""
        return cmath.phase(fit.turn * self.heading.conjugate())

    def antenna(self) -> complex:
        """The dead-reckoned antenna at the newest keyframe, m."""
        return self._z[-1] + self.lever * cmath.exp(1j * self._yaw[-1])

    def fit(self, scale: float, yaw_sigma_rad: float) -> PathFit | None:
        """The path aligned with the fixes, their sigmas times `scale`; None until its turn is known to
        `yaw_sigma_rad`.
        """
        usable = [p.usable for p in self.pairs]
        if sum(usable) < 5:
            return None
        columns = self._columns
        at = slice(None) if all(usable) else np.flatnonzero(usable)
        z, fix = columns.z[at], columns.fix[at]
        weight = 1.0 / (scale * columns.sigma_m[at]) ** 2
        kept, there, share = z, fix, weight
        for _ in range(2):  # a second time without what stands out, so that a lone spike turns nothing
            turn, information = planar_rotation(kept, there, share)
            if information <= 0.0:
                return None
            ratio = abs(turn) / information
            middle, fix_middle = kept.sum() / len(kept), there.sum() / len(kept)
            left_m = np.abs((fix - fix_middle) - turn / information * (z - middle))
            left = _median(left_m)
            inlier = left_m <= 5.0 * left + 1e-6
            count = np.count_nonzero(inlier)
            if count < 5:
                return None
            if count == len(kept) == len(z):
                break
            kept, there, share = z[inlier], fix[inlier], weight[inlier]
        extent = float(np.linalg.norm(kept - kept.sum() / len(kept))) / math.sqrt(len(kept))
        if extent == 0.0:  # all that is left was squares where the robot stood
            return None
        sigma = 1.0 / (max(ratio, 1e-6) * math.sqrt(information)) + 0.5 * left / extent
        if sigma > yaw_sigma_rad or not LEAST_RATIO < ratio < MOST_RATIO:
            return None
        return PathFit(turn / information, sigma, complex(middle), complex(fix_middle), left)


def _median(values: Array) -> float:
    """Upper median; a tenth of `np.median`'s time."""
    return float(np.sort(values)[len(values) // 2])


def _square(z: NDArray[np.complex128]) -> Array:
    return np.asarray(z.real**2 + z.imag**2)


def _mostly_alone(pairs: list[FixPair]) -> bool:
    return 2 * sum(pair.alone for pair in pairs) >= max(len(pairs), 1)
