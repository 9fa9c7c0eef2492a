"""Candidate selection: the laws that are refitted through the twin, and the posterior of all causes."""

from __future__ import annotations

from terrafusion.twin.gap.data.candidates import SOIL_STRENGTH, Hypothesis
from terrafusion.twin.gap.infer.cause_posterior import CausePosterior, linear_residuals
from terrafusion.twin.gap.infer.nonlinear_refit import LawFit, NonlinearRefit
from terrafusion.twin.gap.infer.posterior import bayes_factors
from terrafusion.twin.gap.infer.refit import Refit

BY_ODDS, BY_FACTOR, BY_SCREEN = 7, 4, 5
"""Laws that are refitted: the best by what remains in the channels to first order, by Bayes factor, and by
what remains of one run at a few sizes; also all insensitive ones."""


def select_and_refit(
    refit: NonlinearRefit, detected: bool
) -> tuple[CausePosterior, dict[Hypothesis, LawFit], dict[Hypothesis, Refit]]:
    """The posterior of all causes, the fits of the most probable laws, and failed fits; without a gap nothing
    is refitted."""
    candidates, pooled = refit.evidence.candidates, refit.pooled
    residuals, sizes = linear_residuals(refit.table, pooled, candidates)
    if not detected:
        return CausePosterior.of(pooled, refit.table, residuals), {}, {}
    factors = bayes_factors(pooled, candidates).forms
    laws = [law for law in residuals if law.effect != SOIL_STRENGTH]
    best = sorted(laws, key=lambda law: residuals[law].total)[:BY_ODDS]
    best += sorted(laws, key=lambda law: -factors[law.effect, law.form])[:BY_FACTOR]
    best += [law for law in residuals if law.effect == SOIL_STRENGTH or refit.is_insensitive(law)]
    screened = refit.screened()
    by_screen = sorted(screened, key=lambda law: screened[law][1])[:BY_SCREEN]
    further = [(law, screened[law][0]) for law in by_screen]
    fits, failed = refit.fits([(law, sizes[law]) for law in dict.fromkeys([*best, *by_screen])], further)
    return CausePosterior.of(pooled, refit.table, residuals, fits, gap=refit.gap), fits, failed
