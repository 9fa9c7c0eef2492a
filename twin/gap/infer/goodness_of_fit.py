"""Goodness of fit: does the best explanation fit at all, channel by channel, beside the references.

The odds between causes are relative: of many bad explanations one is always best. So the errors that remain
with the effects in the twin are compared with the references, each judged by the others, by channel and
inside and outside the candidates' space. A channel counts where its energy differs by more than chance
(Student's t on its logarithm, Bonferroni over channels). The effect of these numbers on the odds of an
unknown cause is learnt (see `cause_posterior`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.infer.channels import ChannelTable, ErrorProducts, run_energy

Array = NDArray[np.float64]

LEVEL = 0.05  # probability that a correct law differs from the references in some channel
LEAST_GAP = 1.0  # least gap that a share is taken of, a sum of logarithms (assumed)
LEAST_SPREAD = 0.05  # least 1 sigma of the logarithm of a channel's energy from run to run (assumed)
FEWEST = 4  # references without which the scatter is unknown
MOST_ABOVE, MOST_QUIETER = 3.0, 2.0  # limits of `GoodnessOfFit.above` and `quieter` (assumed)


@dataclass(frozen=True)
class GoodnessOfFit:
    """What remains in channels that differ from the references by more than chance.

    Attributes:
        left: share of the gap, 0 to 1; 0 where no channel is above the references. The law of a large effect
            is never quite right, so a significant rest alone means little; it counts as a product with
            `above`.
        above: logarithm of the factor by which the worst channel is above them; 0 where none is.
        quieter: logarithm of the factor by which the worst channel is below them: no candidate reduces noise.
    """

    left: float
    above: float
    quieter: float

    @property
    def misfit(self) -> float:
        """Share times logarithm of the worst."""
        return self.left * self.above


PERFECT_FIT = GoodnessOfFit(0.0, 0.0, 0.0)


def goodness_of_fit(table: ChannelTable, errors: Sequence[ErrorProducts], weight: Array) -> GoodnessOfFit:
    """Of effects with which these errors of the judged runs remain.

    Args:
        weight: (C,) of the channels, when the states of a run are fitted.
    """
    from scipy.special import stdtrit

    count, runs, C = len(table.references), len(errors), len(weight)
    if count < FEWEST:
        return PERFECT_FIT
    typical = np.log(table.references)
    sigma = np.maximum(typical.std(axis=0, ddof=1), LEAST_SPREAD) * math.sqrt(1.0 / runs + 1.0 / count)
    chance = sigma * float(stdtrit(count - 1, 1.0 - LEVEL / (4 * C)))

    def beyond(some: Sequence[ErrorProducts]) -> Array:
        pairs = zip(table.runs, some, strict=True)
        each = [np.log(run_energy(run, error, table.sigma, weight)) for run, error in pairs]
        return np.asarray(np.mean(each, axis=0) - typical.mean(axis=0))

    gap, change = beyond([run.error for run in table.runs]), beyond(errors)
    whole, rest = (float(some[some > chance].sum()) for some in (gap, change))
    above = float(np.max(change, where=change > chance, initial=0.0))
    quieter = float(np.max(-change, where=change < -chance, initial=0.0))
    left = min(rest / max(whole, LEAST_GAP), 1.0)
    return GoodnessOfFit(left, min(above, MOST_ABOVE), min(quieter, MOST_QUIETER))
