"""Does the best explanation fit at all: what it leaves in each channel beside what references leave.

The odds between causes are relative: of many bad explanations one is always the best. So what the effects
found leave is held against the references, each judged by the others (leave one out), channel by channel,
apart inside and outside the candidates' space. A channel counts where its energy differs from the
references' by more than chance (Student's t on its logarithm, with as many looks as there are channels:
Bonferroni). Three numbers are told:

- `above`: by how much the worst channel is above the references;
- `left`: the share of the gap that is still there, of the logarithms by which channels are above them. A
  significant rest alone says little: the law of a large effect is never quite the robot's, and what it
  misses is then far beyond noise. A cause that is none leaves nearly all, so the two count as a product;
- `quieter`: by how much a channel is below the references: no candidate takes noise away.

What they say of an unknown cause is learnt with the odds (`choice.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.infer.channels import Products, Table, energy

Array = NDArray[np.float64]

LEVEL = 0.05
"""Probability that a law that is right differs from the references so in some channel."""
LEAST_GAP = 1.0
"""The gap that a share is taken of counts as no smaller, a sum of logarithms (assumed)."""
LEAST_SPREAD = 0.05
"""1 sigma of the logarithm of a channel's energy from run to run is taken as no less (assumed)."""
FEWEST = 4
"""References without which nothing is known of the scatter."""
MOST_ABOVE, MOST_QUIETER = 3.0, 2.0
"""`Goodness.above` and `Goodness.quieter` are no more (assumed)."""


@dataclass(frozen=True)
class Goodness:
    """What an explanation leaves in channels that differ from the references by more than chance.

    Attributes:
        left: share of the gap, 0 to 1; 0 where no channel is above the references.
        above: logarithm of the factor by which a channel is above them, the greatest; 0 where none is.
        quieter: logarithm of the factor by which a channel is below them, the greatest; 0 where none is.
    """

    left: float
    above: float
    quieter: float

    @property
    def misfit(self) -> float:
        """Share times logarithm of the worst."""
        return self.left * self.above


FITS = Goodness(0.0, 0.0, 0.0)
"""Of effects after which nothing is left."""


def goodness(table: Table, errors: Sequence[Products], weight: Array) -> Goodness:
    """Of effects that leave these errors of the judged runs.

    Args:
        weight: (C,) of the channels, when the states of a run are adapted.
    """
    from scipy.special import stdtrit

    count, runs, C = len(table.each), len(errors), len(weight)
    if count < FEWEST:
        return FITS
    usual = np.log(table.each)
    sigma = np.maximum(usual.std(axis=0, ddof=1), LEAST_SPREAD) * math.sqrt(1.0 / runs + 1.0 / count)
    chance = sigma * float(stdtrit(count - 1, 1.0 - LEVEL / (4 * C)))

    def beyond(some: Sequence[Products]) -> Array:
        pairs = zip(table.blocks, some, strict=True)
        each = [np.log(energy(block, error, table.sigma, weight)) for block, error in pairs]
        return np.asarray(np.mean(each, axis=0) - usual.mean(axis=0))

    gap, change = beyond([block.error for block in table.blocks]), beyond(errors)
    whole, rest = (float(some[some > chance].sum()) for some in (gap, change))
    above = float(np.max(change, where=change > chance, initial=0.0))
    quieter = float(np.max(-change, where=change < -chance, initial=0.0))
    left = min(rest / max(whole, LEAST_GAP), 1.0)
    return Goodness(left, min(above, MOST_ABOVE), min(quieter, MOST_QUIETER))
