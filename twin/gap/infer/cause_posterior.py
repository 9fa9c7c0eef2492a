"""Posterior of the causes: odds from what each leaves unexplained, calibrated on a plant that is not the
twin.

A conditional logit (McFadden 1974) on the share of the gap that each cause leaves: the log odds between two
causes are a slope times the difference of their shares, steeper where the gap is large. A cause outside the
catalogue is one more alternative, the more probable the less of the gap anything explains. A small
probability, the lapse, is spread evenly: some laws of the robot are nearer to another effect of the twin than
to their own. The weights are fitted to trials of the blind check's plant with other seeds than its own
(`python -m tests.studies.blind.development`) and stored in `cause_posterior.yaml`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.data.candidates import Candidates, Hypothesis
from terrafusion.twin.gap.infer.channels import ChannelTable, Unexplained
from terrafusion.twin.gap.infer.goodness_of_fit import PERFECT_FIT, GoodnessOfFit
from terrafusion.twin.gap.infer.nonlinear_refit import LawFit
from terrafusion.twin.gap.infer.posterior import PooledScores

Array = NDArray[np.float64]

LEAST_GAP = 0.5  # least size of a gap (in the units of `CauseResidual`)
OUTSIDE_SHARE = 0.2  # prior share of gaps with a cause outside the catalogue, as in a blind check
LAPSE = 0.02  # probability that the odds do not hold (assumed), spread evenly over all causes


@dataclass(frozen=True)
class CauseResidual:
    """What a cause leaves: inside and outside the candidates' space of all channels, and the logarithm of the
    greatest deviation (its square, in the typical one) of any effect's own score."""

    inside: float
    outside: float
    most: float

    @classmethod
    def of(cls, left: Unexplained, squares: Array) -> CauseResidual:
        """Of what remains in the channels, and the squares (P,) of the deviations."""
        return cls(left.inside, left.outside, math.log(max(float(squares.max()), 1.0)))

    @property
    def total(self) -> float:
        """All three."""
        return self.inside + self.outside + self.most


@dataclass(frozen=True)
class PosteriorWeights:
    """Weights of the odds.

    Attributes:
        slope: by the share that remains, times the root of the gap.
        share: that an unknown cause is taken to leave.
        unknown: its log odds, beside a cause of the catalogue that leaves as much and fits.
        misfit, quieter: increase of these, times those of the most probable effects (see `GoodnessOfFit`).
    """

    slope: float
    share: float
    unknown: float
    misfit: float
    quieter: float

    def log_odds(self, residual: CauseResidual, before: CauseResidual) -> float:
        """Log odds of a cause that leaves this of a gap, up to a constant."""
        return -self.slope * residual.total / math.sqrt(max(before.total, LEAST_GAP))

    def unknown_log_odds(self, before: CauseResidual, fit: GoodnessOfFit = PERFECT_FIT) -> float:
        """The same of an unknown cause, beside effects that fit so well."""
        by_share = self.slope * self.share * math.sqrt(max(before.total, LEAST_GAP))
        return self.unknown + self.misfit * fit.misfit + self.quieter * fit.quieter - by_share


@functools.cache
def posterior_weights() -> PosteriorWeights:
    """Those that come with the package.

    Raises:
        ConfigError: the file lacks one.
    """
    from terrafusion.datasets.core.config import structure
    from terrafusion.datasets.core.yaml_file import read_yaml

    with resources.as_file(resources.files("terrafusion.twin.gap.infer") / "cause_posterior.yaml") as path:
        weights = read_yaml(path).get("weights")
        return structure(PosteriorWeights, weights, file=path, key="weights")


@dataclass(frozen=True, eq=False)
class CausePosterior:
    """The odds of all causes.

    Attributes:
        laws: the best law of each effect.
        residuals: what it leaves, by effect.
        before: the gap as it is.
        odds: log odds by effect.
        unknown: those of a cause outside the catalogue.
        weights: of the odds.
    """

    laws: dict[str, Hypothesis]
    residuals: dict[str, CauseResidual]
    before: CauseResidual
    odds: dict[str, float]
    unknown: float
    weights: PosteriorWeights

    @classmethod
    def of(
        cls,
        pooled: PooledScores,
        table: ChannelTable,
        linear: Mapping[Hypothesis, CauseResidual],
        fits: Mapping[Hypothesis, LawFit] | None = None,
        weights: PosteriorWeights | None = None,
        gap: Unexplained | None = None,
    ) -> CausePosterior:
        """From what all laws leave to first order, and what the refitted ones do.

        Args:
            gap: what remains without any law; None: to first order.
        """
        weights = posterior_weights() if weights is None else weights
        before = CauseResidual.of(table.before() if gap is None else gap, pooled.marginal.squares())
        laws: dict[str, Hypothesis] = {}
        least: dict[str, CauseResidual] = {}
        for law, first in linear.items():
            now = first
            if fits is not None and law in fits:
                now = CauseResidual.of(fits[law].left, fits[law].fit.squares)
            if law.effect not in laws or now.total < least[law.effect].total:
                laws[law.effect], least[law.effect] = law, now
        odds = {effect: weights.log_odds(now, before) for effect, now in least.items()}
        return cls(laws, least, before, odds, weights.unknown_log_odds(before), weights)

    def ranked(self) -> list[str]:
        """Effects, the most probable first."""
        return sorted(self.odds, key=lambda effect: -self.odds[effect])

    def with_odds(self, more: Mapping[str, float]) -> CausePosterior:
        """Some effects at other log odds."""
        return dataclasses.replace(self, odds={**self.odds, **more})

    def with_fit(self, fit: GoodnessOfFit) -> CausePosterior:
        """The same once the goodness of fit of the most probable effects is known."""
        return dataclasses.replace(self, unknown=self.weights.unknown_log_odds(self.before, fit))

    def probabilities(self) -> tuple[dict[str, float], float]:
        """Of the effects and of an unknown cause, given that there is a gap."""
        return probabilities(self.odds, self.unknown)


def probabilities(odds: Mapping[str, float], unknown: float) -> tuple[dict[str, float], float]:
    """Of causes with these log odds and of the unknown one."""
    values = np.array([*odds.values(), unknown])
    shares = np.exp(values - values.max())
    shares = (1.0 - LAPSE) * shares / shares.sum() + LAPSE / len(shares)
    *known, last = shares.tolist()
    return dict(zip(odds, known, strict=True)), last


def linear_residuals(
    table: ChannelTable, pooled: PooledScores, candidates: Candidates
) -> tuple[dict[Hypothesis, CauseResidual], dict[Hypothesis, Array]]:
    """What every law leaves to first order, and its sizes (k,)."""
    residuals, sizes = dict[Hypothesis, CauseResidual](), dict[Hypothesis, Array]()
    for law in candidates.hypotheses:
        sizes[law], left = table.linear_fit(law.columns, *candidates.bounds(law.columns))
        residuals[law] = CauseResidual.of(left, pooled.marginal.squares(law.columns, sizes[law]))
    return residuals, sizes
