"""Tests whether velocities of fixes are the rate of their positions.

Velocities in other axes or another unit pull the estimate steadily, each by too little for a gate. Between
fixes some metres apart, their integral is compared with the displacement of the fixes. They are refuted only
where wheels and gyro fit that displacement far better: elsewhere the positions may be wrong.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from terrafusion.fusion.estimator.dead_reckoning import FixPair
from terrafusion.fusion.inputs.validation import GnssFix

CHORD_M, CHORD_SIGMA, CHORD_S = 2.0, 3.0, 30.0
"""Distance by wheels, in metres and in sigmas of a fix, over which velocities are integrated, and the longest
time for it: beyond, what they are off at rest counts."""
GAP_S = 2.5
"""Longest time between two velocities that are integrated."""
WRONG = 0.1
"""Distance between integral and displacement over the sum of both: a factor of 1.2, or 12 degrees
(assumed)."""
LEAST, MOST, SIGMAS = 4, 20, 3.0
"""Chords that refute velocities at least, the most that count, and sigmas of their mean."""
BETTER = 0.5
"""Squares that wheels and gyro leave of the displacements, beyond noise, over those that velocities leave, at
most."""
AGREEING, SAME_COURSE = 8, math.cos(math.pi / 4)
"""Chords that must agree until velocities are believed again, one of them along the course that refuted them:
with a wrong sign or axis, those along others agree."""


@dataclass(frozen=True)
class Chord:
    """From a fix to one some metres on; east + i north, m.

    Attributes:
        begin_ns: its begin.
        by_fixes, by_velocities, by_wheels: its displacement; the last turned by an unknown angle.
        noise_m2: variance of the difference of the first two, both axes.
    """

    begin_ns: int
    by_fixes: complex
    by_velocities: complex
    by_wheels: complex
    noise_m2: float

    @property
    def wrong_m2(self) -> float:
        """Square of what velocities are off, beyond noise and `WRONG`."""
        most_m = WRONG * (abs(self.by_fixes) + abs(self.by_velocities))
        return abs(self.by_velocities - self.by_fixes) ** 2 - self.noise_m2 - most_m**2


@dataclass(eq=False)
class VelocityTest:
    """The running test.

    Attributes:
        chords: the last ones; since the velocities were refuted, where they are.
        refuted_along: displacement that refuted them most; None while velocities are believed.
        left_out: how many velocities were not used.
    """

    chords: deque[Chord] = field(default_factory=lambda: deque(maxlen=MOST))
    refuted_along: complex | None = None
    left_out: int = 0
    _begin: FixPair | None = None
    _last: tuple[int, complex] = (0, 0j)
    _integral_m: complex = 0j
    _variance_m2: float = 0.0

    def add(self, pair: FixPair, fix: GnssFix, scale: float) -> int | None:
        """Take in a fix, its sigma times `scale`; the time from which on velocities are wrong where it has
        refuted them, else None.
        """
        if fix.velocity_mps is None or not math.isfinite(fix.velocity_mps[0] + fix.velocity_mps[1]):
            return None
        (last_ns, last_mps), now_mps = self._last, complex(fix.velocity_mps[0], fix.velocity_mps[1])
        self._last, gap_s = (pair.t_ns, now_mps), (pair.t_ns - last_ns) * 1e-9
        begin = self._begin
        if begin is None or not 0.0 < gap_s <= GAP_S or (pair.t_ns - begin.t_ns) * 1e-9 > CHORD_S:
            self._restart(pair)
            return None
        self._integral_m += 0.5 * gap_s * (last_mps + now_mps)
        self._variance_m2 += (gap_s * fix.sigma_v_mps) ** 2
        wheels_m, sigma_m = pair.z - begin.z, scale * max(pair.sigma_m, begin.sigma_m)
        if abs(wheels_m) < max(CHORD_M, CHORD_SIGMA * sigma_m):
            return None
        fixes_m2 = scale**2 * (begin.sigma_m**2 + pair.sigma_m**2)
        noise_m2 = 2.0 * (fixes_m2 + self._variance_m2)
        self.chords.append(Chord(begin.t_ns, pair.fix - begin.fix, self._integral_m, wheels_m, noise_m2))
        self._restart(pair)
        return self._judge()

    def _restart(self, pair: FixPair) -> None:
        self._begin, self._integral_m, self._variance_m2 = pair, 0j, 0.0

    def _judge(self) -> int | None:
        """The time from which on velocities are wrong, where the newest chord refutes them."""
        chords, wrong = list(self.chords), np.array([chord.wrong_m2 for chord in self.chords])
        if self.refuted_along is not None:
            if len(wrong) >= AGREEING and wrong[-AGREEING:].mean() < 0.0:
                recent = np.array([chord.by_fixes for chord in chords[-AGREEING:]])
                along = (recent * self.refuted_along.conjugate()).real / abs(self.refuted_along)
                if (along > SAME_COURSE * np.abs(recent)).any():
                    self.refuted_along = None
            return None
        if len(wrong) < LEAST or wrong.mean() < SIGMAS * wrong.std(ddof=1) / math.sqrt(len(wrong)):
            return None
        fixes, velocities, wheels = (
            np.array([getattr(chord, f"by_{name}") for chord in chords])
            for name in ("fixes", "velocities", "wheels")
        )
        turn = np.vdot(wheels, fixes) / np.vdot(wheels, wheels)
        noise_m2 = sum(chord.noise_m2 for chord in chords)
        by_wheels, by_velocities = (
            float(np.sum(np.abs(fixes - by) ** 2)) - noise_m2 for by in (turn * wheels, velocities)
        )
        if by_wheels > BETTER * by_velocities:
            return None
        first = int(np.argmax(wrong > 0.0))
        self.refuted_along = chords[int(np.argmax(wrong))].by_fixes
        self.chords.clear()
        return chords[first].begin_ns if first else -(2**63)
