"""Fits through the twin itself, from several sizes up.

What an effect of real size does is not its signature times that size: a delay of a third of a second is no
multiple of one of 15 ms. A fit that starts where the signature suggests often ends there, at a loss. So each
law is driven at a ladder of sizes, the best of them is kept by what it leaves in each channel, and improved
along the signature.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.channels import Left, Table
from terrafusion.twin.gap.evidence import Bench
from terrafusion.twin.gap.late import DELAYS
from terrafusion.twin.gap.null import Null
from terrafusion.twin.gap.posterior import Pool
from terrafusion.twin.gap.refit import Refit, effects_at, errors_with, scored
from terrafusion.twin.gap.score import Score

Array = NDArray[np.float64]

LADDER = (0.4, 1.0, 2.0, 4.0)
"""Sizes tried, in that of the linear fit."""
SMALL, SIZES = 0.7, (1.0, 3.0, 8.0)
"""Below that size of the linear fit, in typical ones, those tried beside it."""
WITHIN = 0.98
"""Share of an effect's range that is tried."""
ROUNDS, IMPROVED = 2, 4
"""Rounds of improvement, and how many laws, the best ones, take part in them."""
LATE = (0.04, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Sizes of a delay that are tried on both sides, in that of its range: what fits beyond half a swing of the
drive has nothing to do with a signature, and no further run of the twin is needed."""
CLOSER = (0.2, 0.1, 0.05, 0.025)
"""Shares of the best delay by which others are tried on both sides of it, one after the other; and of the
best size of a silent law."""
SILENT = 1.0
"""A law is silent where its signature, at the ends of its range, makes a smaller square in all runs."""
SPREAD = (0.4, 0.7, 0.85, 1.0)
"""Sizes of a silent law that are tried, in that of its range: it acts beyond a threshold, if at all."""
SPEAKS = 0.5
"""By how much less than the gap a silent law must leave for sizes near its best to be tried (assumed)."""


DIVERGED = "the twin diverges at every size tried, its linear value stands"


@dataclass(frozen=True, eq=False)
class Fitted:
    """One law at its best: the fit, and what it leaves."""

    fit: Refit
    left: Left


def bounds(candidates: Candidates, columns: Sequence[int]) -> tuple[Array, Array]:
    """Least and greatest sizes (k,) of some columns, in typical ones."""
    at = np.asarray(columns)
    scale = candidates.scale[at]
    return WITHIN * candidates.low[at] / scale, WITHIN * candidates.high[at] / scale


def sizes(value: Array, low: Array, high: Array) -> list[Array]:
    """Points (k,) to try for a linear fit (k,), within bounds."""
    length = float(np.linalg.norm(value))
    if length > SMALL:
        points = [share * value for share in LADDER]
    else:
        way = value / length if length > 0.05 else np.eye(len(value))[0]
        points = [length * way, *(size * way for size in SIZES)]
    inside = [np.clip(point, low, high) for point in points]
    return [p for i, p in enumerate(inside) if not any(np.array_equal(p, q) for q in inside[:i])]


@dataclass(frozen=True, eq=False)
class Fitter:
    """Fits laws to the judged runs."""

    bench: Bench
    scores: Sequence[Score]
    sigma: Array
    null: Null
    pool: Pool
    table: Table

    def fits(
        self, laws: Sequence[tuple[Hypothesis, Array]]
    ) -> tuple[dict[Hypothesis, Fitted], dict[Hypothesis, Refit]]:
        """Laws with their linear fits (k,), side by side; and those with which the twin diverges at all
        sizes, as failures with their linear value."""
        silent = [law for law, _ in laws if self.silent(law)]
        ladder = [
            (law, point)
            for law, value in laws
            if law not in silent
            for point in sizes(value, *bounds(self.bench.candidates, law.columns))
        ]
        delays = [law for law, _ in laws if self._is_delay(law)]
        for law, shares in [*((law, LATE) for law in delays), *((law, SPREAD) for law in silent)]:
            ends = [end for end in bounds(self.bench.candidates, law.columns) if end.any()]
            ladder += [(law, share * end) for share in shares for end in ends]
        best = self._better({}, ladder)
        most = self.table.before().total - SPEAKS
        speak = delays + [law for law in silent if law in best and best[law].left.total < most]
        for share in CLOSER:
            found = {law: best[law].fit.value for law in speak if law in best}
            closer = [(law, (1.0 + way * share) * at) for law, at in found.items() for way in (-1.0, 1.0)]
            best = self._better(best, [(law, self._inside(law, point)) for law, point in closer])
        best = self._improved(best)
        return best, {law: self._failed(law, value) for law, value in laws if law not in best}

    def beside(self, found: Fitted, law: Hypothesis) -> Fitted | None:
        """A law of several effects, whose first columns are those of `found`: from there, the further ones at
        a ladder of sizes along their signatures in what is left; None where the twin diverges at all."""
        known = len(found.fit.columns)
        low, high = bounds(self.bench.candidates, law.columns)
        rest = self.table.products(found.fit.errors)
        more, _ = self.table.linear(law.columns[known:], low[known:], high[known:], rest)
        at = np.append(found.fit.value, np.zeros(len(more)))
        step, _ = self.table.linear(law.columns, low - at, high - at, rest)
        points = [at + step, *(np.append(found.fit.value, share * more) for share in LADDER)]
        best = self._better({}, [(law, self._inside(law, point)) for point in points])
        return self._improved(best).get(law)

    def _improved(self, best: dict[Hypothesis, Fitted]) -> dict[Hypothesis, Fitted]:
        """The best laws, along their signatures from where they are."""
        for _ in range(ROUNDS):
            first = sorted(best, key=lambda law: best[law].left.total)[:IMPROVED]
            steps = [(law, self._next(law, best[law])) for law in first]
            tried = [(law, point) for law, point in steps if np.abs(point - best[law].fit.value).max() > 1e-3]
            if not tried:
                break
            best = self._better(best, tried)
        return best

    def silent(self, law: Hypothesis) -> bool:
        """Whether the law's signature says nothing, whatever its size."""
        at = np.asarray(law.columns)
        most = np.maximum(*np.abs(bounds(self.bench.candidates, law.columns)))
        blocks = self.table.blocks
        squares = sum((b.gram.sum(axis=0).diagonal()[b.states + at] for b in blocks), np.zeros(len(at)))
        return bool(squares @ most**2 < SILENT)

    def _is_delay(self, law: Hypothesis) -> bool:
        return all(self.bench.candidates.keys[i] in DELAYS for i in law.columns)

    def _inside(self, law: Hypothesis, point: Array) -> Array:
        return np.asarray(np.clip(point, *bounds(self.bench.candidates, law.columns)))

    def _better(
        self, best: dict[Hypothesis, Fitted], points: Sequence[tuple[Hypothesis, Array]]
    ) -> dict[Hypothesis, Fitted]:
        if not points:
            return best
        sets = [effects_at(self.bench, law.columns, point) for law, point in points]
        bench = self.bench
        with ThreadPoolExecutor(bench.jobs) as threads:
            errors = list(threads.map(errors_with, repeat(bench), bench.runs, bench.raws, repeat(sets)))
        out = dict(best)
        for i, (law, point) in enumerate(points):
            own = [mine[i] for mine in errors]
            whole = [error for error in own if error is not None]
            if len(whole) < len(own):
                continue
            left = self.table.left(self.table.products(whole))
            if law not in out or left.total < out[law].left.total:
                out[law] = Fitted(self._fit(law, point, whole), left)
        return out

    def _failed(self, law: Hypothesis, value: Array) -> Refit:
        _, covariance, _ = self.pool.fit(law.columns)
        return Refit(law.columns, value, value, covariance, 0.0, [], DIVERGED)

    def _next(self, law: Hypothesis, found: Fitted) -> Array:
        low, high = bounds(self.bench.candidates, law.columns)
        at = found.fit.value
        step, _ = self.table.linear(law.columns, low - at, high - at, self.table.products(found.fit.errors))
        return self._inside(law, at + step)

    def _fit(self, law: Hypothesis, value: Array, errors: list[Array]) -> Refit:
        square = 0.0
        for run, first, error in zip(self.bench.runs, self.scores, errors, strict=True):
            x, _ = self.null.standardised(scored(run, self.sigma, error, first.A))
            square += float(x @ self.null.inverse @ x)
        _, covariance, _ = self.pool.fit(law.columns)
        return Refit(law.columns, value, value, covariance, self.pool.square - square, errors, "")
