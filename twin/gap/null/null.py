"""The learned null: how scores scatter from run to run where nothing has changed.

Calibration errors and the twin's known deficiencies shift and correlate the scores of every run. Their mean
and covariance are learnt from reference runs; the covariance is shrunk to the Fisher information, which it
would be were the twin right (Ledoit and Wolf 2004: shrinkage to a structured target).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.null.score import Score

Array = NDArray[np.float64]

SHRINK_RUNS = 8.0  # weight of the Fisher information, in reference runs (tuned on twin trials)
JITTER = 0.02  # variance added to a standardised score: no combination of scores is taken as exact


@dataclass(frozen=True, eq=False)
class Null:
    """Standardised scores x = D^-1/2 (b - A phi0) are N(mean, covariance) in a reference run.

    Attributes:
        offset: (P,) phi0, common to all references, in the columns' units.
        mean: (P,) of x.
        covariance: (P, P), including that of the mean.
        runs: number of references.
    """

    offset: Array
    mean: Array
    covariance: Array
    runs: int

    @functools.cached_property
    def inverse(self) -> Array:
        """(P, P) inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    def standardised(self, run: Score) -> tuple[Array, Array]:
        """x - mean (P,) of a run, and the change of x by the columns (P, P)."""
        return run.root * (run.b - run.A @ self.offset) - self.mean, run.root[:, None] * run.A


def common_offset(references: Sequence[Score]) -> Array:
    """Offset (P,) common to all references, in the columns' units (ridge, one unit)."""
    P = len(references[0].b)
    total = sum((r.A for r in references), np.zeros((P, P)))
    shared = sum((r.b for r in references), np.zeros(P))
    return np.asarray(np.linalg.solve(total + np.eye(P), shared), dtype=np.float64)


def learn_null(references: Sequence[Score], judged: int) -> Null:
    """The null of the references, for judging so many runs together."""
    count, P = len(references), len(references[0].b)
    offset = common_offset(references)
    x = np.array([r.root * (r.b - r.A @ offset) for r in references])
    fisher = sum((r.fisher for r in references), np.zeros((P, P))) / count
    mean: Array = np.asarray(x.mean(axis=0))
    centred = x - mean
    observed = centred.T @ centred
    # Inflation of each score's variance over the Fisher information, itself shrunk to their median.
    ratio = (np.diag(observed) + SHRINK_RUNS * np.diag(fisher)) / (
        (count - 1 + SHRINK_RUNS) * np.maximum(np.diag(fisher), 1e-9)
    )
    stretch = np.sqrt(np.maximum(ratio, 0.25))
    target = stretch[:, None] * fisher * stretch
    covariance = (observed + SHRINK_RUNS * target) / (count - 1 + SHRINK_RUNS)
    covariance = covariance + JITTER * np.eye(P)
    covariance *= 1.0 + judged / count
    return Null(offset, mean, covariance, count)
