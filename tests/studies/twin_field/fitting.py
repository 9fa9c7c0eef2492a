"""One criterion for every model that is fitted: residuals in half-second means, robust, bounded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.studies.twin_field.forks import Forks, half_second_means

Array = NDArray[np.float64]

SPEED_MPS, SIDE_MPS, TURN_RADPS = 0.1, 0.2, 0.05
"""What counts as one unit of misfit in forward speed, sideways speed, yaw rate."""
LOSS: Any = "soft_l1"
DIFFERENCE: Any = 1e-5
EDGE = 0.02
"""No start is nearer to an end of its range than this share of it."""


@dataclass(frozen=True)
class Bounded:
    """A number to be fitted: where to start, and its range."""

    start: float
    low: float
    high: float


def residuals(prediction: Array, forks: Forks) -> Array:
    """Misfit (F * BINS * 3,) of predictions (F, N_FUTURE + 1, 3); 0 where nothing is known or predicted."""
    off = half_second_means(prediction) - forks.truth()
    if forks.given_turn:
        off[..., 2] = 0.0
    return np.asarray(np.nan_to_num(off / (SPEED_MPS, SIDE_MPS, TURN_RADPS)).ravel())


def fit(
    numbers: Sequence[Bounded],
    predict: Callable[[Array], Array],
    forks: Forks,
    *,
    doubts: Array | None = None,
    rounds: int = 60,
) -> Array:
    """The numbers (P,) that fit best, by trust-region least squares with the loss `LOSS` (scipy).

    Bounds are kept by a logistic map of each number's range, so that the steps know no walls.

    Args:
        numbers: starts and ranges.
        predict: motion (F, N_FUTURE + 1, 3) from the numbers.
        forks: to fit on.
        doubts: (P,) standard deviations of the numbers about their starts, None where nothing is known.
        rounds: steps at most.
    """
    from scipy.optimize import least_squares
    from scipy.special import expit, logit

    low, high = np.array([n.low for n in numbers]), np.array([n.high for n in numbers])
    share = (np.array([n.start for n in numbers]) - low) / (high - low)
    first = logit(np.clip(share, EDGE, 1.0 - EDGE))

    def value(z: Array) -> Array:
        return low + (high - low) * expit(first + z)

    middle = value(np.zeros(len(first)))

    def misfit(z: Array) -> Array:
        found = residuals(predict(value(z)), forks)
        return found if doubts is None else np.concatenate([found, (value(z) - middle) / doubts])

    found: Any = least_squares(
        misfit, np.zeros(len(first)), loss=LOSS, max_nfev=rounds,
        diff_step=DIFFERENCE, xtol=1e-4, ftol=1e-4,
    )  # fmt: skip
    return np.asarray(value(found.x))


def cost(prediction: Array, forks: Forks) -> float:
    """The criterion: half the sum of the loss over the residuals."""
    square = residuals(prediction, forks) ** 2
    return float(np.sum(np.sqrt(1.0 + square) - 1.0))
