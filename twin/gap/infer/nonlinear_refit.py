"""Fits through the twin itself, from several sizes up.

What an effect of real size does is not its signature times that size: a delay of a third of a second is no
multiple of one of 15 ms. A fit that starts where the signature suggests often ends there, at a loss. So each
law is driven at a ladder of sizes, the best of them is kept by what it leaves in each channel, and improved:
along the signature, between the sizes tried, and by the ground on which each run is beside the law.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.channels import Left, Table
from terrafusion.twin.gap.infer.evidence import Bench
from terrafusion.twin.gap.infer.posterior import Pool
from terrafusion.twin.gap.infer.refit import Refit, Tried, effects_at, errors_of, scored
from terrafusion.twin.gap.null.null import Null
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.delay import DELAYS
from terrafusion.twin.gap.rollout.residuals import SOIL_STATE, WITHIN

Array = NDArray[np.float64]

LADDER = (0.4, 1.0, 2.0, 4.0)
"""Sizes tried, in that of the linear fit."""
SMALL, SIZES = 0.7, (1.0, 3.0, 8.0)
"""Below that size of the linear fit, in typical ones, those tried beside it."""
FURTHER, NEAR = 1.0, 0.05
"""How far beyond the last size the next is tried, in the step to it; shares of an interval that are taken
for its ends."""
AS_GOOD = 0.5
"""What the size of weighted least squares may leave more than the best one (assumed)."""
SAME_SIZE = 1e-3
"""Sizes that are no nearer, typical ones, are tried apart."""
ROUNDS, IMPROVED = 3, 5
"""Rounds of improvement, and how many laws, the best ones, take part in them."""
LATE = (0.04, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Sizes of a delay that are tried on both sides, in that of its range: what fits beyond half a swing of the
drive has nothing to do with a signature, and no further run of the twin is needed."""
CLOSER = ((-0.3, -0.2, -0.1, 0.1, 0.2, 0.3), (-0.05, -0.025, 0.025, 0.05))
"""Shares of the best delay by which others are tried on both sides of it, those near the best of these after
them; and of the best size of a silent law."""
SILENT = 10.0
"""A law is silent where its signature, at the ends of its range, makes a smaller square in all runs; what
numbers of 32 bits round away makes 3 at most (docs/gap.md)."""
SPREAD = (0.4, 0.7, 0.85, 1.0)
"""Sizes of a silent law that are tried, in that of its range: it acts beyond a threshold, if at all."""
SCREEN = (0.12, 0.4)
"""Sizes, in that of its range, at which each law is tried on one run, as its first order may mislead
(assumed)."""
SPEAKS = 0.5
"""By how much less than the gap a silent law must leave for sizes near its best to be tried (assumed)."""


DIVERGED = "the twin diverges at every size tried, its linear value stands"


@dataclass(frozen=True, eq=False)
class Fitted:
    """One law at its best: the fit, what it leaves, and what any size (k,) that was tried left."""

    fit: Refit
    left: Left
    tried: tuple[tuple[Array, float], ...]


def bounds(candidates: Candidates, columns: Sequence[int]) -> tuple[Array, Array]:
    """Least and greatest sizes (k,) of some columns, in typical ones."""
    at = np.asarray(columns, dtype=np.int64)
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


def between(tried: Sequence[tuple[Array, float]], before: float) -> float:
    """A size beside the best so far: where a parabola through it and its neighbours is least, or beyond it.

    Args:
        tried: sizes (1,) and what they leave.
        before: what size zero leaves.
    """
    cost = {0.0: before}
    for size, left in tried:
        cost[float(size[0])] = min(left, cost.get(float(size[0]), left))
    at = sorted(cost)
    i = min(range(len(at)), key=lambda k: cost[at[k]])
    if i in (0, len(at) - 1):
        return at[i] + FURTHER * (at[i] - at[1 if i == 0 else -2])
    a, b, c = at[i - 1 : i + 2]
    up, down = (cost[a] - cost[b]) / (b - a), (cost[c] - cost[b]) / (c - b)
    found = 0.5 * (a + b) + 0.5 * (c - a) * up / (up + down) if up + down > 0.0 else b
    if abs(found - b) < NEAR * (c - a):
        found = b + 0.3 * max(c - b, a - b, key=abs)
    return float(np.clip(found, a + NEAR * (b - a), c - NEAR * (c - b)))


@dataclass(frozen=True, eq=False)
class Fitter:
    """Fits laws to the judged runs."""

    bench: Bench
    scores: Sequence[Score]
    sigma: Array
    null: Null
    pool: Pool
    table: Table

    def screened(self) -> dict[Hypothesis, tuple[Array, float]]:
        """Laws of one parameter that move the robot: the best of a few sizes (1,) over their range, and what
        it leaves of the first judged run."""
        candidates, bench = self.bench.candidates, self.bench
        moving = [
            law for law in candidates.hypotheses if candidates.keys[law.columns[0]] in candidates.moving
        ]
        points = [
            (law, share * end)
            for law in moving
            if len(law.columns) == 1
            for end in bounds(candidates, law.columns)
            if end.any()
            for share in SCREEN
        ]
        table = dataclasses.replace(self.table, columns=self.table.columns[:1], blocks=self.table.blocks[:1])
        ground = np.zeros(len(bench.reach))
        errors = errors_of(
            bench, [Tried(0, effects_at(bench, law.columns, point), ground) for law, point in points]
        )
        out = dict[Hypothesis, tuple[Array, float]]()
        for (law, point), error in zip(points, errors, strict=True):
            if error is not None:
                left = table.left(table.products([error])).total
                if law not in out or left < out[law][1]:
                    out[law] = point, left
        return out

    def fits(
        self,
        laws: Sequence[tuple[Hypothesis, Array]],
        further: Sequence[tuple[Hypothesis, Array]] = (),
    ) -> tuple[dict[Hypothesis, Fitted], dict[Hypothesis, Refit]]:
        """Laws with their linear fits (k,), side by side, and at `further` sizes; and those with which the
        twin diverges at all sizes, as failures with their linear value."""
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
        best = self._better({}, [*ladder, *further])
        most = self.gap.total - SPEAKS
        speak = delays + [law for law in silent if law in best and best[law].left.total < most]
        for shares in CLOSER:
            found = {law: best[law].fit.value for law in speak if law in best}
            closer = [(law, (1.0 + share) * at) for law, at in found.items() for share in shares]
            best = self._better(best, [(law, self._inside(law, point)) for law, point in closer])
        best = self._improved(best)
        return best, {law: self._failed(law, value) for law, value in laws if law not in best}

    def alone(self, law: Hypothesis) -> Fitted | Refit:
        """One law by itself, or its failure."""
        value, _ = self.table.linear(law.columns, *bounds(self.bench.candidates, law.columns))
        best, failed = self.fits([(law, value)])
        return best[law] if law in best else failed[law]

    def beside(self, found: Fitted, laws: Sequence[Hypothesis]) -> dict[Hypothesis, Fitted | Refit]:
        """Laws of several effects, whose first columns are those of `found`: from there, the further ones at
        a ladder of sizes along their signatures in what is left; or their failures."""
        points = list[tuple[Hypothesis, Array]]()
        at, known = dict[Hypothesis, Array](), len(found.fit.columns)
        rest = self.table.products(found.fit.errors)
        for law in laws:
            low, high = bounds(self.bench.candidates, law.columns)
            more, _ = self.table.linear(law.columns[known:], low[known:], high[known:], rest)
            at[law] = np.append(found.fit.value, np.zeros(len(more)))
            step, _ = self.table.linear(law.columns, low - at[law], high - at[law], rest)
            tried = [at[law] + step, *(np.append(found.fit.value, share * more) for share in LADDER)]
            points += [(law, self._inside(law, point)) for point in tried]
        best = self._improved(self._better({}, points, dict.fromkeys(laws, found.fit.grounds)))
        return {law: best[law] if law in best else self._failed(law, at[law]) for law in laws}

    def _improved(self, best: dict[Hypothesis, Fitted]) -> dict[Hypothesis, Fitted]:
        """The best laws, along their signatures from where they are, and between the sizes tried so far."""
        before, best = self.gap.total, self._on_their_ground(best, len(best))
        for _ in range(ROUNDS):
            first = sorted(best, key=lambda law: best[law].left.total)[:IMPROVED]
            steps = [(law, self._next(law, best[law])) for law in first]
            steps += [
                (law, self._inside(law, np.array([between(best[law].tried, before)])))
                for law in first
                if len(law.columns) == 1
            ]
            tried = [
                (law, point)
                for law, point in steps
                if all(np.abs(point - size).max() > SAME_SIZE for size, _ in best[law].tried)
            ]
            if not tried:
                break
            best = self._on_their_ground(self._better(best, tried))
        return self._by_squares(best)

    def _on_their_ground(
        self, best: dict[Hypothesis, Fitted], count: int = IMPROVED
    ) -> dict[Hypothesis, Fitted]:
        """The best laws with each run on the ground that suits it beside them: without the effect it looked
        otherwise. Where the law is one of the ground itself, what the runs have in common is the law's."""
        table, keys, most = self.table, self.bench.candidates.keys, self.bench.reach
        grounds, points = dict[Hypothesis, tuple[Array, ...]](), []
        soil = [keys.index(name) for name in SOIL_STATE if name in keys]
        for law in sorted(best, key=lambda law: best[law].left.total)[:count]:
            errors, weight = table.products(best[law].fit.errors), best[law].left.weight
            pairs = zip(table.blocks, errors, strict=True)
            own = np.array([b.adapted(e, table.sigma, weight)[: len(most)] for b, e in pairs])
            value = best[law].fit.value.copy()
            for k, i in enumerate(law.columns):
                if i in soil:
                    common = own[:, soil.index(i)].mean()
                    value[k] += common
                    own[:, soil.index(i)] -= common
            grounds[law] = tuple(np.clip(own, -most, most))
            points.append((law, self._inside(law, value)))
        return self._better(best, points, grounds)

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
        self,
        best: dict[Hypothesis, Fitted],
        points: Sequence[tuple[Hypothesis, Array]],
        grounds: Mapping[Hypothesis, tuple[Array, ...]] | None = None,
        worse: float = 0.0,
    ) -> dict[Hypothesis, Fitted]:
        """The best of each law once these points are tried, too.

        Args:
            grounds: other grounds of the runs beside a law than those that it has; to begin with it has that
                of the references, as what a run takes for its own holds a part of the effect.
            worse: by how much more a point may leave to be taken.
        """
        if not points:
            return best
        bench, own = self.bench, {law: found.fit.grounds for law, found in best.items()} | dict(grounds or {})
        sets = [effects_at(bench, law.columns, point) for law, point in points]
        own = {law: (np.zeros(len(bench.reach)),) * len(bench.runs) for law, _ in points} | own
        count = len(bench.runs)
        errors = errors_of(
            bench,
            [
                Tried(run, some, own[law][run])
                for (law, _), some in zip(points, sets, strict=True)
                for run in range(count)
            ],
        )
        out = dict(best)
        for i, (law, point) in enumerate(points):
            mine = errors[i * count : (i + 1) * count]
            whole = [error for error in mine if error is not None]
            if len(whole) < len(mine):
                continue
            left = self.table.left(self.table.products(whole))
            tried = (*(out[law].tried if law in out else ()), (point, left.total))
            if law not in out or left.total < out[law].left.total + worse:
                out[law] = Fitted(self._fit(law, point, whole, own[law]), left, tried)
            else:
                out[law] = dataclasses.replace(out[law], tried=tried)
        return out

    @functools.cached_property
    def gap(self) -> Left:
        """What is left with no law in the twin, each run on the ground that suits it so."""
        none = Hypothesis("", "", ())
        best = self._better({}, [(none, np.zeros(0))])
        for _ in range(ROUNDS if best else 0):
            best = self._on_their_ground(best)
        first = self.table.before()
        found = best[none].left if best else first
        return found if found.total < first.total else first

    def _by_squares(self, best: dict[Hypothesis, Fitted]) -> dict[Hypothesis, Fitted]:
        """The best laws at the size of weighted least squares: logarithms say which law it is, but are flat
        near their least sum, where channels are back at their floor."""
        points = []
        for law in sorted(best, key=lambda law: best[law].left.total)[:IMPROVED]:
            found = best[law]
            step = self.table.solved(law.columns, self.table.products(found.fit.errors), found.left.weight)
            points.append((law, self._inside(law, found.fit.value + step)))
        return self._better(best, points, worse=AS_GOOD)

    def _failed(self, law: Hypothesis, value: Array) -> Refit:
        _, covariance, _ = self.pool.fit(law.columns)
        return Refit(law.columns, value, covariance, 0.0, [], (), np.zeros(0), DIVERGED)

    def _next(self, law: Hypothesis, found: Fitted) -> Array:
        low, high = bounds(self.bench.candidates, law.columns)
        at = found.fit.value
        step, _ = self.table.linear(law.columns, low - at, high - at, self.table.products(found.fit.errors))
        return self._inside(law, at + step)

    def _fit(self, law: Hypothesis, value: Array, errors: list[Array], grounds: tuple[Array, ...]) -> Refit:
        square, gain = 0.0, np.zeros(self.pool.own)
        for run, first, error in zip(self.bench.runs, self.scores, errors, strict=True):
            x, U = self.null.standardised(scored(run, self.sigma, error, first.A))
            square += float(x @ self.null.inverse @ x)
            gain += np.diag(U) * x
        _, covariance, _ = self.pool.fit(law.columns)
        squares = dataclasses.replace(self.pool.alone, gain=gain).squares()
        return Refit(law.columns, value, covariance, self.pool.square - square, errors, grounds, squares, "")
