"""Is there a gap: a permutation test over runs.

If nothing has changed, judged runs and references are exchangeable. The statistic of the judged runs is
compared with that of other choices from all runs, each judged against the null of the rest (split-conformal
over runs; exact for exchangeable runs, whatever their noise). The statistic is the greatest deviation of any
effect, each in units of its typical value over all choices (max-T, Westfall and Young 1993). Each effect has
two: by its own score alone, and joint with all other scores. The joint one is sharper where the twin is
nearly right and the covariance is known; in field logs the covariance is learnt from too few runs and the
marginal one is.
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
from terrafusion.twin.gap.infer.posterior import UNKNOWN_SIZES, WIDE, PooledScores
from terrafusion.twin.gap.null.null import learn_null
from terrafusion.twin.gap.null.score import Score

Array = NDArray[np.float64]

TAIL_FREEDOM = 10  # degrees of freedom of the tail of the statistic: heavier than normal (assumed)
EQUAL = 1e-9  # deviations that differ by less than this share are equal
LEAST_SQUARE = 1.5  # least typical square of an effect's deviation: one and a half parameters
LEAST_SPREAD = 0.25  # least 1 sigma of the logarithm of a reference's greatest deviation (assumed)
LEAVE_OUTS = 20  # choices of references that are judged by the rest
PERMUTATIONS = 99  # most other choices of runs that the judged ones are compared with


@dataclass(frozen=True, eq=False)
class Detection:
    """Result of the test.

    Attributes:
        statistic: the greatest deviation of any effect, in units of its typical value in references.
        p_value: of the permutation test.
        typical: (P,) typical square of each column's deviation among the choices.
        scatter: (P,) the same in references judged by the others alone, at least one.
        references: some references judged by the others.
        reference_statistics: the statistic of each of them.
    """

    statistic: float
    p_value: float
    typical: Array
    scatter: Array
    references: tuple[PooledScores, ...]
    reference_statistics: tuple[float, ...]

    def tail_probability(self, significance: float) -> float:
        """The p-value; where there is a gap at this significance, extrapolated by the tail of the references.

        Most permutations contain judged runs and their gap. The odds of a gap therefore use the logarithm of
        the statistic in references alone, as Student's t.
        """
        from scipy.special import stdtr

        if self.p_value > significance or len(self.reference_statistics) < 3:
            return self.p_value
        others = np.log(self.reference_statistics)
        z = (math.log(self.statistic) - others.mean()) / max(float(others.std(ddof=1)), LEAST_SPREAD)
        return min(self.p_value, float(stdtr(TAIL_FREEDOM, -z)))


def permutations(total: int, size: int, seed: int) -> list[tuple[int, ...]]:
    """Choices of `size` out of `total` runs other than the first ones, at most `PERMUTATIONS`."""
    own = tuple(range(size))
    if math.comb(total, size) <= PERMUTATIONS + 1:
        return [c for c in itertools.combinations(range(total), size) if c != own]
    rng, found = np.random.default_rng(seed), dict[tuple[int, ...], None]()
    while len(found) < PERMUTATIONS:
        some = tuple(sorted(int(i) for i in rng.choice(total, size, replace=False)))
        if some != own:
            found[some] = None
    return list(found)


def judged_references(references: Sequence[Score], size: int, seed: int) -> list[PooledScores]:
    """References judged as if they were `size` runs, against the rest; at most `LEAVE_OUTS` choices."""
    size = min(size, max(1, len(references) // 2))
    some = list(itertools.combinations(range(len(references)), size))
    order = np.random.default_rng(seed).permutation(len(some))[:LEAVE_OUTS]
    out = []
    for choice in (some[i] for i in order):
        rest = [s for i, s in enumerate(references) if i not in choice]
        if rest:
            out.append(PooledScores.of([references[i] for i in choice], learn_null(rest, size)))
    return out


def detect(
    runs: Sequence[Score], references: Sequence[Score], candidates: Candidates, seed: int, jobs: int = 1
) -> Detection:
    """The permutation test, in so many threads."""
    every, judged = [*runs, *references], judged_references(references, len(runs), seed)

    def of(choice: tuple[int, ...]) -> Array:
        rest = [r for i, r in enumerate(every) if i not in choice]
        return _squares(scores_against([every[i] for i in choice], rest), candidates)

    tried = [tuple(range(len(runs))), *permutations(len(every), len(runs), seed)]
    with ThreadPoolExecutor(jobs) as threads:
        squares = np.array(list(threads.map(of, tried)))
        alone = np.array(list(threads.map(_squares, judged, itertools.repeat(candidates))))
    typical = np.maximum(squares.mean(axis=0), LEAST_SQUARE)
    greatest = np.sqrt(squares / typical).max(axis=1)
    p_value = float(np.mean(greatest >= greatest[0] * (1.0 - EQUAL)))
    own = np.maximum(alone.mean(axis=0) if judged else 0.0, LEAST_SQUARE)
    statistic, *others = (max(float(np.sqrt((some / own).max())), EQUAL) for some in (squares[0], *alone))
    P = len(runs[0].b)
    scatter = np.maximum(alone.mean(axis=0)[:P] if judged else np.ones(P), 1.0)
    return Detection(statistic, p_value, typical[:P], scatter, tuple(judged), tuple(others))


def scores_against(runs: Sequence[Score], references: Sequence[Score]) -> PooledScores:
    """Some runs against the null of others, without model discrepancy."""
    plain = [dataclasses.replace(r, discrepancy=None) for r in runs]
    return PooledScores.of(plain, learn_null(references, len(runs)))


def _squares(pooled: PooledScores, candidates: Candidates) -> Array:
    """Square of the deviation of every column by its own score, of every form jointly, and twice the log
    Bayes factor of an unknown cause."""
    own = pooled.gain[: pooled.own]
    information = np.diag(pooled.information)[: pooled.own]
    best = own / (information + 1.0 / WIDE**2)
    explained = best * (2.0 * own - best * information)  # as `PooledScores.fit`, of each column
    forms = [h.columns for h in candidates.hypotheses]
    joint = [explained[c[0]] if len(c) == 1 else pooled.fit(c)[2] for c in forms]
    unknown = pooled.log_factor(range(len(candidates.keys), pooled.own), UNKNOWN_SIZES)
    return np.maximum([*pooled.marginal.squares(), *joint, 2.0 * unknown], 0.0)
