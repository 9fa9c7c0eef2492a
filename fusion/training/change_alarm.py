"""Alarm of a change of ground: the newest second of a drive against the seconds before it.

The classes' log-odds of the last second differ from their mean over the seconds before by more than they do
along runs on one ground (Hotelling's T^2 per degree of freedom). Unlike probabilities, log-odds do not
saturate: a change shows although the new ground is taken for a wrong class.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array

MEMORY, LEAST = 6, 3
"""Windows before, at most and at least, that the newest is compared with."""
OVERLAP = 1
"""Windows just before the newest that share samples with it, and are left out."""
LIMIT = 5.0
"""T^2 per degree of freedom of an alarm (chosen on routes spliced from BorealTC)."""
_SHRINK = 1e-3


def precision_of(drives: Sequence[Array]) -> Array:
    """Inverse scatter (k, k) of the differences along drives on one ground, each with log-odds (n, k)."""
    away = [
        odds[i] - _before(odds[: i + 1]).mean(axis=0)
        for odds in drives
        for i in range(MEMORY + OVERLAP + 1, len(odds), 2)
    ]
    k = drives[0].shape[1]
    if len(away) < 2 * k:
        return np.zeros((k, k))
    scatter = np.cov(np.array(away).T)
    return np.asarray(np.linalg.pinv(scatter + _SHRINK * np.trace(scatter) / k * np.eye(k)))


def has_changed(odds: Array, precision: Array) -> bool:
    """Whether the ground of the last of the log-odds (n, k), all since the last alarm, is a new one."""
    before = _before(odds)
    if len(before) < LEAST:
        return False
    away = odds[-1] - before.mean(axis=0)
    return float(away @ precision @ away) > LIMIT * (odds.shape[1] - 1)


def _before(odds: Array) -> Array:
    return odds[max(len(odds) - 1 - OVERLAP - MEMORY, 0) : max(len(odds) - 1 - OVERLAP, 0)]
