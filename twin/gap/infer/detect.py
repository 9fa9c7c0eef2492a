"""Is there a gap: a permutation test over runs.

If nothing has changed, judged runs and references are exchangeable: any of them could have been the judged
ones. The statistic of the judged runs is compared with that of other choices from all runs, each judged
against the null of the rest (split-conformal over runs; exact for exchangeable runs, whatever their noise).
What is compared is the greatest of all effects' deviations, each in units of what it usually is over all
choices (max-T, Westfall and Young 1993): in the field some effects scatter from run to run, and a sum over
effects would show these only. Each effect has two: by its own score alone, and beside all other scores. The
second is sharper where the twin is nearly right and their covariance is known; in the field it is learnt
from too few runs, and the first is.
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

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.posterior import UNKNOWN_SIZES, WIDE, Pool
from terrafusion.twin.gap.null.null import learn
from terrafusion.twin.gap.null.score import Score

Array = NDArray[np.float64]

TAIL_FREEDOM = 10
"""Degrees of freedom of that tail: heavier than normal (assumed)."""
EXACT = 1e-9
"""Deviations that differ by less than this share are equal."""
LEAST_SQUARE = 1.5
"""The usual square of an effect's deviation is taken as no less: one and a half parameters."""
LEAST_SPREAD = 0.25
"""1 sigma of the logarithm of a reference's greatest deviation is taken as no less (assumed)."""
FLOORS = 20
"""Choices of references that are judged by the rest."""
PERMUTATIONS = 99
"""Other choices of runs that the judged ones are compared with, at most."""


@dataclass(frozen=True, eq=False)
class Detection:
    """What the test finds.

    Attributes:
        statistic: the greatest deviation of any effect, in units of what it usually is in references.
        p_value: of the permutation test.
        usual: (P,) square of each column's deviation that is usual among the choices.
        scatter: (P,) the same in references judged by the others alone, at least one.
        nulls: some references judged by the others.
        normal: the statistic of each of them.
    """

    statistic: float
    p_value: float
    usual: Array
    scatter: Array
    nulls: tuple[Pool, ...]
    normal: tuple[float, ...]

    def tail(self, significance: float) -> float:
        """The p-value, where there is a gap at this significance as references have it that others judge: for
        the odds of a gap, not for the test.

        Most of the choices hold judged runs, too, and show their gap; one with two of three may show more of
        it than all three do. So what counts is the logarithm of the statistic in references alone, taken as
        Student's t.
        """
        from scipy.special import stdtr

        if self.p_value > significance or len(self.normal) < 3:
            return self.p_value
        others = np.log(self.normal)
        z = (math.log(self.statistic) - others.mean()) / max(float(others.std(ddof=1)), LEAST_SPREAD)
        return min(self.p_value, float(stdtr(TAIL_FREEDOM, -z)))


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


def among(references: Sequence[Score], size: int, seed: int) -> list[Pool]:
    """References judged as if they were so many runs, against the rest; at most `FLOORS` choices."""
    size = min(size, max(1, len(references) // 2))
    some = list(itertools.combinations(range(len(references)), size))
    order = np.random.default_rng(seed).permutation(len(some))[:FLOORS]
    pools = []
    for choice in (some[i] for i in order):
        rest = [s for i, s in enumerate(references) if i not in choice]
        if rest:
            pools.append(Pool.of([references[i] for i in choice], learn(rest, size)))
    return pools


def detect(
    runs: Sequence[Score], references: Sequence[Score], candidates: Candidates, seed: int, jobs: int = 1
) -> Detection:
    """The permutation test, in so many threads."""
    every, nulls = [*runs, *references], among(references, len(runs), seed)

    def of(choice: tuple[int, ...]) -> Array:
        rest = [r for i, r in enumerate(every) if i not in choice]
        return _squares(judged([every[i] for i in choice], rest), candidates)

    tried = [tuple(range(len(runs))), *choices(len(every), len(runs), seed)]
    with ThreadPoolExecutor(jobs) as threads:
        squares = np.array(list(threads.map(of, tried)))
        alone = np.array(list(threads.map(_squares, nulls, itertools.repeat(candidates))))
    usual = np.maximum(squares.mean(axis=0), LEAST_SQUARE)
    greatest = np.sqrt(squares / usual).max(axis=1)
    p_value = float(np.mean(greatest >= greatest[0] * (1.0 - EXACT)))
    own = np.maximum(alone.mean(axis=0) if nulls else 0.0, LEAST_SQUARE)
    statistic, *normal = (max(float(np.sqrt((some / own).max())), EXACT) for some in (squares[0], *alone))
    P = len(runs[0].b)
    scatter = np.maximum(alone.mean(axis=0)[:P] if nulls else np.ones(P), 1.0)
    return Detection(statistic, p_value, usual[:P], scatter, tuple(nulls), tuple(normal))


def judged(runs: Sequence[Score], references: Sequence[Score]) -> Pool:
    """Sums of some runs against the null of others, by the catalogue's own forms alone."""
    return Pool.of([dataclasses.replace(r, other=None) for r in runs], learn(references, len(runs)))


def _squares(pool: Pool, candidates: Candidates) -> Array:
    """Square of the deviation of every column's own score, of that along every form beside all scores, and
    twice the log Bayes factor of an unknown cause."""
    own = pool.gain[: pool.own]
    information = np.diag(pool.information)[: pool.own]
    best = own / (information + 1.0 / WIDE**2)
    explained = best * (2.0 * own - best * information)  # as `Pool.fit`, of each column
    forms = [h.columns for h in candidates.hypotheses]
    joint = [explained[c[0]] if len(c) == 1 else pool.fit(c)[2] for c in forms]
    unknown = pool.log_factor(range(len(candidates.keys), pool.own), UNKNOWN_SIZES)
    return np.maximum([*pool.alone.squares(), *joint, 2.0 * unknown], 0.0)
