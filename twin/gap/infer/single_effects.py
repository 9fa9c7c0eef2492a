"""Sum of single effects (Wang, Sarkar, Carbonetto and Stephens 2020): which laws, alone and together.

A law is a set of patches, on each of which its signature is affine in its sizes: pieces of its ladder, or the
columns of a linear one. The evidence of laws together is their likelihood at the best sizes times the share
of the prior that is as good (Laplace). A law is never quite the robot's: its signature times functions of the
commands joins the covariance, in proportion to its size (after Kennedy and O'Hagan 2001).
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import SMALLEST, Candidates, Hypothesis
from terrafusion.twin.gap.infer.bank import Ladder, is_simulated
from terrafusion.twin.gap.infer.predictive import Metric

RIDGE = 1e-3  # information on a size before the runs (assumed): 1 sigma is 30 typical sizes
SWEEPS, ENOUGH = 25, 1e-3  # most rounds of a joint fit, and the gain that ends it


@dataclass(frozen=True, eq=False)
class Fitted:
    """Laws at their best sizes.

    Attributes:
        laws: each.
        values: (k,) of each, in typical sizes.
        used: (M + 1,) coefficients of all columns that their signatures are made of.
        gain: log likelihood ratio.
        evidence: log evidence.
        covariance: (k, k) of each one's values.
        left: excess of what they leave (`predictive.excess`); zero without a close look.
    """

    laws: tuple[Hypothesis, ...]
    values: tuple[Array, ...]
    used: Array
    gain: float
    evidence: float
    covariance: tuple[Array, ...]
    left: float = 0.0

    @property
    def columns(self) -> tuple[int, ...]:
        """Of all laws, one after the other."""
        return tuple(i for law in self.laws for i in law.columns)


@dataclass(frozen=True, eq=False)
class Laws:
    """All laws as patches.

    Attributes:
        names: of the laws.
        law: (N,) index of the law of each piece of a ladder.
        column, size: (N, 2) column of the metric and size at both ends of it.
        planes: columns and bounds of each linear law.
    """

    candidates: Candidates
    names: tuple[Hypothesis, ...]
    law: NDArray[np.int64]
    column: NDArray[np.int64]
    size: Array
    planes: Mapping[int, tuple[NDArray[np.int64], Array, Array]]

    @classmethod
    def of(cls, candidates: Candidates, ladders: Mapping[Hypothesis, Ladder], shared: int, none: int) -> Self:
        """The candidates' laws; of those that have no ladder and are not linear there is no patch."""
        law, column, size = list[int](), list[tuple[int, int]](), list[tuple[float, float]]()
        planes = dict[int, tuple[NDArray[np.int64], Array, Array]]()
        for i, h in enumerate(candidates.hypotheses):
            if h in ladders:
                at, signatures = ladders[h]
                size += itertools.pairwise(at)
                column += itertools.pairwise(none if c < 0 else shared + c for c in signatures)
                law += [i] * (len(at) - 1)
            elif not is_simulated(h, candidates):
                planes[i] = (np.array(h.columns), *candidates.bounds(h.columns))
        columns, sizes = np.array(column, dtype=int).reshape(-1, 2), np.array(size).reshape(-1, 2)
        return cls(candidates, candidates.hypotheses, np.array(law, dtype=int), columns, sizes, planes)

    def only(self, i: int) -> Self:
        """One law."""
        mine, planes = self.law == i, {k: v for k, v in self.planes.items() if k == i}
        return dataclasses.replace(
            self, law=self.law[mine], column=self.column[mine], size=self.size[mine], planes=planes
        )

    def best(self, m: Metric, beside: Array | None = None) -> tuple[Array, list[Array], list[Array]]:
        """Every law at its best: gain of the log likelihood, values (k,) and coefficients (M + 1,).

        Args:
            beside: (M + 1,) coefficients of other laws, which explain a part of the error; None: none.
        """
        K, count = m.K, len(self.names)
        rest = K[:, m.error] if beside is None else K[:, m.error] - K @ beside
        gains = np.full(count, -np.inf)
        values, used = [np.zeros(len(h.columns)) for h in self.names], [np.zeros(len(K))] * count
        a, b = self.column[:, 0], self.column[:, 1]
        linear = rest[b] - rest[a] - (K[a, b] - K[a, a])
        square = np.maximum(K[b, b] - 2.0 * K[a, b] + K[a, a], 1e-9)
        t = np.clip(linear / square, 0.0, 1.0)
        gain = rest[a] - 0.5 * K[a, a] + linear * t - 0.5 * square * t * t
        order = np.argsort(gain, kind="stable")
        for i, n in dict(zip(self.law[order], order, strict=True)).items():  # the best piece of a law is last
            gains[i], values[i] = gain[n], np.full(len(values[i]), self.size[n] @ (1.0 - t[n], t[n]))
            used[i] = np.zeros(len(K))
            np.add.at(used[i], self.column[n], (1.0 - t[n], t[n]))
            used[i][m.none] = 0.0
        for i, (columns, low, high) in self.planes.items():
            H = K[np.ix_(columns, columns)]
            values[i] = x = np.clip(np.linalg.solve(H + RIDGE * np.eye(len(H)), rest[columns]), low, high)
            gains[i] = x @ rest[columns] - 0.5 * x @ H @ x
            used[i] = np.zeros(len(K))
            used[i][columns] = x
        return gains, values, used

    def fit(self, m: Metric, laws: Sequence[int]) -> Fitted:
        """Some laws together: each in turn at its best beside the others."""
        K, e, part = m.K, m.error, [self.only(i) for i in laws]
        used, values = [np.zeros(len(K))] * len(laws), [np.zeros(len(self.names[i].columns)) for i in laws]
        gain, total = -np.inf, np.zeros(len(K))
        for _ in range(SWEEPS if len(laws) > 1 else 1):
            for k, i in enumerate(laws):
                _, v, w = part[k].best(m, total - used[k])
                total = total - used[k] + w[i]
                used[k], values[k] = w[i], v[i]
            before, gain = gain, float(total @ K[:, e] - 0.5 * total @ K @ total)
            if gain - before < ENOUGH:
                break
        prior, covariance = self._prior_share(m, laws, values)
        return Fitted(
            tuple(self.names[i] for i in laws), tuple(values), total, gain, gain + prior, covariance
        )

    def _prior_share(
        self, m: Metric, laws: Sequence[int], values: Sequence[Array]
    ) -> tuple[float, tuple[Array, ...]]:
        """Log of the share of the prior of the sizes that is as good as the best, and the covariance of each
        law's. The prior is uniform in the logarithm of the size, from `SMALLEST` on."""
        C = [self._slope(m, i, v) for i, v in zip(laws, values, strict=True)]
        H = np.column_stack(C).T @ m.K @ np.column_stack(C)
        H += RIDGE * np.eye(len(H))
        share, at, out = -0.5 * float(np.linalg.slogdet(H)[1]), 0, list[Array]()
        inverse: Array = np.asarray(np.linalg.inv(H), dtype=np.float64)
        for i, v, c in zip(laws, values, C, strict=True):
            k, size = c.shape[1], max(float(np.linalg.norm(v)), SMALLEST)
            low, high = self.candidates.bounds(self.names[i].columns)
            span = math.log(max(float(np.maximum(-low, high).max()), 1.0) / SMALLEST)
            sides = 2.0 if (low < 0.0).any() and (high > 0.0).any() else 1.0
            area = sides * size if k == 1 else 2.0 * math.pi * size**2
            share += 0.5 * k * math.log(2.0 * math.pi) - math.log(area * span)
            mine = inverse[at : at + k, at : at + k]
            out.append(mine if k == len(v) else np.full((len(v), len(v)), mine[0, 0]))
            at += k
        return min(share, 0.0), tuple(out)

    def _slope(self, m: Metric, i: int, value: Array) -> Array:
        """Coefficients (M + 1, k) of the derivative of a law's signature by its sizes."""
        if i in self.planes:
            out = np.zeros((len(m.K), len(value)))
            out[self.planes[i][0], np.arange(len(value))] = 1.0
            return out
        out, mine = np.zeros((len(m.K), 1)), np.flatnonzero(self.law == i)
        if not len(mine):
            return out
        x = float(value[0])
        n = min(mine, key=lambda n: max(self.size[n, 0] - x, x - self.size[n, 1]))
        step = self.size[n, 1] - self.size[n, 0]
        np.add.at(out[:, 0], self.column[n], (-1.0 / step, 1.0 / step))
        out[m.none] = 0.0
        return out
