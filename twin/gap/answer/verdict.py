"""From the posterior, refits and shares to a verdict."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.answer.effect_search import (
    EffectSearch,
    EffectSet,
    explained_share,
    joint_log_odds,
    null_explained,
)
from terrafusion.twin.gap.answer.look_alikes import (
    effect_signal,
    look_alikes,
    same_signature,
    signatures,
)
from terrafusion.twin.gap.data.candidates import SOIL_STRENGTH, Candidates
from terrafusion.twin.gap.infer.cause_posterior import OUTSIDE_SHARE, CausePosterior
from terrafusion.twin.gap.infer.detect import Detection
from terrafusion.twin.gap.infer.goodness_of_fit import GoodnessOfFit
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.infer.refit import Refit
from terrafusion.twin.gap.rollout.delay import DELAYS

Array = NDArray[np.float64]

SAME_ODDS, NEARLY_ALIKE = math.log(3.0), 0.9
"""Effects whose log odds differ by less, and whose sensitivities correlate by more, cannot be distinguished,
either (assumed)."""
UNKNOWN = OUTSIDE_SHARE
"""Probability of an unknown cause, given a gap, above which that is the verdict: more than its prior."""
LAW_SIGMA_MOTION, LAW_SIGMA_SENSOR = 0.2, 0.03
"""1 sigma, as a share of its value, by which the size of an effect on the motion or of a delay, which is read
off the motion, and of another one of the sensors, is wrong because the robot's law is not the twin's. Set on
development trials (docs/evidence/gap-blind.md)."""
LEAST_PROBABILITY = 0.01  # of a cause whose look-alikes are sought


@dataclass(frozen=True, eq=False)
class Cause:
    """One candidate.

    Attributes:
        effect, members: its name, and those of its class (itself first, then its look-alikes).
        probability: of it.
        columns, value, sigma: (k,) its best columns, in units of `Candidates.scale`; sigma is NaN where the
            fit failed.
        share: of the gap that it explains; None where the fit failed.
    """

    effect: str
    members: tuple[str, ...]
    probability: float
    columns: tuple[int, ...]
    value: Array
    sigma: Array
    share: float | None


@dataclass(frozen=True, eq=False)
class GapVerdict:
    """The verdict, its named effects, and all causes, the most probable first; `fit` and `goodness` are those
    of the most probable effects, where there is a gap."""

    kind: str
    named: tuple[str, ...]
    causes: list[Cause]
    p_null: float
    p_unknown: float
    fit: Refit | None
    goodness: GoodnessOfFit | None = None

    def ambiguous(self) -> Cause | None:
        """The most probable of the named causes that has look-alikes."""
        return next((c for c in self.causes if c.effect in self.named and len(c.members) > 1), None)


def null_probability(p_value: float) -> float:
    """Least posterior probability of no gap at even odds (Sellke, Bayarri and Berger 2001, eq. 3)."""
    if p_value >= 1.0 / math.e:
        return 0.5 + 0.5 * (p_value - 1.0 / math.e) / (1.0 - 1.0 / math.e)
    bound = -math.e * p_value * math.log(max(p_value, 1e-300))
    return bound / (1.0 + bound)


def judge(
    detection: Detection,
    significance: float,
    pooled: PooledScores,
    posterior: CausePosterior,
    refits: Mapping[str, Refit],
    search: EffectSearch,
) -> GapVerdict:
    """The verdict.

    Args:
        pooled: scores of the judged runs.
        posterior: the odds of all effects by themselves.
        refits: by effect.
        search: for several effects.
    """
    p_null = null_probability(detection.tail_probability(significance))
    found: EffectSet | None = None
    if detection.p_value <= significance:
        found = search.best(posterior)
        posterior = posterior.with_odds(joint_log_odds(found, posterior)).with_fit(found.goodness)
    weight, unknown = posterior.probabilities()
    p_unknown = (1.0 - p_null) * unknown if found is not None else 0.0
    known = (1.0 - p_null - p_unknown) / sum(weight.values())
    floor = null_explained(detection.references, pooled.own)
    sizes = _CauseSizes(pooled, posterior, refits, search, floor, found)
    causes = [sizes.cause(effect, weight[effect] * known) for effect in posterior.ranked()]
    if found is None:
        return GapVerdict("no_gap", (), causes, p_null, p_unknown, None)
    if unknown > UNKNOWN:
        return GapVerdict("unknown", (), causes, p_null, p_unknown, None, found.goodness)
    kind = "parameters" if found.effects == (SOIL_STRENGTH,) else "effect"
    verdict = GapVerdict(kind, found.effects, causes, p_null, p_unknown, found.fit, found.goodness)
    if kind == "effect" and verdict.ambiguous() is not None:
        return dataclasses.replace(verdict, kind="ambiguous")
    return verdict


@dataclass(frozen=True, eq=False)
class _CauseSizes:
    """What the causes are made from; see `judge`."""

    pooled: PooledScores
    posterior: CausePosterior
    refits: Mapping[str, Refit]
    search: EffectSearch
    floor: tuple[float, float]
    found: EffectSet | None

    def cause(self, effect: str, probability: float) -> Cause:
        pooled, candidates = self.pooled, self.search.refit.evidence.candidates
        columns, fit, least = self.posterior.laws[effect].columns, self.refits.get(effect), 0.0
        value, covariance, _ = pooled.fit(columns)
        failed = fit is not None and bool(fit.failure)
        if fit is not None and not failed:
            columns, value, covariance, least = fit.columns, fit.value, fit.covariance, fit.explained
        members: tuple[str, ...] = (effect,)
        if probability >= LEAST_PROBABILITY:
            members = self._members(effect, columns, value, refitted=fit is not None and not failed)
        share = None
        if not failed:
            share = explained_share(pooled, candidates.columns(effect), self.floor, least)
        joint = self.found.one(effect) if self.found is not None and effect in self._together() else None
        if joint is not None:
            columns, value, covariance = joint
        sigma = np.full(len(columns), np.nan)
        if joint is not None or not failed:
            sigma = _size_sigma(pooled, candidates, columns, value, covariance)
        return Cause(effect, members, max(probability, 0.0), columns, value, sigma, share)

    def _together(self) -> tuple[str, ...]:
        """Effects that were found together, several at least."""
        return self.found.effects if self.found is not None and len(self.found.laws) > 1 else ()

    def _members(self, effect: str, columns: Sequence[int], value: Array, refitted: bool) -> tuple[str, ...]:
        """The effect and its look-alikes, without those found beside it."""
        pooled, odds, order = self.pooled, self.posterior.odds, self.posterior.ranked()
        candidates, law = self.search.refit.evidence.candidates, self.posterior.laws[effect]
        signal, square = effect_signal(
            pooled, columns, lambda: self.search.remaining([(law,)])[0][0] if refitted else pooled
        )
        others = [k for k in order if k != effect]
        alike = look_alikes(pooled, candidates, signal, square, others)
        close = [k for k in others if abs(odds[k] - odds[effect]) < SAME_ODDS]
        close = list(look_alikes(pooled, candidates, signal, square, close, NEARLY_ALIKE))
        whole = signatures(self.search.refit.evidence.runs, len(candidates.keys))
        close += same_signature(whole, candidates, columns, value, others)
        beside = self._together() if effect in self._together() else ()
        return (effect, *(k for k in others if k not in beside and (k in alike or k in close)))


def _size_sigma(
    pooled: PooledScores, candidates: Candidates, columns: Sequence[int], value: Array, covariance: Array
) -> Array:
    """1 sigma (k,) of sizes: of noise, at least as the references scatter, and of the law."""
    noise = np.maximum(np.sqrt(np.diag(covariance)), pooled.marginal.sigmas(columns))
    motion = {*candidates.moving, *DELAYS}
    law = [LAW_SIGMA_MOTION if candidates.keys[i] in motion else LAW_SIGMA_SENSOR for i in columns]
    return np.asarray(np.hypot(noise, law * np.abs(value)))
