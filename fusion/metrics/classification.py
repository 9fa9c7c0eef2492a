"""Scores of a classifier's probabilities."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

ECE_BINS = 10


@dataclass(frozen=True)
class ClassificationScores:
    """Scores over windows.

    Attributes:
        classes: k names.
        macro_f1: mean F1 of the classes that occurred.
        accuracy: share of windows with the right class.
        ece: expected calibration error of the most probable class.
        confusion: (k, k) shares; a row is a true class and sums to one, or to zero if it did not occur.
        windows: their number.
    """

    classes: tuple[str, ...]
    macro_f1: float
    accuracy: float
    ece: float
    confusion: tuple[tuple[float, ...], ...]
    windows: int


def classification_scores(
    classes: Sequence[str], true: NDArray[np.intp], winner: NDArray[np.intp], confidence: Array
) -> ClassificationScores:
    """Scores of n windows: indices (n,) of true and most probable class, and its probability (n,)."""
    k = len(classes)
    counts = np.bincount(true * k + winner, minlength=k * k).reshape(k, k)
    hits, of_class = np.diag(counts), counts.sum(axis=1)
    f1 = 2.0 * hits / np.maximum(of_class + counts.sum(axis=0), 1)
    shares = counts / np.maximum(of_class, 1)[:, None]
    return ClassificationScores(
        classes=tuple(classes),
        macro_f1=float(f1[of_class > 0].mean()),
        accuracy=float((true == winner).mean()),
        ece=calibration_error(confidence, winner == true),
        confusion=tuple(tuple(row) for row in shares.tolist()),
        windows=len(true),
    )


def calibration_error(confidence: Array, correct: NDArray[np.bool_]) -> float:
    """Expected calibration error (Naeini et al. 2015) of probabilities (n,)."""
    bins = np.minimum((confidence * ECE_BINS).astype(int), ECE_BINS - 1)
    gap = np.bincount(bins, weights=confidence - correct, minlength=ECE_BINS)
    return float(np.abs(gap).sum() / len(confidence))
