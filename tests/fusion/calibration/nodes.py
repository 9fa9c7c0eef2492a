"""Whole drives at once, in which `SelfCalibration` begins a node and makes a step after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.fit import combined, started
from terrafusion.fusion.calibration.motion import MotionSegment, node_due
from terrafusion.fusion.calibration.numbers import Knowledge
from terrafusion.fusion.calibration.reduction import Nodes, Noise, Reduction


def node_starts(t_s: Array, distance_m: Array, fix_sigma_m: float) -> NDArray[np.intp]:
    """Samples at which a node begins, from times (N + 1,) and distances (N,)."""
    rolled = np.concatenate([[0.0], np.cumsum(np.abs(distance_m))])
    found = [0]
    for i in range(1, len(t_s) - 1):
        last = found[-1]
        if node_due(float(t_s[i] - t_s[last]), float(rolled[i] - rolled[last]), fix_sigma_m):
            found.append(i)
    return np.array(found)


ITERATIONS, CONVERGED = 10, 0.02
"""Gauss-Newton steps at most; done when no number moves by more than this share of its sigma."""


def fit(
    drives: Sequence[MotionSegment],
    starts: Sequence[tuple[complex, float]],
    before: Knowledge,
    noise: Noise,
) -> Knowledge:
    """The numbers after `drives`, each of which starts about a position (east + i north) and yaw (rad).

    Raises:
        LinAlgError: the drives determine no path.
    """
    now = before
    parts = [started(drive, *start, now.mean) for drive, start in zip(drives, starts, strict=True)]
    for i in range(ITERATIONS):
        last, now = now, refined(parts, now, before, noise)
        if i > 2 and (np.abs(now.mean - last.mean) < CONVERGED * now.sigma).all():
            break
    return now


def refined(parts: Sequence[Nodes], now: Knowledge, before: Knowledge, noise: Noise) -> Knowledge:
    """One Gauss-Newton step from the numbers `now`, with those known `before`; moves the nodes, too."""
    reduced = [Reduction.of(part, now.mean, now.slip_spread, noise) for part in parts]
    for one in reduced:
        while not one.advance():
            pass
    return combined(reduced, now, before)
