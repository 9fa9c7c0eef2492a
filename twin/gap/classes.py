"""Effects that cannot be told from each other by the data at hand.

Two effects look alike when their projected signatures do: the canonical correlation of what one does to the
scores of these very runs with all that the other could do, both seen through the learned null. How alike
is too alike depends on the size of the gap: a part sqrt(1 - c^2) of the signal speaks for the one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import Candidates
from terrafusion.twin.gap.posterior import Pool

Array = NDArray[np.float64]

ALIKE = 0.985
"""Correlation from which two effects are one class whatever the size of the gap (assumed)."""
TELLING = 3.0
"""Sigmas by which the better effect must explain more, to be told from another."""


def likeness(pool: Pool, one: Sequence[int], coefficients: Array, other: Sequence[int]) -> float:
    """Correlation of the signature of `one` with these coefficients and the best of `other`."""
    a, b = np.asarray(one), np.asarray(other)
    whole = pool.information
    size = float(coefficients @ whole[np.ix_(a, a)] @ coefficients)
    if not size > 0.0:
        return 0.0
    cross = whole[np.ix_(b, a)] @ coefficients
    within = whole[np.ix_(b, b)] + 1e-9 * np.eye(len(b)) * max(float(np.trace(whole[np.ix_(b, b)])), 1e-12)
    return float(np.sqrt(np.clip(cross @ np.linalg.solve(within, cross) / size, 0.0, 1.0)))


def class_of(
    pool: Pool,
    candidates: Candidates,
    effect: str,
    columns: Sequence[int],
    others: Sequence[str],
    same: float = ALIKE,
) -> tuple[str, ...]:
    """The effect and those of `others` that it cannot be told from; `same` is the correlation from which
    it cannot."""
    coefficients, _, _ = pool.fit(columns)
    a = np.asarray(columns)
    signal = float(coefficients @ pool.information[np.ix_(a, a)] @ coefficients)
    members = [effect]
    for other in others:
        if other == effect:
            continue
        alike = max(
            likeness(pool, columns, coefficients, h.columns)
            for h in candidates.hypotheses
            if h.effect == other
        )
        if alike >= same or signal * (1.0 - alike**2) < TELLING**2:
            members.append(other)
    return tuple(members)
