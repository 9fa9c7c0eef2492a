"""Effects that cannot be told from each other by the data at hand.

Two effects look alike when their projected signatures do: the canonical correlation of what one does to the
scores of these very runs with all that the other could do, both seen through the learned null. How alike
is too alike depends on the size of the gap: a part sqrt(1 - c^2) of the signal speaks for the one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.posterior import Pool

Array = NDArray[np.float64]

ALIKE = 0.985
"""Correlation from which two effects are one class whatever the size of the gap (assumed)."""
TELLING = 3.0
"""Sigmas by which the better effect must explain more, to be told from another."""


def likeness(pool: Pool, does: Array, size: float, other: Sequence[int]) -> float:
    """Correlation of what an effect does and the best of `other` columns.

    Args:
        does: (P,) its inner products with all columns' signatures; `size`: with itself.
    """
    b = np.asarray(other)
    if not size > 0.0:
        return 0.0
    cross, within = does[b], pool.information[np.ix_(b, b)]
    within = within + 1e-9 * np.eye(len(b)) * max(float(np.trace(within)), 1e-12)
    return float(np.sqrt(np.clip(cross @ np.linalg.solve(within, cross) / size, 0.0, 1.0)))


def done(pool: Pool, columns: Sequence[int], after: Callable[[], Pool]) -> tuple[Array, float]:
    """What an effect does in the runs: inner products with all columns' signatures (P,) and with itself.

    To first order; of a law whose signature says nothing at the size that fits best, by what is left `after`
    its fit through the twin.
    """
    coefficients, _, _ = pool.fit(columns)
    does = pool.information[:, np.asarray(columns)] @ coefficients
    size = float(coefficients @ does[np.asarray(columns)])
    if size >= TELLING**2:
        return does, size
    left = after()
    if pool.square - left.square < TELLING**2:
        return does, size
    return pool.gain - left.gain, pool.square - left.square


def class_of(
    pool: Pool,
    candidates: Candidates,
    effect: str,
    does: Array,
    signal: float,
    others: Sequence[str],
    same: float = ALIKE,
) -> tuple[str, ...]:
    """The effect and those of `others` that it cannot be told from, by what it does (see `done`); `same` is
    the correlation from which it cannot."""
    members = [effect]
    for other in others:
        if other == effect:
            continue
        alike = max(
            likeness(pool, does, signal, h.columns) for h in candidates.hypotheses if h.effect == other
        )
        if alike >= same or signal * (1.0 - alike**2) < TELLING**2:
            members.append(other)
    return tuple(members)
