"""Is there a gap: a permutation test over runs.

If nothing has changed, judged runs and references are exchangeable: any of them could have been the judged
ones. The statistic of the judged runs is compared with that of other choices from all runs, each judged
against the null of the rest (split-conformal over runs; exact for exchangeable runs, whatever their noise).
What is compared is the greatest of all effects' deviations, each in units of what it usually is over all
choices (max-T, Westfall and Young 1993): in the field some effects scatter from run to run, and a sum over
effects would show these only.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import Candidates
from terrafusion.twin.gap.null import learn
from terrafusion.twin.gap.posterior import WIDE, Beliefs, Pool, beliefs
from terrafusion.twin.gap.score import Score

Array = NDArray[np.float64]

TAIL_FREEDOM = 10
"""Degrees of freedom of that tail: heavier than normal (assumed)."""
EXACT = 1e-9
"""Deviations that differ by less than this share are equal."""
LEAST_SQUARE = 1.5
"""The usual square of an effect's deviation is taken as no less: one and a half parameters."""
PERMUTATIONS = 99
"""Other choices of runs that the judged ones are compared with, at most."""


@dataclass(frozen=True, eq=False)
class Detection:
    """Log Bayes factor of any gap in the judged runs, the p-value of the test, and that factor in other
    choices of runs."""

    statistic: float
    p_value: float
    others: tuple[float, ...]
    pool: Pool
    beliefs: Beliefs

    def tail(self) -> float:
        """The p-value carried on beyond what so few choices resolve: for the odds of a gap, not for the test.

        On a scale that is linear for small and logarithmic for large statistics, others are taken as
        Student's t.
        """
        from scipy.special import stdtr

        if self.p_value > 1.5 / (1 + len(self.others)) or len(self.others) < 3:
            return self.p_value
        others = np.arcsinh(self.others)
        z = (math.asinh(self.statistic) - others.mean()) / max(float(others.std(ddof=1)), 0.2)
        return min(self.p_value, float(stdtr(TAIL_FREEDOM, -z)))


def judged(
    runs: Sequence[Score], references: Sequence[Score], candidates: Candidates
) -> tuple[Pool, Beliefs]:
    """Sums and beliefs of some runs against the null of others, by the catalogue's own forms alone."""
    null = learn(references, len(runs))
    pool = Pool.of([dataclasses.replace(r, other=None) for r in runs], null)
    return pool, beliefs(pool, candidates)


def choices(total: int, size: int, seed: int) -> list[tuple[int, ...]]:
    """Other choices of `size` out of `total` runs than the first ones, at most `PERMUTATIONS`."""
    own = tuple(range(size))
    if math.comb(total, size) <= PERMUTATIONS + 1:
        return [c for c in itertools.combinations(range(total), size) if c != own]
    rng, found = np.random.default_rng(seed), dict[tuple[int, ...], None]()
    while len(found) < PERMUTATIONS:
        some = tuple(sorted(int(i) for i in rng.choice(total, size, replace=False)))
        if some != own:
            found[some] = None
    return list(found)


def detect(
    runs: Sequence[Score], references: Sequence[Score], candidates: Candidates, seed: int, jobs: int = 1
) -> Detection:
    """The permutation test, in so many threads."""
    pool, found = judged(runs, references, candidates)
    every = [*runs, *references]

    def other(choice: tuple[int, ...]) -> tuple[Array, float]:
        rest = [r for i, r in enumerate(every) if i not in choice]
        some, believed = judged([every[i] for i in choice], rest, candidates)
        return _squares(some, believed, candidates), believed.statistic()

    with ThreadPoolExecutor(jobs) as threads:
        tried = list(threads.map(other, choices(len(every), len(runs), seed)))
    squares = [_squares(pool, found, candidates), *(square for square, _ in tried)]
    others = [statistic for _, statistic in tried]
    usual = np.maximum(np.mean(squares, axis=0), LEAST_SQUARE)
    greatest = np.sqrt(np.array(squares) / usual).max(axis=1)
    p_value = float(np.mean(greatest >= greatest[0] * (1.0 - EXACT)))
    return Detection(found.statistic(), p_value, tuple(others), pool, found)


def _squares(pool: Pool, found: Beliefs, candidates: Candidates) -> Array:
    """Square of the deviation along every form, and twice the log Bayes factor of an unknown cause."""
    own = pool.gain[: pool.own]
    information = np.diag(pool.information)[: pool.own]
    best = own / (information + 1.0 / WIDE**2)
    alone = best * (2.0 * own - best * information)  # as `Pool.fit`, of each column by itself
    forms = [h.columns for h in candidates.hypotheses]
    known = [alone[c[0]] if len(c) == 1 else pool.fit(c)[2] for c in forms]
    return np.maximum([*known, 2.0 * found.unknown], 0.0)
