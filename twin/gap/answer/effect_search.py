"""The search for the effects that the runs require: the most probable one, and further ones beside it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.answer.look_alikes import same_signature, signatures
from terrafusion.twin.gap.data.candidates import Hypothesis
from terrafusion.twin.gap.infer.cause_posterior import CausePosterior, CauseResidual
from terrafusion.twin.gap.infer.channels import ErrorProducts, Unexplained
from terrafusion.twin.gap.infer.goodness_of_fit import GoodnessOfFit, goodness_of_fit
from terrafusion.twin.gap.infer.nonlinear_refit import LawFit, NonlinearRefit
from terrafusion.twin.gap.infer.posterior import WIDE, BayesFactors, PooledScores, bayes_factors
from terrafusion.twin.gap.infer.refit import Refit
from terrafusion.twin.gap.null.score import score_of_error

Array = NDArray[np.float64]
Laws = tuple[Hypothesis, ...]

MOST_EFFECTS = 3
FURTHER_TRIED = 2
"""Further effects that are refitted: the greatest by Bayes factor, and as many by what they leave to first
order."""
FURTHER_ODDS = 4.0  # log odds that each further effect costs
FURTHER_SHARE, FURTHER_LEFT = 0.15, 0.5
"""Least reduction by a further effect of what remains, as a share and in its units. These three are set on
development trials (docs/evidence/gap-blind.md)."""


@dataclass(frozen=True, eq=False)
class EffectSet:
    """Effects judged present together.

    Attributes:
        laws: one of each effect.
        fit: of all together.
        explained: of the gap on runs left out.
        left, squares: what remains in the channels, and of deviations (see `CauseResidual`).
        rest: products of the errors that remain, one a run.
        goodness: of the fit, beside the references.
        further: log Bayes factors of further effects.
    """

    laws: Laws
    fit: Refit | None
    explained: float
    left: Unexplained
    squares: Array
    rest: Sequence[ErrorProducts]
    goodness: GoodnessOfFit
    further: BayesFactors

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(h.effect for h in self.laws)

    def one(self, effect: str) -> tuple[tuple[int, ...], Array, Array] | None:
        """Columns (k,), values (k,) and covariance (k, k) of one in the joint fit; None where that failed."""
        if self.fit is None or self.fit.failure:
            return None
        columns = next(h.columns for h in self.laws if h.effect == effect)
        at = [self.fit.columns.index(i) for i in columns]
        return columns, self.fit.value[at], self.fit.covariance[np.ix_(at, at)]

    def log_odds(self, posterior: CausePosterior) -> float:
        """Log odds by what all of them leave, up to the constant of the posterior."""
        residual = CauseResidual.of(self.left, self.squares)
        return posterior.weights.log_odds(residual, posterior.before)


def explained_held_out(runs: Sequence[PooledScores], columns: Sequence[int]) -> float:
    """What coefficients fitted to the other runs explain of each, summed; one run alone is scored on itself,
    less what chance explains."""
    if len(runs) == 1:
        return runs[0].fit(columns, WIDE)[2] - 2.0 * len(columns)
    whole, found = PooledScores.sum(runs), 0.0
    for run in runs:
        value, _, _ = whole.without(run).fit(columns, WIDE)
        found += run.explained_by(columns, value)
    return found


@dataclass(frozen=True, eq=False)
class EffectSearch:
    """Refits sets of effects and selects those that the runs require, on the runs left out, too.

    `fits` holds the refits of sets so far.
    """

    refit: NonlinearRefit
    runs: tuple[PooledScores, ...]
    fits: dict[Laws, LawFit | Refit]

    @classmethod
    def of(cls, refit: NonlinearRefit, fits: dict[Hypothesis, LawFit | Refit]) -> EffectSearch:
        """From the fits of single laws."""
        runs = tuple(PooledScores.of([s], refit.null).without_discrepancy() for s in refit.scores)
        return cls(refit, runs, {(law,): fit for law, fit in fits.items()})

    def best(self, posterior: CausePosterior) -> EffectSet:
        """The most probable effect, and further ones beside it as long as they are required."""
        found = self._sets([(posterior.laws[posterior.ranked()[0]],)])[0]
        while len(found.laws) < MOST_EFFECTS:
            further = self._further(found, posterior)
            if further is None:
                break
            found = self._exchanged(further, posterior) if len(further.laws) == 2 else further
        return found

    def remaining(self, several: Sequence[Laws]) -> list[tuple[PooledScores, Refit]]:
        """The scores that remain with each set of laws in the twin, and its refit; those of the gap itself
        where the refit fails."""
        fits = [f.fit if isinstance(f, LawFit) else f for f in self._fits_of(several)]
        return [(self._scores_with(fit) if fit.errors else self.refit.pooled, fit) for fit in fits]

    def _scores_with(self, fit: Refit) -> PooledScores:
        refit = self.refit
        runs = zip(refit.evidence.runs, fit.errors, refit.scores, strict=True)
        scores = [
            dataclasses.replace(score_of_error(run, refit.sigma, error, own.A), discrepancy=own.discrepancy)
            for run, error, own in runs
        ]
        return PooledScores.of(scores, refit.null)

    def _fits_of(self, several: Sequence[Laws]) -> list[LawFit | Refit]:
        """Fits of sets of laws, each from the fit without its last law; sets that share it are fitted
        together, and a failure of it is theirs."""
        new: dict[Laws, list[Hypothesis]] = {}
        for laws in several:
            if laws not in self.fits:
                new.setdefault(laws[:-1], []).append(laws[-1])
        for first, more in new.items():
            before = self._fits_of([first])[0] if first else None
            if isinstance(before, Refit):
                self.fits.update({(*first, law): before for law in more})
            elif before is None:
                self.fits.update({(law,): self.refit.single_fit(law) for law in more})
            else:
                joint = {law: _joined((*first, law)) for law in more}
                found = self.refit.joint_fits(before, list(joint.values()))
                self.fits.update({(*first, law): found[both] for law, both in joint.items()})
        return [self.fits[laws] for laws in several]

    def _sets(self, several: Sequence[Laws]) -> list[EffectSet]:
        found = zip(several, self.remaining(several), strict=True)
        return [self._set(laws, scores, fit) for laws, (scores, fit) in found]

    def _set(self, laws: Laws, scores: PooledScores, fit: Refit) -> EffectSet:
        candidates, table = self.refit.evidence.candidates, self.refit.table
        given = [i for h in laws for i in candidates.columns(h.effect)]
        columns = [i for h in laws for i in h.columns]
        explained = explained_held_out(self.runs, columns)
        if fit.errors:
            errors = table.products(fit.errors)
            left, squares = table.unexplained(errors), fit.squares
            explained = max(explained, fit.explained - 2.0 * len(fit.columns))
        else:
            value, left = table.linear_fit(columns, *candidates.bounds(columns))
            errors = [run.minus(run.error, columns, value) for run in table.runs]
            squares = self.refit.pooled.marginal.squares(columns, value)
        goodness = goodness_of_fit(table, errors, left.weight)
        further = bayes_factors(scores.without_discrepancy(), candidates, given)
        return EffectSet(laws, fit, explained, left, squares, errors, goodness, further)

    def _exchanged(self, found: EffectSet, posterior: CausePosterior) -> EffectSet:
        """Of two effects the first was selected with the other unexplained: the best beside the other, if the
        two are then more probable."""
        other = self._further(self._sets([(found.laws[1],)])[0], posterior)
        if other is None or {*other.effects} == {*found.effects}:
            return found
        return other if other.log_odds(posterior) > found.log_odds(posterior) else found

    def _further(self, found: EffectSet, posterior: CausePosterior) -> EffectSet | None:
        """With the most probable further effect; None where none is required.

        What an effect explains of the whole gap says little: a small one shows beside a large one by how much
        it reduces the rest.
        """
        most = min((1.0 - FURTHER_SHARE) * found.left.total, found.left.total - FURTHER_LEFT)
        if most < 0.0:  # nothing can leave less than zero
            return None
        tried = self._sets([(*found.laws, law) for law in self._promising(found)])
        least = found.log_odds(posterior) + FURTHER_ODDS
        useful = [t for t in tried if t.left.total <= most and t.explained > found.explained]
        best = max(useful, key=lambda t: t.log_odds(posterior), default=None)
        return best if best is not None and best.log_odds(posterior) >= least else None

    def _promising(self, found: EffectSet) -> list[Hypothesis]:
        """Laws that are worth a refit beside those found."""
        candidates, table = self.refit.evidence.candidates, self.refit.table
        alike = self._alike(found)
        factors = {k: v for k, v in found.further.effects.items() if k not in alike}
        left = dict[Hypothesis, float]()
        for law in candidates.hypotheses:
            if law.effect in factors:
                bounds = candidates.bounds(law.columns)
                left[law] = table.linear_fit(law.columns, *bounds, found.rest)[1].total
        by_factor = sorted(factors, key=lambda effect: -factors[effect])[:FURTHER_TRIED]
        # the best law of each effect comes last and is the one that stays
        best_law = {law.effect: law for law in sorted(left, key=lambda law: -left[law])}
        by_left = sorted(best_law, key=lambda effect: left[best_law[effect]])[:FURTHER_TRIED]
        return list(
            dict.fromkeys([found.further.best[k] for k in by_factor] + [best_law[k] for k in by_left])
        )

    def _alike(self, found: EffectSet) -> set[str]:
        """Effects whose signature is that of one found: beside it they explain where its law is wrong."""
        evidence = self.refit.evidence
        whole = signatures(evidence.runs, len(evidence.candidates.keys))
        parts = (found.one(effect) for effect in found.effects)
        return {
            name
            for part in parts
            if part is not None
            for name in same_signature(whole, evidence.candidates, part[0], part[1], [*found.further.effects])
        }


def _joined(laws: Laws) -> Hypothesis:
    """Several laws as one."""
    effects, names = (" and ".join(h.effect for h in laws), " and ".join(h.form for h in laws))
    return Hypothesis(effects, names, tuple(column for h in laws for column in h.columns))


def joint_log_odds(found: EffectSet, posterior: CausePosterior) -> dict[str, float]:
    """Log odds of several effects found, each as what all of them leave, in the order found."""
    if len(found.laws) < 2:
        return {}
    odds = found.log_odds(posterior) - FURTHER_ODDS * (len(found.laws) - 1)
    return {name: max(odds, posterior.odds[name]) - 1e-6 * i for i, name in enumerate(found.effects)}


def null_explained(references: Sequence[PooledScores], P: int) -> tuple[float, float]:
    """Mean and standard deviation of what all P columns together explain in references judged by others."""
    explained = [pooled.fit(range(P))[2] for pooled in references]
    if not explained:
        return float(P), math.sqrt(2.0 * P)
    return float(np.mean(explained)), float(np.std(explained)) + 1e-9


def explained_share(
    pooled: PooledScores, columns: Sequence[int], floor: tuple[float, float], least: float = 0.0
) -> float:
    """Share of the gap that some columns explain, of what all columns do; `least` is what they are known to;
    `floor` as by `null_explained`."""
    whole = pooled.fit(range(pooled.own))[2] - floor[0]
    mine = max(pooled.fit(columns)[2] - len(columns), least)
    return float(np.clip(mine / max(whole, floor[1], 1e-9), 0.0, 1.0))
