"""Which effect: Bayes factors of every effect against the learned null, and against a gap of no known shape.

Under effect k the standardised scores of all runs shift along one direction a parameter, x = U_k phi + noise,
with phi ~ N(0, s^2) and s spread over a decade; forms are alternatives with equal weight, and each may depart
from its law (see `discrepancy`). `unknown` shifts
them along all probes at once.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.discrepancy import FUNCTIONS
from terrafusion.twin.gap.null.null import Null
from terrafusion.twin.gap.null.score import Score

Array = NDArray[np.float64]

SIZES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""1 sigma of an effect's size, in typical sizes; equal weights."""
WIDE = 10.0
"""1 sigma of an effect's size where it is fitted: the data decide."""
UNKNOWN_SIZES = (0.3, 1.0, 3.0, 10.0)
UNKNOWN_PRIOR = 0.1
"""Prior probability that a gap has a cause outside the catalogue (assumed)."""
OTHER_FORM = 0.1
"""1 sigma of a law's departure from its form, in the effect's size (tuned on twin trials)."""


@dataclass(frozen=True, eq=False)
class Alone:
    """Each column by its own score, whatever the others say (marginal, where `Pool` is joint).

    Where effects scatter from run to run for reasons of their own, the covariance of all scores is not known
    from a few references, and what it subtracts is noise.

    Attributes:
        gain: (P,) sum of u x, with u the change of a column's own score by it.
        moved: (P, P) the change of that by the columns.
        variance: (P,) sum of u^2 times the variance of x.
        usual: (P,) square of a deviation that is usual among all runs.
        scatter: (P,) that in references judged by others, at least one.
    """

    gain: Array
    moved: Array
    variance: Array
    usual: Array
    scatter: Array

    @classmethod
    def none(cls, P: int) -> Alone:
        """Of no run."""
        return cls(np.zeros(P), np.zeros((P, P)), np.full(P, 1e-9), np.ones(P), np.ones(P))

    @classmethod
    def of(cls, x: Array, U: Array, null: Null) -> Alone:
        """Of one run's standardised scores (P,) and their change by the columns (P, P)."""
        own = np.diag(U)
        ones = np.ones(len(x))
        return cls(own * x, own[:, None] * U, own**2 * np.diag(null.covariance), ones, ones)

    def plus(self, other: Alone, sign: float = 1.0) -> Alone:
        """With other runs, or without them."""
        return Alone(
            self.gain + sign * other.gain, self.moved + sign * other.moved,
            self.variance + sign * other.variance, self.usual, self.scatter,
        )  # fmt: skip

    def squares(self, columns: Sequence[int] = (), value: Array | None = None) -> Array:
        """Squares (P,) of the deviations, in what is usual, with some columns (k,) taken out at a value."""
        left = self.gain if value is None else self.gain - self.moved[:, list(columns)] @ value
        return np.asarray(left**2 / (np.maximum(self.variance, 1e-9) * self.usual))

    def sigmas(self, columns: Sequence[int]) -> Array:
        """1 sigma (k,) of sizes as each column's own score has them: as they scatter in the references."""
        at = list(columns)
        moved = np.maximum(np.diag(self.moved)[at], 1e-9)
        return np.minimum(np.sqrt(self.variance[at] * self.scatter[at]) / moved, WIDE)


@dataclass(frozen=True, eq=False)
class Pool:
    """All judged runs together, against a null, in the space of the columns.

    Attributes:
        information: (M, M) sum of U' C^-1 U; the first P columns are those of the candidates and probes, then
            come those of laws of another form, F for each of the K candidates, where the scores have them.
        gain: (M,) sum of U' C^-1 x.
        square: sum of x' C^-1 x.
        dims: length of all x.
        own: P.
        alone: the same by each column's own score.
    """

    information: Array
    gain: Array
    square: float
    dims: int
    own: int
    alone: Alone

    @classmethod
    def of(cls, runs: Sequence[Score], null: Null) -> Pool:
        """Sums over the runs."""
        P, square = len(null.mean), 0.0
        extra = 0 if runs[0].other is None else runs[0].other[0].size
        information, gain, alone = np.zeros((P + extra, P + extra)), np.zeros(P + extra), Alone.none(P)
        for run in runs:
            x, U = null.standardised(run)
            alone = alone.plus(Alone.of(x, U, null))
            if run.other is not None:
                root = 1.0 / np.sqrt(np.diag(run.A) + 1.0)
                U = np.hstack([U, root[:, None] * run.other.reshape(P, -1)])
            weighted = null.inverse @ U
            information += U.T @ weighted
            gain += weighted.T @ x
            square += float(x @ null.inverse @ x)
        return cls(0.5 * (information + information.T), gain, square, P * len(runs), P, alone)

    @classmethod
    def sum(cls, pools: Sequence[Pool]) -> Pool:
        """Those of all runs together."""
        return cls(
            sum((p.information for p in pools), np.zeros_like(pools[0].information)),
            sum((p.gain for p in pools), np.zeros_like(pools[0].gain)),
            sum(p.square for p in pools), sum(p.dims for p in pools), pools[0].own,
            functools.reduce(Alone.plus, (p.alone for p in pools)),
        )  # fmt: skip

    def plain(self) -> Pool:
        """The same without laws of another form."""
        P = self.own
        return Pool(self.information[:P, :P], self.gain[:P], self.square, self.dims, P, self.alone)

    def beside(self, usual: Array, scatter: Array) -> Pool:
        """The same with the squares (P,) of deviations that are usual, and as they scatter in references."""
        return dataclasses.replace(self, alone=dataclasses.replace(self.alone, usual=usual, scatter=scatter))

    def without(self, other: Pool) -> Pool:
        """Those of the runs that `other` does not have."""
        return Pool(
            self.information - other.information, self.gain - other.gain, self.square - other.square,
            self.dims - other.dims, self.own, self.alone.plus(other.alone, -1.0),
        )  # fmt: skip

    def with_other_forms(self, columns: Sequence[int]) -> tuple[NDArray[np.int64], Array]:
        """The columns and those of laws of another form of the candidates among them, and 1 sigma of each in
        that of the candidate's size."""
        extra = (len(self.gain) - self.own) // len(FUNCTIONS)
        more = [
            self.own + i * len(FUNCTIONS) + j for i in columns if i < extra for j in range(len(FUNCTIONS))
        ]
        weights = np.repeat([1.0, OTHER_FORM], [len(columns), len(more)])
        return np.array([*columns, *more], dtype=np.int64), weights

    def log_factor(self, columns: Sequence[int], sizes: Sequence[float] = SIZES) -> float:
        """Log Bayes factor of the columns, N(0, s^2) with s over `sizes`, against the null."""
        at, weights = self.with_other_forms(columns)
        g = self.gain[at] * weights
        values, vectors = np.linalg.eigh(self.information[np.ix_(at, at)] * weights[:, None] * weights)
        values, h = np.maximum(values, 0.0), vectors.T @ g
        each = [
            0.5 * float(np.sum(h**2 * s * s / (1.0 + s * s * values) - np.log1p(s * s * values)))
            for s in sizes
        ]
        return float(np.logaddexp.reduce(each) - np.log(len(each)))

    def log_factors(self) -> Array:
        """`log_factor` (P,) of each column by itself, in the catalogue's own forms."""
        square = np.array(SIZES)[:, None] ** 2
        spread = square * np.maximum(np.diag(self.information)[: self.own], 0.0)
        each = 0.5 * (self.gain[: self.own] ** 2 * square / (1.0 + spread) - np.log1p(spread))
        return np.asarray(np.logaddexp.reduce(each, axis=0) - np.log(len(SIZES)))

    def fit(self, columns: Sequence[int], size: float = WIDE) -> tuple[Array, Array, float]:
        """Best coefficients (k,), their covariance (k, k), and how much of `square` they explain."""
        at = np.asarray(columns, dtype=np.int64)
        H = self.information[np.ix_(at, at)] + np.eye(len(at)) / size**2
        covariance: Array = np.asarray(np.linalg.inv(H), dtype=float)
        best = covariance @ self.gain[at]
        explained = 2.0 * best @ self.gain[at] - best @ self.information[np.ix_(at, at)] @ best
        return best, covariance, float(explained)


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Log Bayes factors against the null: by effect, its best form, by form, and of the unknown."""

    effects: dict[str, float]
    best: dict[str, Hypothesis]
    forms: dict[tuple[str, str], float]
    unknown: float

    def statistic(self) -> float:
        """Log Bayes factor of any gap against none."""
        known = np.logaddexp.reduce(list(self.effects.values())) - np.log(len(self.effects))
        return float(np.logaddexp(known + np.log1p(-UNKNOWN_PRIOR), self.unknown + np.log(UNKNOWN_PRIOR)))


def beliefs(pool: Pool, candidates: Candidates, given: Sequence[int] = ()) -> Beliefs:
    """Bayes factors of all effects; with `given` columns those of the effects beside these."""
    base = pool.log_factor(given) if len(given) else 0.0
    alone = pool.log_factors() if not len(given) and len(pool.gain) == pool.own else None
    forms: dict[tuple[str, str], float] = {}
    best: dict[str, Hypothesis] = {}
    for h in candidates.hypotheses:
        if set(h.columns) & set(given):
            continue
        if alone is not None and len(h.columns) == 1:
            factor = float(alone[h.columns[0]])
        else:
            factor = pool.log_factor([*given, *h.columns]) - base
        forms[h.effect, h.form] = factor + _one_sided(pool, h, candidates)
        kept = best.get(h.effect)
        if kept is None or forms[h.effect, h.form] > forms[kept.effect, kept.form]:
            best[h.effect] = h
    effects = {}
    for name in best:
        mine = [v for (effect, _), v in forms.items() if effect == name]
        effects[name] = float(np.logaddexp.reduce(mine) - np.log(len(mine)))
    probes = range(len(candidates.keys), pool.own)
    unknown = pool.log_factor([*given, *probes], UNKNOWN_SIZES) - base
    return Beliefs(effects, best, forms, unknown)


def _one_sided(pool: Pool, h: Hypothesis, candidates: Candidates) -> float:
    """Log factor of a prior that has one side only: twice the posterior's share on that side."""
    if len(h.columns) != 1:
        return 0.0
    i = h.columns[0]
    if candidates.low[i] < 0.0 < candidates.high[i]:
        return 0.0
    side = 1.0 if candidates.high[i] > 0.0 else -1.0
    z = side * float(pool.gain[i]) / math.sqrt(float(pool.information[i, i]) + 1.0 / WIDE**2)
    if z > -5.0:
        return math.log(math.erfc(-z / math.sqrt(2.0)))
    return -0.5 * z * z - math.log(-z * math.sqrt(0.5 * math.pi))  # the tail's leading term
