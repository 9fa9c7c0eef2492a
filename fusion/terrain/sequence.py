"""The ground comes in patches: a hidden Markov model over the terrain classes.

The class changes with the distance driven, not with time: a robot that stands
still stays where it is. Over a distance d the class is kept with probability
exp(-d / L), L being the expected length of a patch, else any other class
follows with equal probability (Rabiner 1989, forward recursion).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

FLOOR = 1e-5
"""Smallest probability of a class: what lets the filter leave a class it was sure of."""


class PatchFilter:
    """Forward filter; `probabilities` (k,) always are at least `FLOOR` and sum to one."""

    def __init__(self, n_classes: int, patch_length_m: float) -> None:
        self.patch_length_m = patch_length_m
        self.probabilities: Array = np.full(n_classes, 1.0 / n_classes)

    def predict(self, distance_m: float) -> Array:
        """Drive on by `distance_m` (>= 0) without looking."""
        k = len(self.probabilities)
        leave = -np.expm1(-max(float(distance_m), 0.0) / self.patch_length_m)
        if k > 1 and np.isfinite(leave):
            p = self.probabilities
            self._set(p * (1.0 - leave) + (1.0 - p) * leave / (k - 1))
        return self.probabilities

    def update(self, log_likelihood: ArrayLike) -> Array:
        """Weigh the classes by log-evidence (k,), known up to a constant; with NaN or +inf there is none."""
        evidence = np.asarray(log_likelihood, dtype=float)
        top = evidence.max()
        if np.isfinite(top):
            self._set(self.probabilities * np.exp(evidence - top))
        return self.probabilities

    def _set(self, weights: Array) -> None:
        total = weights.sum()
        if not total > 0.0:
            return
        k = len(weights)
        self.probabilities = FLOOR + (1.0 - k * FLOOR) * (weights / total)
