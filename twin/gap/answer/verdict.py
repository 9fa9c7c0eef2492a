"""From odds, refits and shares to a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.answer.classes import class_of, done
from terrafusion.twin.gap.data.candidates import SOIL, Candidates, Hypothesis
from terrafusion.twin.gap.infer.cause_posterior import OUTSIDE_SHARE, Choice, Told
from terrafusion.twin.gap.infer.channels import Left, Products, Table
from terrafusion.twin.gap.infer.goodness_of_fit import Goodness, goodness
from terrafusion.twin.gap.infer.nonlinear_refit import bounds
from terrafusion.twin.gap.infer.posterior import WIDE, Alone, Beliefs, Pool, beliefs
from terrafusion.twin.gap.infer.refit import Refit

Array = NDArray[np.float64]

FURTHER_TRIED = 2
"""So many further effects are fitted with those found: the greatest by Bayes factor, and as many by what they
would leave in the channels to first order."""
FURTHER_ODDS = 4.0
"""Log odds that each further effect costs."""
FURTHER_SHARE, FURTHER_LEFT = 0.15, 0.5
"""What it must take away of that which the effects found leave in the channels: as a share, and in units of
it. These three are set on development trials, docs/gap-blind.md."""
SAME_ODDS, NEARLY = math.log(3.0), 0.9
"""Effects whose log odds differ by less, and whose signatures correlate by more, cannot be told from each
other, either (assumed)."""
MOST_EFFECTS = 3
UNKNOWN = OUTSIDE_SHARE
"""Probability of an unknown cause, given a gap, above which the verdict is that: what was seen speaks for
it."""
LAW_MOVES, LAW_SENSES = 0.2, 0.03
"""1 sigma, as a share of its value, by which the size of an effect that moves the robot, and of one of the
sensors alone, is wrong since the robot's law is not the twin's. Set on development trials
(docs/gap-blind.md)."""
CLASSES = 5
"""Causes, the first ones, of which the class is told."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One candidate: its class, probability, best columns, their values (k,) with 1 sigma, in units of
    `Candidates.scale`, and its share of the gap. Where the fit failed sigma is NaN, and there is no share."""

    effect: str
    members: tuple[str, ...]
    probability: float
    columns: tuple[int, ...]
    value: Array
    sigma: Array
    share: float | None


@dataclass(frozen=True, eq=False)
class Verdict:
    """The judgement, its named effects and all causes, most probable first; `goodness` is that of the
    likeliest effects, where there is a gap."""

    kind: str
    named: tuple[str, ...]
    causes: list[Cause]
    p_null: float
    p_unknown: float
    fit: Refit | None
    goodness: Goodness | None = None


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


def share_of(pool: Pool, columns: Sequence[int], floor: tuple[float, float], least: float = 0.0) -> float:
    """Share of the gap that some columns explain, of what all columns and probes together do; `least` is what
    they are known to."""
    whole = pool.fit(range(pool.own))[2] - floor[0]
    mine = max(pool.fit(columns)[2] - len(columns), least)
    return float(np.clip(mine / max(whole, floor[1], 1e-9), 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The gap on each judged run (`pools`) as effects fitted to the other runs explain it; with one run it is
    scored on itself, less what chance explains."""

    pools: tuple[Pool, ...]

    def explained(self, columns: Sequence[int], least: float = -math.inf) -> float:
        """What the columns explain; `least` is what they are known to."""
        return max(_held_out(self.pools, columns), least)


def _held_out(pools: Sequence[Pool], columns: Sequence[int]) -> float:
    """What coefficients fitted to the other runs explain of each, summed."""
    at = np.asarray(columns)
    if len(pools) == 1:
        return pools[0].fit(columns, WIDE)[2] - 2.0 * len(at)
    whole, found = Pool.sum(pools), 0.0
    for pool in pools:
        value, _, _ = whole.without(pool).fit(columns, WIDE)
        found += float(2.0 * value @ pool.gain[at] - value @ pool.information[np.ix_(at, at)] @ value)
    return found


@dataclass(frozen=True, eq=False)
class Found:
    """Effects judged present.

    Attributes:
        forms: one of each effect.
        fit: of all together.
        explained: what they explain of the gap on runs left out.
        left, squares: what they leave in the channels, and of deviations (see `Told`).
        rest: products of the errors with them, a run each.
        goodness: how that is beside what references leave.
        beside: log Bayes factors of further effects.
    """

    forms: tuple[Hypothesis, ...]
    fit: Refit | None
    explained: float
    left: Left
    squares: Array
    rest: Sequence[Products]
    goodness: Goodness
    beside: Beliefs

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(h.effect for h in self.forms)

    def one(self, effect: str) -> tuple[tuple[int, ...], Array, Array] | None:
        """Columns (k,), values (k,) and covariance (k, k) of one as all are fitted together; None where that
        failed."""
        if self.fit is None or self.fit.failure:
            return None
        columns = next(h.columns for h in self.forms if h.effect == effect)
        at = [self.fit.columns.index(i) for i in columns]
        return columns, self.fit.value[at], self.fit.covariance[np.ix_(at, at)]


Remaining = Callable[[Sequence[tuple[Hypothesis, ...]]], Sequence[tuple[Pool, Refit | None]]]
"""What is left of the gap with each of several sets of effects, refitted together, in the twin; and their
fits."""


@dataclass(frozen=True, eq=False)
class Search:
    """The search for effects that the runs demand: on the runs left out, too."""

    remaining: Remaining
    held_out: HeldOut
    candidates: Candidates
    table: Table
    alone: Alone

    def best(self, choice: Choice) -> Found:
        """The likeliest effect, and further ones beside it as long as they are called for."""
        found = self._with([(choice.laws[choice.first()],)])[0]
        while len(found.forms) < MOST_EFFECTS:
            further = self._further(found, choice)
            if further is None:
                break
            found = self._exchanged(further, choice) if len(further.forms) == 2 else further
        return found

    def _with(self, several: Sequence[tuple[Hypothesis, ...]]) -> list[Found]:
        """Sets of effects, with all that is judged of them."""
        return [
            self._found(forms, *left) for forms, left in zip(several, self.remaining(several), strict=True)
        ]

    def _found(self, forms: tuple[Hypothesis, ...], pool: Pool, fit: Refit | None) -> Found:
        given = [i for h in forms for i in self.candidates.columns(h.effect)]
        columns = [i for h in forms for i in h.columns]
        table = self.table
        if fit is not None and fit.errors:
            errors = table.products(fit.errors)
            left, squares = table.left(errors), fit.squares
        else:
            value, left = table.linear(columns, *bounds(self.candidates, columns))
            errors = [block.moved(block.error, columns, value) for block in table.blocks]
            squares = self.alone.squares(columns, value)
        mine = self.held_out.explained(columns, _explained(fit))
        good = goodness(table, errors, left.weight)
        more = beliefs(pool.plain(), self.candidates, given)
        return Found(forms, fit, mine, left, squares, errors, good, more)

    def _exchanged(self, found: Found, choice: Choice) -> Found:
        """Of two effects the first was chosen with the other unexplained: the best beside the other, where
        both then are likelier."""
        other = self._further(self._with([(found.forms[1],)])[0], choice)
        if other is None or {*other.effects} == {*found.effects}:
            return found
        return other if odds_of(other, choice) > odds_of(found, choice) else found

    def _further(self, found: Found, choice: Choice) -> Found | None:
        """With the one more effect that is likeliest; None where none is called for.

        What one explains of the whole gap says little: a small effect is seen beside a large one by what it
        takes away of the rest.
        """
        most = min((1.0 - FURTHER_SHARE) * found.left.total, found.left.total - FURTHER_LEFT)
        if most < 0.0:  # nothing leaves less than nothing
            return None
        tried = self._with([(*found.forms, law) for law in self._promising(found)])
        least = odds_of(found, choice) + FURTHER_ODDS
        called = [t for t in tried if t.left.total <= most and t.explained > found.explained]
        best = max(called, key=lambda t: odds_of(t, choice), default=None)
        return best if best is not None and odds_of(best, choice) >= least else None

    def _promising(self, found: Found) -> list[Hypothesis]:
        """Laws that are worth a fit beside those found."""
        gains, left = found.beside.effects, dict[Hypothesis, float]()
        for law in self.candidates.hypotheses:
            if law.effect in gains:
                ends = bounds(self.candidates, law.columns)
                left[law] = self.table.linear(law.columns, *ends, found.rest)[1].total
        seen = sorted(gains, key=lambda effect: -gains[effect])[:FURTHER_TRIED]
        by_channels = {
            law.effect: law for law in sorted(left, key=lambda law: -left[law])
        }  # the best is last
        least = sorted(by_channels, key=lambda effect: left[by_channels[effect]])[:FURTHER_TRIED]
        return list(dict.fromkeys([found.beside.best[k] for k in seen] + [by_channels[k] for k in least]))


def odds_of(found: Found, choice: Choice) -> float:
    """Log odds of effects by what all of them leave, up to the constant that `Choice` has, too."""
    return choice.by.cause(Told.of(found.left, found.squares), choice.before)


def _explained(fit: Refit | None) -> float:
    """What a fit through the twin itself explains, less what chance does."""
    return fit.explained - 2.0 * len(fit.columns) if fit is not None and fit.errors else -math.inf


def judge(
    detected: bool,
    p_value: float,
    pool: Pool,
    choice: Choice,
    refits: Mapping[str, Refit],
    search: Search,
    floor: tuple[float, float],
) -> Verdict:
    """The verdict.

    Args:
        choice: the odds of all effects by themselves.
        refits: by effect.
        search: for several.
        floor: mean and standard deviation of what is explained where nothing is wrong.
    """
    p_null = null_probability(p_value)
    found: Found | None = None
    if detected:
        found = search.best(choice)
        choice = choice.with_odds(_together(found, choice)).after(found.goodness)
    weight, unknown = choice.probabilities()
    p_unknown = (1.0 - p_null) * unknown if detected else 0.0
    known = (1.0 - p_null - p_unknown) / sum(weight.values())
    order = sorted(weight, key=lambda k: -choice.odds[k])
    causes = [_cause(k, weight[k] * known, pool, choice, refits, search, floor, found) for k in order]
    kind = _kind(found, causes, unknown)
    named = found.effects if found is not None and kind != "unknown" else ()
    fit = found.fit if found is not None and named else None
    return Verdict(kind, named, causes, p_null, p_unknown, fit, found.goodness if found is not None else None)


def _together(found: Found, choice: Choice) -> dict[str, float]:
    """Log odds of several effects found, each as what all of them leave, in the order in which they were."""
    if len(found.forms) < 2:
        return {}
    odds = odds_of(found, choice) - FURTHER_ODDS * (len(found.forms) - 1)
    return {name: max(odds, choice.odds[name]) - 1e-6 * i for i, name in enumerate(found.effects)}


def _kind(found: Found | None, causes: Sequence[Cause], unknown: float) -> str:
    """By the probability of an unknown cause, given that there is a gap."""
    if found is None:
        return "no_gap"
    if unknown > UNKNOWN:
        return "unknown"
    if found.effects == (SOIL,):
        return "parameters"
    return "effect" if alike(causes, found.effects) is None else "ambiguous"


def alike(causes: Sequence[Cause], named: Sequence[str]) -> Cause | None:
    """The likeliest of the causes named that has look-alikes."""
    return next((c for c in causes if c.effect in named and len(c.members) > 1), None)


def _cause(
    name: str,
    probability: float,
    pool: Pool,
    choice: Choice,
    refits: Mapping[str, Refit],
    search: Search,
    floor: tuple[float, float],
    found: Found | None,
) -> Cause:
    columns, candidates = choice.laws[name].columns, search.candidates
    value, covariance, _ = pool.fit(columns)
    fit, least = refits.get(name), 0.0
    together = found.effects if found is not None and name in found.effects else ()
    failed = fit is not None and bool(fit.failure)
    if fit is not None and not failed:
        columns, value, covariance, least = fit.columns, fit.value, fit.covariance, fit.explained
    order = sorted(choice.odds, key=lambda k: -choice.odds[k])
    members: tuple[str, ...] = (name,)
    if order.index(name) < CLASSES:
        whole = fit is not None and not failed
        law = choice.laws[name]
        does, signal = done(pool, columns, lambda: search.remaining([(law,)])[0][0] if whole else pool)
        alike = class_of(pool, candidates, name, does, signal, order)
        close = [k for k in order if abs(choice.odds[k] - choice.odds[name]) < SAME_ODDS]
        close = [k for k in class_of(pool, candidates, name, does, signal, close, NEARLY) if k in close]
        members = (name, *(k for k in order if k not in {name, *together} and (k in alike or k in close)))
    share = None if failed else share_of(pool, candidates.columns(name), floor, least)
    joint = found.one(name) if found is not None and len(together) > 1 else None
    if joint is not None:
        columns, value, covariance = joint
    told = joint is not None or not failed
    sigma = _spread(pool, candidates, columns, value, covariance) if told else np.full(len(columns), np.nan)
    return Cause(name, members, max(probability, 0.0), columns, value, sigma, share)


def _spread(
    pool: Pool, candidates: Candidates, columns: Sequence[int], value: Array, covariance: Array
) -> Array:
    """1 sigma (k,) of sizes: of noise, at least as the references scatter, and of the law."""
    noise = np.maximum(np.sqrt(np.diag(covariance)), pool.alone.sigmas(columns))
    law = [LAW_MOVES if candidates.keys[i] in candidates.moving else LAW_SENSES for i in columns]
    return np.asarray(np.hypot(noise, law * np.abs(value)))
