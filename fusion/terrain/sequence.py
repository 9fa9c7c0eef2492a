"""Hidden Markov model over the terrain classes: the ground comes in patches.

The class changes with the distance driven, not with time. Patches are L long on average, and what follows
is drawn from the prior (Rabiner 1989, forward recursion, of a chain continuous in distance). Driven far
without observation, the filter returns to the prior.
"""

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array

FLOOR = 1e-5
"""Probability floor, so that no single window excludes a class."""


class PatchFilter:
    """Forward filter; `probabilities` (k,) always are at least `FLOOR` and sum to one."""

    def __init__(self, n_classes: int, patch_length_m: float, prior: Array | None = None) -> None:
        self.patch_length_m = patch_length_m
        self.prior: Array = np.full(n_classes, 1.0 / n_classes) if prior is None else prior
        self.probabilities: Array = self.prior.copy()

    def predict(self, distance_m: float) -> Array:
        """Drive on by `distance_m` (>= 0) without an observation."""
        k = len(self.probabilities)
        # The ground is drawn anew from the prior, which may give the same one again: k / (k - 1)
        # makes a patch `patch_length_m` long where all are equally likely.
        drawn = -np.expm1(-max(float(distance_m), 0.0) / self.patch_length_m * k / max(k - 1, 1))
        if k > 1 and np.isfinite(drawn):
            self._set(self.probabilities * (1.0 - drawn) + self.prior * drawn)
        return self.probabilities

    def forget(self) -> None:
        """Begin a new patch, of which nothing is known."""
        self.probabilities = self.prior.copy()

    def update(self, log_likelihood: ArrayLike) -> Array:
        """Weight the classes by log-evidence (k,), known up to a constant; NaN or +inf count as none."""
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
