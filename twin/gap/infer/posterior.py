"""Bayes factors of every effect against the learned null, and against a gap of unknown shape.

Under effect k the standardised scores of all runs shift along one direction a parameter, x = U_k phi + noise,
with phi ~ N(0, s^2) and s spread over a decade; forms are alternatives of equal weight, each with a model
discrepancy. An unknown cause shifts them along the whole nuisance basis.
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

SIZES = (0.1, 0.3, 1.0, 3.0, 10.0)  # 1 sigma of an effect's size, in typical sizes; equal weights
WIDE = 10.0  # 1 sigma of an effect's size where it is fitted: the data decide
UNKNOWN_SIZES = (0.3, 1.0, 3.0, 10.0)
DISCREPANCY_SIGMA = 0.1  # 1 sigma of the model discrepancy, in the effect's size (tuned on twin trials)


@dataclass(frozen=True, eq=False)
class MarginalScores:
    """Each column by its own score alone, where `PooledScores` is joint.

    Where effects scatter from run to run, the covariance of all scores is poorly known from a few references.

    Attributes:
        gain: (P,) sum of u x, with u the change of a column's own score by it.
        moved: (P, P) its change by the columns.
        variance: (P,) sum of u^2 times the variance of x.
        typical: (P,) typical square of a deviation among all runs.
        scatter: (P,) that in references judged by others, at least one.
    """

    gain: Array
    moved: Array
    variance: Array
    typical: Array
    scatter: Array

    @classmethod
    def none(cls, P: int) -> MarginalScores:
        """Of no run."""
        return cls(np.zeros(P), np.zeros((P, P)), np.full(P, 1e-9), np.ones(P), np.ones(P))

    @classmethod
    def of(cls, x: Array, U: Array, null: Null) -> MarginalScores:
        """Of one run's standardised scores (P,) and their change by the columns (P, P)."""
        own = np.diag(U)
        ones = np.ones(len(x))
        return cls(own * x, own[:, None] * U, own**2 * np.diag(null.covariance), ones, ones)

    def plus(self, other: MarginalScores, sign: float = 1.0) -> MarginalScores:
        """With the runs of another one added, or removed (sign -1)."""
        return MarginalScores(
            self.gain + sign * other.gain, self.moved + sign * other.moved,
            self.variance + sign * other.variance, self.typical, self.scatter,
        )  # fmt: skip

    def squares(self, columns: Sequence[int] = (), value: Array | None = None) -> Array:
        """Squares (P,) of the deviations, in typical ones, with some columns (k,) subtracted at a value."""
        rest = self.gain if value is None else self.gain - self.moved[:, list(columns)] @ value
        return np.asarray(rest**2 / (np.maximum(self.variance, 1e-9) * self.typical))

    def sigmas(self, columns: Sequence[int]) -> Array:
        """1 sigma (k,) of sizes by each column's own score, as these scatter in the references."""
        at = list(columns)
        moved = np.maximum(np.diag(self.moved)[at], 1e-9)
        return np.minimum(np.sqrt(self.variance[at] * self.scatter[at]) / moved, WIDE)


@dataclass(frozen=True, eq=False)
class PooledScores:
    """All judged runs together against a null, in the space of the columns.

    Attributes:
        information: (M, M) sum of U' C^-1 U; the first P columns are those of the candidates and the nuisance
            basis, then come F columns of model discrepancy for each of the K candidates, where the scores
            have it.
        gain: (M,) sum of U' C^-1 x.
        square: sum of x' C^-1 x.
        own: P.
        marginal: the same by each column's own score.
    """

    information: Array
    gain: Array
    square: float
    own: int
    marginal: MarginalScores

    @classmethod
    def of(cls, runs: Sequence[Score], null: Null) -> PooledScores:
        """Sums over the runs."""
        P, square = len(null.mean), 0.0
        extra = 0 if runs[0].discrepancy is None else runs[0].discrepancy[0].size
        information, gain = np.zeros((P + extra, P + extra)), np.zeros(P + extra)
        marginal = MarginalScores.none(P)
        for run in runs:
            x, U = null.standardised(run)
            marginal = marginal.plus(MarginalScores.of(x, U, null))
            if run.discrepancy is not None:
                root = 1.0 / np.sqrt(np.diag(run.A) + 1.0)
                U = np.hstack([U, root[:, None] * run.discrepancy.reshape(P, -1)])
            weighted = null.inverse @ U
            information += U.T @ weighted
            gain += weighted.T @ x
            square += float(x @ null.inverse @ x)
        return cls(0.5 * (information + information.T), gain, square, P, marginal)

    @classmethod
    def sum(cls, parts: Sequence[PooledScores]) -> PooledScores:
        """Those of all runs together."""
        return cls(
            sum((p.information for p in parts), np.zeros_like(parts[0].information)),
            sum((p.gain for p in parts), np.zeros_like(parts[0].gain)),
            sum(p.square for p in parts), parts[0].own,
            functools.reduce(MarginalScores.plus, (p.marginal for p in parts)),
        )  # fmt: skip

    def without_discrepancy(self) -> PooledScores:
        """The same without the columns of model discrepancy."""
        P = self.own
        return dataclasses.replace(self, information=self.information[:P, :P], gain=self.gain[:P])

    def with_scatter(self, typical: Array, scatter: Array) -> PooledScores:
        """The same with `MarginalScores.typical` and `scatter`."""
        marginal = dataclasses.replace(self.marginal, typical=typical, scatter=scatter)
        return dataclasses.replace(self, marginal=marginal)

    def without(self, other: PooledScores) -> PooledScores:
        """Those of the runs that `other` does not have."""
        return PooledScores(
            self.information - other.information, self.gain - other.gain, self.square - other.square,
            self.own, self.marginal.plus(other.marginal, -1.0),
        )  # fmt: skip

    def _with_discrepancy(self, columns: Sequence[int]) -> tuple[NDArray[np.int64], Array]:
        """The columns with those of the model discrepancy of the candidates among them, and 1 sigma of each
        in that of the candidate's size."""
        F = len(FUNCTIONS)
        candidates = (len(self.gain) - self.own) // F
        more = [self.own + i * F + j for i in columns if i < candidates for j in range(F)]
        weights = np.repeat([1.0, DISCREPANCY_SIGMA], [len(columns), len(more)])
        return np.array([*columns, *more], dtype=np.int64), weights

    def log_factor(self, columns: Sequence[int], sizes: Sequence[float] = SIZES) -> float:
        """Log Bayes factor of the columns, N(0, s^2) with s over `sizes`, against the null."""
        at, weights = self._with_discrepancy(columns)
        g = self.gain[at] * weights
        values, vectors = np.linalg.eigh(self.information[np.ix_(at, at)] * weights[:, None] * weights)
        values, h = np.maximum(values, 0.0), vectors.T @ g
        each = [
            0.5 * float(np.sum(h**2 * s * s / (1.0 + s * s * values) - np.log1p(s * s * values)))
            for s in sizes
        ]
        return float(np.logaddexp.reduce(each) - np.log(len(each)))

    def log_factors(self) -> Array:
        """`log_factor` (P,) of each column by itself, without model discrepancy."""
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
        return best, covariance, self.explained_by(at, best)

    def explained_by(self, columns: Sequence[int] | NDArray[np.int64], value: Array) -> float:
        """How much of `square` some columns explain at a value (k,)."""
        at = np.asarray(columns, dtype=np.int64)
        return float(2.0 * value @ self.gain[at] - value @ self.information[np.ix_(at, at)] @ value)


@dataclass(frozen=True, eq=False)
class BayesFactors:
    """Log Bayes factors against the null: by effect, its best form, and by form."""

    effects: dict[str, float]
    best: dict[str, Hypothesis]
    forms: dict[tuple[str, str], float]


def bayes_factors(pooled: PooledScores, candidates: Candidates, given: Sequence[int] = ()) -> BayesFactors:
    """Bayes factors of all effects; with `given` columns, those of further effects beside these."""
    base = pooled.log_factor(given) if len(given) else 0.0
    single = pooled.log_factors() if not len(given) and len(pooled.gain) == pooled.own else None
    forms: dict[tuple[str, str], float] = {}
    best: dict[str, Hypothesis] = {}
    for h in candidates.hypotheses:
        if set(h.columns) & set(given):
            continue
        if single is not None and len(h.columns) == 1:
            factor = float(single[h.columns[0]])
        else:
            factor = pooled.log_factor([*given, *h.columns]) - base
        forms[h.effect, h.form] = factor + _one_sided(pooled, h, candidates)
        previous = best.get(h.effect)
        if previous is None or forms[h.effect, h.form] > forms[previous.effect, previous.form]:
            best[h.effect] = h
    effects = {}
    for name in best:
        mine = [v for (effect, _), v in forms.items() if effect == name]
        effects[name] = float(np.logaddexp.reduce(mine) - np.log(len(mine)))
    return BayesFactors(effects, best, forms)


def _one_sided(pooled: PooledScores, h: Hypothesis, candidates: Candidates) -> float:
    """Log factor of a one-sided prior: twice the posterior's share on that side."""
    if len(h.columns) != 1:
        return 0.0
    i = h.columns[0]
    if candidates.low[i] < 0.0 < candidates.high[i]:
        return 0.0
    side = 1.0 if candidates.high[i] > 0.0 else -1.0
    z = side * float(pooled.gain[i]) / math.sqrt(float(pooled.information[i, i]) + 1.0 / WIDE**2)
    if z > -5.0:
        return math.log(math.erfc(-z / math.sqrt(2.0)))
    return -0.5 * z * z - math.log(-z * math.sqrt(0.5 * math.pi))  # the tail's leading term
