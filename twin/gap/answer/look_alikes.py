"""Look-alikes: effects that the data cannot distinguish.

Two effects look alike when their projected sensitivities correlate: the canonical correlation of what one
does to the scores of these runs with all that the other could do, through the learned null. The threshold
depends on the size of the gap: a part sqrt(1 - c^2) of the signal distinguishes the two.

That part may be large in noise and still be less than the laws themselves are wrong: rolling resistance, dry
friction and suction differ by what remains of them once the ground is fitted. So two effects also look alike
where their whole signatures, with the ground as it is, nearly coincide.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

Array = NDArray[np.float64]

SAME_CLASS = 0.985  # correlation from which two effects are one class whatever the size of the gap (assumed)
SAME_SIGNATURE = 0.97
"""Correlation of whole signatures from which they differ by a quarter, about as much as a law is wrong (1
sigma is a fifth, `verdict.LAW_SIGMA_MOTION`)."""
SEPARABLE_SIGMAS = 3.0  # sigmas by which the better effect must explain more to be distinguished from another


def similarity(information: Array, signal: Array, square: float, other: Sequence[int]) -> float:
    """Correlation of an effect and the best of `other` columns.

    Args:
        information: (P, P) inner products of all columns' sensitivities.
        signal: (P,) those of the effect with all of them; `square`: with itself.
    """
    b = np.asarray(other)
    if not square > 0.0:
        return 0.0
    cross, within = signal[b], information[np.ix_(b, b)]
    within = within + 1e-9 * np.eye(len(b)) * max(float(np.trace(within)), 1e-12)
    return float(np.sqrt(np.clip(cross @ np.linalg.solve(within, cross) / square, 0.0, 1.0)))


def unlike_square(
    information: Array, candidates: Candidates, signal: Array, square: float, other: str
) -> tuple[float, float]:
    """Similarity of an effect to the best form of another, and the square of its signal that then remains."""
    forms = [h.columns for h in candidates.hypotheses if h.effect == other]
    similar = max(similarity(information, signal, square, columns) for columns in forms)
    return similar, square * (1.0 - similar**2)


def effect_signal(
    pooled: PooledScores, columns: Sequence[int], after: Callable[[], PooledScores]
) -> tuple[Array, float]:
    """Inner products of an effect in the runs with all columns' sensitivities (P,), and with itself.

    To first order; for a law without sensitivity at the size that fits best, by the scores `after` its refit.
    """
    coefficients, _, _ = pooled.fit(columns)
    signal = pooled.information[:, np.asarray(columns)] @ coefficients
    square = float(coefficients @ signal[np.asarray(columns)])
    if square >= SEPARABLE_SIGMAS**2:
        return signal, square
    rest = after()
    if pooled.square - rest.square < SEPARABLE_SIGMAS**2:
        return signal, square
    return pooled.gain - rest.gain, pooled.square - rest.square


def look_alikes(
    pooled: PooledScores,
    candidates: Candidates,
    signal: Array,
    square: float,
    others: Sequence[str],
    same: float = SAME_CLASS,
) -> tuple[str, ...]:
    """Those of `others` that cannot be distinguished from an effect, by its signal (see `effect_signal`);
    `same` is the correlation from which they cannot."""
    members = []
    for other in others:
        similar, rest = unlike_square(pooled.information, candidates, signal, square, other)
        if similar >= same or rest < SEPARABLE_SIGMAS**2:
            members.append(other)
    return tuple(members)


def signatures(runs: Sequence[WhitenedRun], count: int) -> Array:
    """Inner products (P, P) of the first `count` columns' whole signatures, the ground not fitted."""
    first = [run.gram[run.states : run.states + count, run.states : run.states + count] for run in runs]
    return np.asarray(np.sum(first, axis=0))


def same_signature(
    whole: Array, candidates: Candidates, columns: Sequence[int], value: Array, others: Sequence[str]
) -> tuple[str, ...]:
    """Those of `others` whose `signatures` nearly coincide with that of an effect of this value (k,)."""
    signal = whole[:, list(columns)] @ value
    square = float(value @ signal[list(columns)])
    if square < SEPARABLE_SIGMAS**2:
        return ()
    return tuple(
        other
        for other in others
        if unlike_square(whole, candidates, signal, square, other)[0] >= SAME_SIGNATURE
    )
