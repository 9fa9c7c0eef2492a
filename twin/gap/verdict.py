"""From Bayes factors, refits and shares to a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.candidates import SOIL, Candidates
from terrafusion.twin.gap.classes import class_of
from terrafusion.twin.gap.posterior import Beliefs, Pool, beliefs
from terrafusion.twin.gap.refit import Refit

Array = NDArray[np.float64]

TEMPER = 0.1
"""Power of the Bayes factors in the posterior: candidates' laws are not the robot's (tuned on twin trials whose true
form was withheld)."""
KNOWN_SHARE, SHARE_WIDTH = 0.6, 0.08
"""A gap of which the candidates explain less than the first is of unknown cause; width of that judgement."""
SECOND_FACTOR = 12.0
"""Log Bayes factor that a further effect must have beside those found."""
SECOND_SHARE = 0.08
"""Share of the gap that a further effect must explain in addition."""
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
    found: tuple[int, ...]


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


def shares(pool: Pool, columns: Sequence[int], floor: float) -> float:
    """Share of the gap above its floor that some columns explain, 0 to 1."""
    whole = pool.fit(range(len(pool.gain)))[2] - floor
    mine = pool.fit(columns)[2] - len(columns)
    return float(np.clip(mine / max(whole, 1e-9), 0.0, 1.0)) if whole > 0.0 else 0.0


def search_more(pool: Pool, candidates: Candidates, first: str, floor: float) -> list[str]:
    """Effects judged present: the first, and others that the runs demand beside it."""
    found = [first]
    while len(found) < MOST_EFFECTS:
        given = [i for name in found for i in candidates.columns(name)]
        share = shares(pool, given, floor)
        beside = beliefs(pool, candidates, given)
        if not beside.effects:
            break
        name = max(beside.effects, key=lambda k: beside.effects[k])
        gained = shares(pool, [*given, *candidates.columns(name)], floor) - share
        if beside.effects[name] < SECOND_FACTOR or gained < SECOND_SHARE:
            break
        found.append(name)
    return found


def posterior(found: Mapping[str, float]) -> dict[str, float]:
    """Probabilities of the effects, given that one of them is the cause."""
    values = np.array(list(found.values())) * TEMPER
    weights = np.exp(values - values.max())
    return dict(zip(found, (weights / weights.sum()).tolist(), strict=True))


def judge(
    detected: bool,
    p_value: float,
    pool: Pool,
    believed: Beliefs,
    factors: Mapping[str, float],
    refits: Mapping[str, Refit],
    candidates: Candidates,
    floor: tuple[float, float],
) -> Verdict:
    """The verdict.

    Args:
        factors: log Bayes factors by effect, those refitted corrected by what the twin itself explains.
        refits: by effect.
        floor: mean and standard deviation of what is explained where nothing is wrong.
    """
    p_null = null_probability(p_value)
    order = sorted(factors, key=lambda k: -factors[k])
    first = order[0]
    named = search_more(pool, candidates, first, floor[0]) if detected else []
    columns = [i for name in (named or [first]) for i in candidates.columns(name)]
    explained = shares(pool, columns, floor[0])
    p_unknown = (1.0 - p_null) / (1.0 + math.exp((explained - KNOWN_SHARE) / SHARE_WIDTH))
    weight = posterior(factors)
    causes = [
        _cause(
            name,
            weight[name] * (1.0 - p_null - p_unknown),
            pool,
            believed,
            refits,
            candidates,
            order,
            floor[0],
        )
        for name in order
    ]
    kind = _kind(detected, explained, causes[0], named)
    if kind in ("no_gap", "unknown"):
        named = []
    return Verdict(kind, tuple(named), causes, p_null, p_unknown, tuple(columns) if named else ())


def _kind(detected: bool, explained: float, first: Cause, named: Sequence[str]) -> str:
    if not detected:
        return "no_gap"
    if explained < KNOWN_SHARE:
        return "unknown"
    if list(named) == [SOIL]:
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
    floor: float,
) -> Cause:
    columns = believed.best[name].columns
    value, covariance, _ = pool.fit(columns)
    fit = refits.get(name)
    if fit is not None and not fit.failure:
        columns, value, covariance = fit.columns, fit.value, fit.covariance
    members = class_of(pool, candidates, name, columns, order) if order.index(name) < 5 else (name,)
    share = shares(pool, candidates.columns(name), floor)
    return Cause(name, members, max(probability, 0.0), columns, value, np.sqrt(np.diag(covariance)), share)
