"""From Bayes factors, refits and shares to a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import SOIL, Candidates, Hypothesis
from terrafusion.twin.gap.classes import class_of
from terrafusion.twin.gap.posterior import WIDE, Beliefs, Pool, beliefs
from terrafusion.twin.gap.refit import Refit

Array = NDArray[np.float64]

TEMPER, LEFT_OVER = 0.2, 40.0
"""Power of the Bayes factors in the posterior, and the square left over that halves it (a quasi-likelihood:
where the candidates' laws do not fit, the evidence between them is worth less). Tuned on twin trials."""
ENOUGH, ENOUGH_WIDTH = 0.6, 0.1
"""An unknown cause is as likely as not where all effects named explain this share of the gap on runs left
out; and the width of that judgement (tuned on twin trials)."""
UNKNOWN_PART = 0.1
"""It is also one where the log Bayes factor of a dependence on the input, beside all effects named, is above
this part of theirs (tuned on twin trials)."""
SECOND_FACTOR, SECOND_SHARE = 20.0, 0.08
"""Log Bayes factor that a further effect must have beside those found, and all together over one effect with
a law of another form; and the share of the gap on runs left out that it must explain more (tuned on twin
trials)."""
RIDGES = (0.3, 1.0, 3.0)
"""1 sigma of all columns and probes together, in typical sizes."""
MOST_EFFECTS = 3


@dataclass(frozen=True, eq=False)
class Cause:
    """One candidate: its class, probability, best columns, their values (k,) with 1 sigma, in units of
    `Candidates.scale`, and its share of the gap."""

    effect: str
    members: tuple[str, ...]
    probability: float
    columns: tuple[int, ...]
    value: Array
    sigma: Array
    share: float | None


@dataclass(frozen=True, eq=False)
class Verdict:
    """The judgement, its named effects and all causes, most probable first."""

    kind: str
    named: tuple[str, ...]
    causes: list[Cause]
    p_null: float
    p_unknown: float
    fit: Refit | None


def null_probability(p_value: float) -> float:
    """Least posterior probability of no gap at even odds (Sellke, Bayarri and Berger 2001, eq. 3)."""
    if p_value >= 1.0 / math.e:
        return 0.5 + 0.5 * (p_value - 1.0 / math.e) / (1.0 - 1.0 / math.e)
    bound = -math.e * p_value * math.log(max(p_value, 1e-300))
    return bound / (1.0 + bound)


def floor_of(pools: Sequence[Pool], every: Sequence[int]) -> tuple[float, float]:
    """Mean and standard deviation of what all columns together explain where nothing is wrong."""
    explained = [pool.fit(every)[2] for pool in pools]
    if not explained:
        return float(len(every)), math.sqrt(2.0 * len(every))
    return float(np.mean(explained)), float(np.std(explained)) + 1e-9


@dataclass(frozen=True)
class Explained:
    """What some effects explain of the gap: its share, and what is left over in standard deviations and as
    it is."""

    share: float
    left_sd: float
    left: float


def explained(
    pool: Pool, columns: Sequence[int], floor: tuple[float, float], least: float = 0.0
) -> Explained:
    """What some columns explain, of what all columns and probes together do; `least` is what they are known
    to."""
    whole = pool.fit(range(pool.own))[2] - floor[0]
    mine = max(pool.fit(columns)[2] - len(columns), least)
    left = max(whole - mine, 0.0)
    return Explained(float(np.clip(mine / max(whole, floor[1], 1e-9), 0.0, 1.0)), left / floor[1], left)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The gap on each judged run as effects fitted to the other runs explain it.

    Attributes:
        pools: one a run.
        total: what all columns and probes explain so, at the strength of ridge that serves them best.
    """

    pools: tuple[Pool, ...]
    total: float

    @classmethod
    def of(cls, pools: Sequence[Pool]) -> HeldOut:
        """With one run it is scored on itself, less what chance explains."""
        every = range(pools[0].own)
        total = max(_held_out(pools, every, size) for size in RIDGES)
        return cls(tuple(pools), total)

    def explained(self, columns: Sequence[int], least: float = -math.inf) -> float:
        """What the columns explain; `least` is what they are known to."""
        return max(_held_out(self.pools, columns, WIDE), least)


def _held_out(pools: Sequence[Pool], columns: Sequence[int], size: float) -> float:
    """What coefficients fitted to the other runs explain of each, summed."""
    at = np.asarray(columns)
    if len(pools) == 1:
        return pools[0].fit(columns, size)[2] - 2.0 * len(at)
    whole, found = Pool.sum(pools), 0.0
    for pool in pools:
        value, _, _ = whole.without(pool).fit(columns, size)
        found += float(2.0 * value @ pool.gain[at] - value @ pool.information[np.ix_(at, at)] @ value)
    return found


@dataclass(frozen=True, eq=False)
class Found:
    """Effects judged present.

    Attributes:
        forms: one of each effect.
        fit: of all together.
        explained, share: what they explain of the gap on runs left out, and its share.
        unknown: log Bayes factor by which an unknown dependence beside them is called for.
        factor: their own.
        beside: those of further effects.
    """

    forms: tuple[Hypothesis, ...]
    fit: Refit | None
    explained: float
    share: float
    unknown: float
    factor: float
    beside: Beliefs

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(h.effect for h in self.forms)

    def is_unknown(self) -> bool:
        """Whether something else must be at work."""
        return self.share < ENOUGH or self.unknown > 0.0

    def p_unknown(self) -> float:
        """Probability of that, given that there is a gap."""
        by_share = (ENOUGH - self.share) / ENOUGH_WIDTH
        return 1.0 / (1.0 + math.exp(-min(max(by_share, 0.1 if self.unknown > 0.0 else -50.0), 50.0)))


Remaining = Callable[[Sequence[Hypothesis]], tuple[Pool, Refit | None]]
"""What is left of the gap once some effects, refitted together, are in the twin; and their fit."""


@dataclass(frozen=True, eq=False)
class Search:
    """The search for effects that the runs demand: on the runs left out, too."""

    remaining: Remaining
    held_out: HeldOut
    candidates: Candidates

    def best(self, believed: Beliefs, factors: Mapping[str, float], linear: Beliefs) -> Found:
        """One effect, its law perhaps of another form, or several by the catalogue's laws.

        Args:
            believed, linear: with laws of another form and without.
            factors: by effect, those of `believed` corrected by refits.
        """
        alone = max(factors, key=lambda k: factors[k])
        plain = {k: linear.effects[k] + factors[k] - believed.effects[k] for k in factors}
        first = max(plain, key=lambda k: plain[k])
        several = self._extended(self._with((linear.best[first],), plain[first]), factors[alone])
        if len(several.forms) > 1 or alone == first:
            return several
        return self._with((believed.best[alone],), plain[alone])

    def _with(self, forms: tuple[Hypothesis, ...], factor: float) -> Found:
        """Effects of this log Bayes factor, with all that is judged of them."""
        pool, fit = self.remaining(forms)
        given = [i for h in forms for i in self.candidates.columns(h.effect)]
        beside = beliefs(pool.plain(), self.candidates, given)
        mine = self.held_out.explained([i for h in forms for i in h.columns], _explained(fit))
        unknown = beside.unknown - UNKNOWN_PART * max(factor, 0.0)
        return Found(forms, fit, mine, mine / max(self.held_out.total, mine, 1e-9), unknown, factor, beside)

    def _extended(self, found: Found, alone: float) -> Found:
        """Further effects beside those found, as long as they are called for; `alone` is the log Bayes factor
        of one effect with a law of another form."""
        while len(found.forms) < MOST_EFFECTS and found.beside.effects:
            name = max(found.beside.effects, key=lambda k: found.beside.effects[k])
            gain = found.beside.effects[name]
            if gain < SECOND_FACTOR or found.factor + gain < alone + SECOND_FACTOR:
                break
            more = self._with((*found.forms, found.beside.best[name]), found.factor + gain)
            if more.explained < found.explained + SECOND_SHARE * max(self.held_out.total, found.explained):
                break
            found = more
        return found


def _explained(fit: Refit | None) -> float:
    """What a fit through the twin itself explains, less what chance does."""
    return fit.explained - 2.0 * len(fit.columns) if fit is not None and fit.errors else -math.inf


def posterior(found: Mapping[str, float], left: float) -> dict[str, float]:
    """Probabilities of the effects, given that one of them is the cause and leaves `left` unexplained."""
    values = np.array(list(found.values())) * TEMPER / (1.0 + left / LEFT_OVER)
    weights = np.exp(values - values.max())
    return dict(zip(found, (weights / weights.sum()).tolist(), strict=True))


def judge(
    detected: bool,
    p_value: float,
    pool: Pool,
    believed: Beliefs,
    factors: Mapping[str, float],
    refits: Mapping[str, Refit],
    remaining: Remaining,
    held_out: HeldOut,
    candidates: Candidates,
    floor: tuple[float, float],
) -> Verdict:
    """The verdict.

    Args:
        factors: log Bayes factors by effect, those refitted corrected by what the twin itself explains.
        refits: by effect.
        remaining: what is left of the gap beside some effects.
        held_out: the gap run by run.
        floor: mean and standard deviation of what is explained where nothing is wrong.
    """
    p_null = null_probability(p_value)
    linear = beliefs(pool.plain(), candidates)
    first = max(factors, key=lambda k: factors[k])
    found = Found((believed.best[first],), None, 0.0, 1.0, -math.inf, 0.0, believed)
    if detected:
        found = Search(remaining, held_out, candidates).best(believed, factors, linear)
    ranking = dict(factors)
    if len(found.forms) > 1:
        ranking = {k: linear.effects[k] + factors[k] - believed.effects[k] for k in factors}
    order = sorted(ranking, key=lambda k: -ranking[k])
    columns = [i for name in found.effects for i in candidates.columns(name)]
    least = found.fit.explained if found.fit is not None and found.fit.errors else 0.0
    told = explained(pool, columns, floor, least)
    p_unknown = (1.0 - p_null) * found.p_unknown() if detected else 0.0
    weight = posterior(ranking, told.left)
    known = 1.0 - p_null - p_unknown
    causes = [
        _cause(name, weight[name] * known, pool, believed, refits, candidates, order, floor) for name in order
    ]
    kind = _kind(detected, found, causes[0])
    named = found.effects if kind not in ("no_gap", "unknown") else ()
    return Verdict(kind, named, causes, p_null, p_unknown, found.fit if named else None)


def _kind(detected: bool, found: Found, first: Cause) -> str:
    if not detected:
        return "no_gap"
    if found.is_unknown():
        return "unknown"
    if found.effects == (SOIL,):
        return "parameters"
    return "ambiguous" if len(first.members) > 1 else "effect"


def _cause(
    name: str,
    probability: float,
    pool: Pool,
    believed: Beliefs,
    refits: Mapping[str, Refit],
    candidates: Candidates,
    order: Sequence[str],
    floor: tuple[float, float],
) -> Cause:
    columns = believed.best[name].columns
    value, covariance, _ = pool.fit(columns)
    fit = refits.get(name)
    if fit is not None and not fit.failure:
        columns, value, covariance = fit.columns, fit.value, fit.covariance
    members = class_of(pool, candidates, name, columns, order) if order.index(name) < 5 else (name,)
    share = explained(pool, candidates.columns(name), floor).share
    return Cause(name, members, max(probability, 0.0), columns, value, np.sqrt(np.diag(covariance)), share)
