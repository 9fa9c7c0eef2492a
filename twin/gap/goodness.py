"""Does the best explanation fit at all: what it leaves in each channel beside what references leave.

The odds between causes are relative: of many bad explanations one is always the best. So what the effects
found leave is held against the references, each judged by the others (leave one out), channel by channel,
apart inside and outside the candidates' space. An explanation does not fit where a channel's energy differs
from the references' by more than chance (Student's t on its logarithm, with as many looks as there are
channels: Bonferroni) and

- is less: no candidate takes noise away; or
- is `FACTOR` times what references leave and what a law of another form may: a share of what the effects
  themselves do there. A large effect is never quite the catalogue's; where it does little it leaves little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.channels import Products, Table, energy

Array = NDArray[np.float64]

LEVEL = 0.05
"""Probability that a law that is right differs from the references so in some channel."""
OWN_SHARE, FACTOR = 0.3, 4.0
"""Share, in amplitude, of what effects do in a channel that their law may miss, and the factor by which the
energy must be above it (both set on development trials)."""
LEAST_SPREAD = 0.05
"""1 sigma of the logarithm of a channel's energy from run to run is taken as no less (assumed)."""
FEWEST = 4
"""References without which nothing is known of the scatter."""
MOST_MISFIT = 2.0
"""`Goodness.misfit` is kept within so much (assumed)."""


@dataclass(frozen=True)
class Goodness:
    """Logarithm of the factor by which a channel's energy is above what it may be (or below the references',
    `FACTOR` times): the greatest of all that differ from the references by more than chance, 0 where none
    does; and which channel that is."""

    beyond: float
    channel: int | None

    @property
    def misfit(self) -> float:
        """How far it is above what is allowed."""
        return float(np.clip(self.beyond - math.log(FACTOR), -MOST_MISFIT, MOST_MISFIT))

    @property
    def fits(self) -> bool:
        """Whether it is within that."""
        return self.misfit <= 0.0


def goodness(table: Table, errors: Sequence[Products], done: Sequence[Products], weight: Array) -> Goodness:
    """Of effects that leave these errors of the judged runs, and do so much in them.

    Args:
        weight: (C,) of the channels, when the states of a run are adapted.
    """
    from scipy.special import stdtrit

    count, runs, C = len(table.each), len(errors), len(weight)
    if count < FEWEST:
        return Goodness(0.0, None)
    usual = np.log(table.each)
    sigma = np.maximum(usual.std(axis=0, ddof=1), LEAST_SPREAD) * math.sqrt(1.0 / runs + 1.0 / count)
    floor = np.exp(usual.mean(axis=0))
    left, own = (
        np.array([energy(b, e, table.sigma, weight) for b, e in zip(table.blocks, some, strict=True)])
        for some in (errors, done)
    )
    change = np.log(left / floor).mean(axis=0)
    more = np.log(left / (floor + OWN_SHARE**2 * own)).mean(axis=0)
    beyond = np.where(change > 0.0, more, math.log(FACTOR) - change)
    by_chance = np.abs(change) <= sigma * float(stdtrit(count - 1, 1.0 - LEVEL / (4 * C)))
    beyond[by_chance] = 0.0
    at = int(beyond.argmax())
    return Goodness(max(float(beyond[at]), 0.0), at % C if beyond[at] > 0.0 else None)
