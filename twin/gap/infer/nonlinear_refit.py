"""Nonlinear refit: laws fitted through the twin itself, from several starting sizes.

A large effect is not its sensitivity times its size: a delay of a third of a second is no multiple of one of
15 ms. So each law is simulated at several sizes, the best by what remains in each channel is selected and
then improved: along the sensitivity, between the sizes tried, and by the soil of each run.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Hypothesis
from terrafusion.twin.gap.infer.channels import ChannelTable, Unexplained
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.infer.refit import Refit, RunWithEffects, effects_at, whitened_errors
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.null.null import Null
from terrafusion.twin.gap.null.score import Score, score_of_error
from terrafusion.twin.gap.rollout.delay import DELAYS
from terrafusion.twin.gap.rollout.residuals import soil_columns

Array = NDArray[np.float64]
Point = tuple[Hypothesis, Array]  # a law and sizes (k,) of its parameters, in typical ones

MULTIPLES = (0.4, 1.0, 2.0, 4.0)  # sizes tried, in that of the linear fit
SMALL, SIZES = 0.7, (1.0, 3.0, 8.0)
"""Below that size of the linear fit, these typical sizes are tried beside it."""
EXTRAPOLATE, MARGIN = 1.0, 0.05
"""Step beyond the last size, in the step to it; margin at the ends of an interval, as a share of it."""
AS_GOOD = 0.5  # excess that the size of weighted least squares may leave over the best one (assumed)
SAME_SIZE = 1e-3  # sizes closer than this, typical ones, are not tried again
ROUNDS, IMPROVED = 3, 5  # rounds of improvement, and how many of the best laws take part in them
DELAY_SHARES: tuple[float, ...] = (0.04, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Sizes of a delay that are tried on both sides, in that of its range: beyond half a period of the motion the
sensitivity is meaningless, and the shared run makes them cheap."""
REFINEMENTS = ((-0.3, -0.2, -0.1, 0.1, 0.2, 0.3), (-0.05, -0.025, 0.025, 0.05))
"""Relative offsets tried around the best size of a delay or of an insensitive law, in two rounds."""
INSENSITIVE = 10.0
"""A law is insensitive where its sensitivity, at the ends of its range, makes a smaller square in all runs;
32-bit rounding makes 3 at most (docs/how-to/gap.md)."""
INSENSITIVE_SHARES: tuple[float, ...] = (0.4, 0.7, 0.85, 1.0)
"""Sizes of an insensitive law that are tried, in that of its range: it acts beyond a threshold, if at all."""
SCREEN_SHARES = (0.12, 0.4)
"""Sizes, in that of its range, at which each law is tried on one run, as its linearisation may mislead
(assumed)."""
LEAST_GAIN = 0.5
"""By how much an insensitive law must reduce the gap for sizes near its best to be tried (assumed)."""
DIVERGED = "the twin diverges at every size tried, its linear value stands"


@dataclass(frozen=True, eq=False)
class LawFit:
    """One law at its best: the refit, what remains unexplained, and that of every size (k,) tried."""

    fit: Refit
    left: Unexplained
    tried: tuple[tuple[Array, float], ...]


def starting_sizes(value: Array, low: Array, high: Array) -> list[Array]:
    """Sizes (k,) to try for a linear fit (k,), within bounds."""
    length = float(np.linalg.norm(value))
    if length > SMALL:
        points = [multiple * value for multiple in MULTIPLES]
    else:
        direction = value / length if length > 0.05 else np.eye(len(value))[0]
        points = [length * direction, *(size * direction for size in SIZES)]
    inside = [np.clip(point, low, high) for point in points]
    return [p for i, p in enumerate(inside) if not any(np.array_equal(p, q) for q in inside[:i])]


def line_search_size(tried: Sequence[tuple[Array, float]], before: float) -> float:
    """Next size to try: the minimum of a parabola through the best size and its neighbours, or beyond the
    last.

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
        return at[i] + EXTRAPOLATE * (at[i] - at[1 if i == 0 else -2])
    a, b, c = at[i - 1 : i + 2]
    up, down = (cost[a] - cost[b]) / (b - a), (cost[c] - cost[b]) / (c - b)
    found = 0.5 * (a + b) + 0.5 * (c - a) * up / (up + down) if up + down > 0.0 else b
    if abs(found - b) < MARGIN * (c - a):
        found = b + 0.3 * max(c - b, a - b, key=abs)
    return float(np.clip(found, a + MARGIN * (b - a), c - MARGIN * (c - b)))


@dataclass(frozen=True, eq=False)
class NonlinearRefit:
    """Fits laws to the judged runs."""

    evidence: GapEvidence
    scores: Sequence[Score]
    sigma: Array
    null: Null
    pooled: PooledScores
    table: ChannelTable

    def screened(self) -> dict[Hypothesis, tuple[Array, float]]:
        """Laws of one parameter that change the motion: the best of a few sizes (1,) over their range, and
        what it leaves of the first judged run."""
        candidates = self.evidence.candidates
        points = [
            (law, share * end)
            for law in candidates.hypotheses
            if candidates.keys[law.columns[0]] in candidates.moving and len(law.columns) == 1
            for end in self._ends(law)
            for share in SCREEN_SHARES
        ]
        table = dataclasses.replace(self.table, columns=self.table.columns[:1], runs=self.table.runs[:1])
        soil = np.zeros(len(self.evidence.soil_limit))
        sets = [effects_at(self.evidence, law.columns, point) for law, point in points]
        errors = whitened_errors(self.evidence, [RunWithEffects(0, effects, soil) for effects in sets])
        out = dict[Hypothesis, tuple[Array, float]]()
        for (law, point), error in zip(points, errors, strict=True):
            if error is not None:
                left = table.unexplained(table.products([error])).total
                if law not in out or left < out[law][1]:
                    out[law] = point, left
        return out

    def fits(
        self, laws: Sequence[Point], further: Sequence[Point] = ()
    ) -> tuple[dict[Hypothesis, LawFit], dict[Hypothesis, Refit]]:
        """Fits of laws, given their linear fits (k,), also tried at `further` sizes; and failures of those
        with which the twin diverges at all sizes, with their linear value."""
        insensitive = [law for law, _ in laws if self.is_insensitive(law)]
        points = [
            (law, point)
            for law, value in laws
            if law not in insensitive
            for point in starting_sizes(value, *self.evidence.candidates.bounds(law.columns))
        ]
        delays = [law for law, _ in laws if self._is_delay(law)]
        for some, shares in ((delays, DELAY_SHARES), (insensitive, INSENSITIVE_SHARES)):
            points += [(law, share * end) for law in some for share in shares for end in self._ends(law)]
        best = self._try({}, [*points, *further])
        most = self.gap.total - LEAST_GAIN
        refine = delays + [law for law in insensitive if law in best and best[law].left.total < most]
        for shares in REFINEMENTS:
            found = {law: best[law].fit.value for law in refine if law in best}
            closer = [(law, (1.0 + share) * at) for law, at in found.items() for share in shares]
            best = self._try(best, [(law, self._inside(law, point)) for law, point in closer])
        best = self._improved(best)
        return best, {law: self._failed(law, value) for law, value in laws if law not in best}

    def single_fit(self, law: Hypothesis) -> LawFit | Refit:
        """One law by itself, or its failure."""
        value, _ = self.table.linear_fit(law.columns, *self.evidence.candidates.bounds(law.columns))
        best, failed = self.fits([(law, value)])
        return best[law] if law in best else failed[law]

    def joint_fits(self, found: LawFit, laws: Sequence[Hypothesis]) -> dict[Hypothesis, LawFit | Refit]:
        """Laws of several effects, whose first columns are those of `found`: from there, with the further
        ones at several sizes along their sensitivities in what remains; or their failures."""
        points = list[Point]()
        at, known = dict[Hypothesis, Array](), len(found.fit.columns)
        rest = self.table.products(found.fit.errors)
        for law in laws:
            low, high = self.evidence.candidates.bounds(law.columns)
            more, _ = self.table.linear_fit(law.columns[known:], low[known:], high[known:], rest)
            at[law] = np.append(found.fit.value, np.zeros(len(more)))
            step, _ = self.table.linear_fit(law.columns, low - at[law], high - at[law], rest)
            multiples = [np.append(found.fit.value, multiple * more) for multiple in MULTIPLES]
            points += [(law, self._inside(law, point)) for point in (at[law] + step, *multiples)]
        best = self._improved(self._try({}, points, dict.fromkeys(laws, found.fit.soils)))
        return {law: best[law] if law in best else self._failed(law, at[law]) for law in laws}

    @functools.cached_property
    def gap(self) -> Unexplained:
        """What remains with no law in the twin, each run on the soil that fits it so."""
        none = Hypothesis("", "", ())
        best = self._try({}, [(none, np.zeros(0))])
        for _ in range(ROUNDS if best else 0):
            best = self._on_fitted_soil(best)
        first = self.table.before()
        found = best[none].left if best else first
        return found if found.total < first.total else first

    def is_insensitive(self, law: Hypothesis) -> bool:
        """Whether the law's sensitivity vanishes, whatever its size."""
        at = np.asarray(law.columns)
        most = np.maximum(*np.abs(self.evidence.candidates.bounds(law.columns)))
        runs = self.table.runs
        squares = sum((r.gram.sum(axis=0).diagonal()[r.states + at] for r in runs), np.zeros(len(at)))
        return bool(squares @ most**2 < INSENSITIVE)

    def _is_delay(self, law: Hypothesis) -> bool:
        return all(self.evidence.candidates.keys[i] in DELAYS for i in law.columns)

    def _ends(self, law: Hypothesis) -> list[Array]:
        return [end for end in self.evidence.candidates.bounds(law.columns) if end.any()]

    def _inside(self, law: Hypothesis, point: Array) -> Array:
        return np.asarray(np.clip(point, *self.evidence.candidates.bounds(law.columns)))

    def _best(self, fits: Mapping[Hypothesis, LawFit], count: int = IMPROVED) -> list[Hypothesis]:
        return sorted(fits, key=lambda law: fits[law].left.total)[:count]

    def _improved(self, best: dict[Hypothesis, LawFit]) -> dict[Hypothesis, LawFit]:
        """The best laws, along their sensitivities from where they are, and between the sizes tried so
        far."""
        before, best = self.gap.total, self._on_fitted_soil(best, len(best))
        for _ in range(ROUNDS):
            first = self._best(best)
            points = [(law, self._gauss_newton(law, best[law])) for law in first]
            points += [
                (law, self._inside(law, np.array([line_search_size(best[law].tried, before)])))
                for law in first
                if len(law.columns) == 1
            ]
            new = [
                (law, point)
                for law, point in points
                if all(np.abs(point - size).max() > SAME_SIZE for size, _ in best[law].tried)
            ]
            if not new:
                break
            best = self._on_fitted_soil(self._try(best, new))
        return self._by_least_squares(best)

    def _gauss_newton(self, law: Hypothesis, found: LawFit) -> Array:
        low, high = self.evidence.candidates.bounds(law.columns)
        at, rest = found.fit.value, self.table.products(found.fit.errors)
        step, _ = self.table.linear_fit(law.columns, low - at, high - at, rest)
        return self._inside(law, at + step)

    def _on_fitted_soil(
        self, best: dict[Hypothesis, LawFit], count: int = IMPROVED
    ) -> dict[Hypothesis, LawFit]:
        """The best laws with each run on the soil that fits it beside them. Where the law is one of the soil
        itself, what the runs have in common belongs to the law."""
        table, limit, soil = self.table, self.evidence.soil_limit, soil_columns(self.evidence.candidates)
        soils, points = dict[Hypothesis, tuple[Array, ...]](), []
        for law in self._best(best, count):
            errors, weight = table.products(best[law].fit.errors), best[law].left.weight
            pairs = zip(table.runs, errors, strict=True)
            own = np.array([r.fitted_states(e, table.sigma, weight)[: len(limit)] for r, e in pairs])
            value = best[law].fit.value.copy()
            for k, i in enumerate(law.columns):
                if i in soil:
                    common = own[:, soil.index(i)].mean()
                    value[k] += common
                    own[:, soil.index(i)] -= common
            soils[law] = tuple(np.clip(own, -limit, limit))
            points.append((law, self._inside(law, value)))
        return self._try(best, points, soils)

    def _by_least_squares(self, best: dict[Hypothesis, LawFit]) -> dict[Hypothesis, LawFit]:
        """The best laws at the size of weighted least squares: the sum of logarithms identifies the law but
        is flat near its minimum, where channels are back at their floor."""
        points = []
        for law in self._best(best):
            fit, weight = best[law].fit, best[law].left.weight
            step = self.table.least_squares(law.columns, self.table.products(fit.errors), weight)
            points.append((law, self._inside(law, fit.value + step)))
        return self._try(best, points, tolerance=AS_GOOD)

    def _try(
        self,
        best: dict[Hypothesis, LawFit],
        points: Sequence[Point],
        soils: Mapping[Hypothesis, tuple[Array, ...]] | None = None,
        tolerance: float = 0.0,
    ) -> dict[Hypothesis, LawFit]:
        """The best fit of each law once these points are simulated.

        Args:
            soils: of the runs beside a law, in place of those of its fit; a law without a fit starts on that
                of the references, as a run's own fitted soil contains a part of the effect.
            tolerance: by how much more a point may leave and still be accepted.
        """
        if not points:
            return best
        evidence, count = self.evidence, len(self.evidence.runs)
        own = {law: (np.zeros(len(evidence.soil_limit)),) * count for law, _ in points}
        own |= {law: found.fit.soils for law, found in best.items()} | dict(soils or {})
        sets = [effects_at(evidence, law.columns, point) for law, point in points]
        tried = [
            RunWithEffects(run, effects, own[law][run])
            for (law, _), effects in zip(points, sets, strict=True)
            for run in range(count)
        ]
        errors, out = whitened_errors(evidence, tried), dict(best)
        for i, (law, point) in enumerate(points):
            mine = [error for error in errors[i * count : (i + 1) * count] if error is not None]
            if len(mine) < count:
                continue
            left = self.table.unexplained(self.table.products(mine))
            history = (*(out[law].tried if law in out else ()), (point, left.total))
            if law not in out or left.total < out[law].left.total + tolerance:
                out[law] = LawFit(self._refit(law, point, mine, own[law]), left, history)
            else:
                out[law] = dataclasses.replace(out[law], tried=history)
        return out

    def _refit(self, law: Hypothesis, value: Array, errors: list[Array], soils: tuple[Array, ...]) -> Refit:
        square, gain = 0.0, np.zeros(self.pooled.own)
        for run, first, error in zip(self.evidence.runs, self.scores, errors, strict=True):
            x, U = self.null.standardised(score_of_error(run, self.sigma, error, first.A))
            square += float(x @ self.null.inverse @ x)
            gain += np.diag(U) * x
        _, covariance, _ = self.pooled.fit(law.columns)
        squares = dataclasses.replace(self.pooled.marginal, gain=gain).squares()
        explained = self.pooled.square - square
        return Refit(law.columns, value, covariance, explained, errors, soils, squares, "")

    def _failed(self, law: Hypothesis, value: Array) -> Refit:
        _, covariance, _ = self.pooled.fit(law.columns)
        return Refit(law.columns, value, covariance, 0.0, [], (), np.zeros(0), DIVERGED)
