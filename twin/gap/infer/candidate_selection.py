"""The laws that are worth a fit through the twin, and the odds of all causes once they have one."""

from __future__ import annotations

from terrafusion.twin.gap.data.candidates import SOIL, Hypothesis
from terrafusion.twin.gap.infer.cause_posterior import Choice, Weights, linear, weights
from terrafusion.twin.gap.infer.nonlinear_refit import Fitted, Fitter
from terrafusion.twin.gap.infer.posterior import Beliefs
from terrafusion.twin.gap.infer.refit import Refit

BY_ODDS, BY_FACTOR, BY_SCREEN = 7, 4, 5
"""Laws that are fitted: the best by what channels leave to first order, by Bayes factor, and by what they
leave of one run at a few sizes; beside them those of which the first order says nothing."""


def chosen(
    fitter: Fitter, believed: Beliefs, detected: bool, by: Weights | None = None
) -> tuple[Choice, dict[Hypothesis, Fitted], dict[Hypothesis, Refit]]:
    """The odds of all causes, the fits of the likeliest laws, and fits that failed; without a gap nothing is
    fitted."""
    by = weights() if by is None else by
    candidates = fitter.bench.candidates
    told, sizes = linear(fitter.table, fitter.pool, candidates)
    if not detected:
        return Choice.of(fitter.pool, fitter.table, told, by=by), {}, {}
    laws = [law for law in told if law.effect != SOIL]
    best = sorted(laws, key=lambda law: told[law].total)[:BY_ODDS]
    best += sorted(laws, key=lambda law: -believed.forms[law.effect, law.form])[:BY_FACTOR]
    best += [law for law in told if law.effect == SOIL or fitter.silent(law)]
    screened = fitter.screened()
    seen = sorted(screened, key=lambda law: screened[law][1])[:BY_SCREEN]
    further = [(law, screened[law][0]) for law in seen]
    fitted, failed = fitter.fits([(law, sizes[law]) for law in dict.fromkeys([*best, *seen])], further)
    return Choice.of(fitter.pool, fitter.table, told, fitted, by, fitter.gap), fitted, failed
