"""From Bayes factors, refits and shares to a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import SOIL, Candidates
from terrafusion.twin.gap.classes import class_of
from terrafusion.twin.gap.posterior import Beliefs, Pool, beliefs
from terrafusion.twin.gap.refit import Refit

Array = NDArray[np.float64]

TEMPER, LEFT_OVER = 0.2, 40.0
"""Power of the Bayes factors in the posterior, and the square left over that halves it (a quasi-likelihood:
where the candidates' laws do not fit, the evidence between them is worth less). Tuned on twin trials."""
UNKNOWN_PART, UNKNOWN_WIDTH = 0.1, 12.0
"""An unknown cause is as likely as not when the log Bayes factor of a dependence on the input, beside all
effects named, is this part of the first one's; and the width of that judgement (tuned on twin trials)."""
SECOND_FACTOR, SECOND_PART, COMPLETING_PART = 30.0, 0.15, 0.04
"""Log Bayes factor that a further effect must have beside those found, and its least part of the first
one's; the last where nothing is left over once it is there. A law of slightly another form leaves something
over, which is no second effect (tuned on twin trials)."""
COMPLETE = -50.0
"""Nothing is left over where the log Bayes factor of an unknown dependence is below this."""
MOST_EFFECTS = 3


@dataclass(frozen=True, eq=False)
class Cause:
    """One candidate: its class, probability, best columns with their values, and its share of the gap."""

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
    whole = pool.fit(range(len(pool.gain)))[2] - floor[0]
    mine = max(pool.fit(columns)[2] - len(columns), least)
    left = max(whole - mine, 0.0)
    return Explained(float(np.clip(mine / max(whole, floor[1], 1e-9), 0.0, 1.0)), left / floor[1], left)


@dataclass(frozen=True, eq=False)
class Found:
    """Effects judged present, their joint fit, and by how much an unknown dependence is called for."""

    effects: tuple[str, ...]
    fit: Refit | None
    unknown: float


Remaining = Callable[[Sequence[str]], tuple[Pool, Refit | None]]
"""What is left of the gap once some effects, refitted together, are in the twin; and their fit."""


def search(remaining: Remaining, candidates: Candidates, factors: Mapping[str, float]) -> Found:
    """The first effect, and others that the runs demand beside it."""
    first = max(factors, key=lambda k: factors[k])
    found = [first]
    pool, fit = remaining(found)
    while True:
        beside = beliefs(pool, candidates, [i for name in found for i in candidates.columns(name)])
        name = max(beside.effects, key=lambda k: beside.effects[k], default=None)
        if name is None or len(found) == MOST_EFFECTS:
            break
        gain, first_one = beside.effects[name], max(factors[first], 0.0)
        if gain < max(SECOND_FACTOR, COMPLETING_PART * first_one):
            break
        after, joint = remaining([*found, name])
        if gain < SECOND_PART * first_one:
            columns = [i for other in (*found, name) for i in candidates.columns(other)]
            if beliefs(after, candidates, columns).unknown > COMPLETE:
                break
        found.append(name)
        pool, fit = after, joint
    return Found(tuple(found), fit, beside.unknown - UNKNOWN_PART * max(factors[first], 0.0))


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
    candidates: Candidates,
    floor: tuple[float, float],
) -> Verdict:
    """The verdict.

    Args:
        factors: log Bayes factors by effect, those refitted corrected by what the twin itself explains.
        refits: by effect.
        remaining: what is left of the gap beside some effects.
        floor: mean and standard deviation of what is explained where nothing is wrong.
    """
    p_null = null_probability(p_value)
    order = sorted(factors, key=lambda k: -factors[k])
    found = search(remaining, candidates, factors) if detected else Found((order[0],), None, -math.inf)
    columns = [i for name in found.effects for i in candidates.columns(name)]
    least = found.fit.explained if found.fit is not None and found.fit.errors else 0.0
    told = explained(pool, columns, floor, least)
    p_unknown = (1.0 - p_null) * _unknown(found.unknown)
    weight = posterior(factors, told.left)
    known = 1.0 - p_null - p_unknown
    causes = [
        _cause(name, weight[name] * known, pool, believed, refits, candidates, order, floor) for name in order
    ]
    kind = _kind(detected, found, causes[0])
    named = found.effects if kind not in ("no_gap", "unknown") else ()
    return Verdict(kind, named, causes, p_null, p_unknown, found.fit if named else None)


def _unknown(factor: float) -> float:
    """Probability of an unknown cause, given that there is a gap."""
    return 1.0 / (1.0 + math.exp(-min(max(factor / UNKNOWN_WIDTH, -50.0), 50.0)))


def _kind(detected: bool, found: Found, first: Cause) -> str:
    if not detected:
        return "no_gap"
    if found.unknown > 0.0:
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
