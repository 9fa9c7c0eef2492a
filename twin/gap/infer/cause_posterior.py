"""Which effect, and how sure: odds from what each leaves of the gap, calibrated on a plant that is no twin.

A conditional logit (McFadden 1974) on the share of the gap that each leaves: the odds between two causes are
the exponential of a slope times the difference of their shares, steeper where the gap is large. A cause
outside the catalogue is one more alternative, the likelier the less of the gap anything explains. A small
part of the probability, the lapse, is spread evenly: some laws of the robot are nearer to another effect of
the twin than to their own. Slope and unknown are fitted to trials of the blind check's plant of other seeds
than its own (`python -m tests.studies.blind.development`), laws of other forms and causes outside the
catalogue among them, and kept in `choice.yaml`.
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
from terrafusion.twin.gap.infer.channels import Left, Table
from terrafusion.twin.gap.infer.goodness_of_fit import FITS, Goodness
from terrafusion.twin.gap.infer.nonlinear_refit import Fitted, bounds
from terrafusion.twin.gap.infer.posterior import Pool

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Told:
    """What a cause leaves: over channels inside and outside the candidates' space, and the logarithm of the
    greatest deviation (its square, in what is usual) of any effect's own score."""

    inside: float
    outside: float
    most: float

    @classmethod
    def of(cls, left: Left, squares: Array) -> Told:
        """Of what is left in the channels, and the squares (P,) of the deviations."""
        return cls(left.inside, left.outside, math.log(max(float(squares.max()), 1.0)))

    @property
    def total(self) -> float:
        """All three."""
        return self.inside + self.outside + self.most


LEAST = 0.5
"""A gap counts as no smaller than this (in the units of `Told`)."""
OUTSIDE_SHARE = 0.2
"""Of gaps, so many are taken to have a cause outside the catalogue before anything is seen, as in a blind
check."""
LAPSE = 0.02
"""Probability that the odds do not hold (assumed): it is spread evenly over all causes."""


@dataclass(frozen=True)
class Weights:
    """Of the odds: `slope` by the share that is left, times the root of the gap; `share` that an unknown
    cause is taken to leave, and its log odds, `unknown`, beside one of the catalogue that leaves as much and
    fits; these rise by `misfit` and `quieter` times those of the likeliest effects (see `Goodness`)."""

    slope: float
    share: float
    unknown: float
    misfit: float
    quieter: float

    def cause(self, told: Told, before: Told) -> float:
        """Log odds of a cause that leaves this of a gap, up to a constant."""
        return -self.slope * told.total / math.sqrt(max(before.total, LEAST))

    def outsider(self, before: Told, good: Goodness = FITS) -> float:
        """The same of an unknown cause, beside effects that fit so well."""
        by_share = self.slope * self.share * math.sqrt(max(before.total, LEAST))
        return self.unknown + self.misfit * good.misfit + self.quieter * good.quieter - by_share


@functools.cache
def weights() -> Weights:
    """Those that come with the package.

    Raises:
        ConfigError: the file lacks one.
    """
    from terrafusion.datasets.core.config import read_yaml
    from terrafusion.datasets.core.errors import ConfigError

    with resources.as_file(resources.files("terrafusion.twin.gap.infer") / "cause_posterior.yaml") as path:
        read = read_yaml(path)
        names = [field.name for field in dataclasses.fields(Weights)]
        if set(read.get("weights", {})) != set(names):
            raise ConfigError("weights are missing or unknown", file=path, remedy="train them again")
        return Weights(**{name: float(read["weights"][name]) for name in names})


@dataclass(frozen=True, eq=False)
class Choice:
    """The odds of all causes.

    Attributes:
        laws: the best law of each effect.
        told: what it leaves, by effect.
        before: the gap as it is.
        odds: log odds by effect.
        unknown: of a cause outside the catalogue.
        by: weights.
    """

    laws: dict[str, Hypothesis]
    told: dict[str, Told]
    before: Told
    odds: dict[str, float]
    unknown: float
    by: Weights

    @classmethod
    def of(
        cls,
        pool: Pool,
        table: Table,
        told: Mapping[Hypothesis, Told],
        fitted: Mapping[Hypothesis, Fitted] | None = None,
        by: Weights | None = None,
        gap: Left | None = None,
    ) -> Choice:
        """From what all laws leave to first order, and what those fitted through the twin do.

        Args:
            gap: what is left without any there; None: to first order.
        """
        by = weights() if by is None else by
        before = Told.of(table.before() if gap is None else gap, pool.alone.squares())
        laws: dict[str, Hypothesis] = {}
        least: dict[str, Told] = {}
        for law, first in told.items():
            now = first
            if fitted is not None and law in fitted:
                now = Told.of(fitted[law].left, fitted[law].fit.squares)
            if law.effect not in laws or now.total < least[law.effect].total:
                laws[law.effect], least[law.effect] = law, now
        odds = {effect: by.cause(now, before) for effect, now in least.items()}
        return cls(laws, least, before, odds, by.outsider(before), by)

    def first(self) -> str:
        """The likeliest effect."""
        return max(self.odds, key=lambda effect: self.odds[effect])

    def with_odds(self, more: Mapping[str, float]) -> Choice:
        """Some effects at other log odds."""
        return dataclasses.replace(self, odds={**self.odds, **more})

    def after(self, good: Goodness) -> Choice:
        """The same once it is known how well the likeliest effects fit."""
        return dataclasses.replace(self, unknown=self.by.outsider(self.before, good))

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


def linear(
    table: Table, pool: Pool, candidates: Candidates
) -> tuple[dict[Hypothesis, Told], dict[Hypothesis, Array]]:
    """What every law leaves to first order, and its sizes (k,)."""
    told, sizes = dict[Hypothesis, Told](), dict[Hypothesis, Array]()
    for law in candidates.hypotheses:
        sizes[law], left = table.linear(law.columns, *bounds(candidates, law.columns))
        told[law] = Told.of(left, pool.alone.squares(law.columns, sizes[law]))
    return told, sizes
