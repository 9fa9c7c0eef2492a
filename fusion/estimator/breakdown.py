"""Where a graph has no finite solution, the estimator refuses the sample, starts anew and counts it.

It happens where sensors contradict each other, such as an accelerometer in g or wheels in rev/min.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import DataError

BREAKDOWN = (ArithmeticError, np.linalg.LinAlgError, RuntimeError)
"""What NumPy, GTSAM and the elimination raise where a system has no solution."""


class CallbackError(Exception):
    """An error of a callback of the caller: it says nothing of the sensors."""

    def __init__(self, error: Exception) -> None:
        super().__init__(error)
        self.error = error


def call_back(callback: Callable[[Any], None] | None, value: Any) -> None:
    """Call a callback of the caller; its errors pass `starts_anew` as they are."""
    if callback is None:
        return
    try:
        callback(value)
    except BREAKDOWN as error:
        raise CallbackError(error) from error


def starts_anew(advance: Callable[..., None]) -> Callable[..., None]:
    """A method that makes keyframes, guarded: where the numbers break down, the estimator starts anew.

    It is as it was made, without its buffers and a given start; `breakdowns` counts on, and turns by gyro
    and wheels are still compared.
    """

    @functools.wraps(advance)
    def guarded(estimator: Any, last: bool = False) -> None:
        before = estimator.latest()
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                advance(estimator, last)
            state = None if estimator.latest() is before else estimator.latest()
            if state is not None and not math.isfinite(state.covariance.sum() + sum(state.position_m)):
                raise ArithmeticError("a state is not finite")
        except CallbackError as passed:
            raise passed.error from None
        except BREAKDOWN as error:
            estimator.breakdowns += 1
            unit = estimator.gyro.unit  # what the gyro reports in is still the same
            estimator.reset()
            estimator.gyro.unit = unit
            raise unit.blamed() or DataError(
                "the sensors contradict each other so far that no state fits them; the estimator starts anew",
                remedy="check units, axes and vehicle file with `terrafusion inspect`",
            ) from error

    return guarded
