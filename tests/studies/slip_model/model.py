"""Mean and spread of slip from features: two ridge regressions on a quadratic basis, calibrated by group."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RIDGE, MOST = 30.0, 3.0
"""Penalty on standardised columns; standardised features are clipped here, for robots unlike any other."""
SHARES = (0.5, 0.95)
LEAST_SIGMA = 0.02


@dataclass(frozen=True, eq=False)
class SlipModel:
    """`mean`, `scale` (d,) of the features; `slip`, `spread` (p,) weights of slip and log variance.

    `factors`: half widths of the intervals of `SHARES`, in predicted sigmas.
    """

    mean: Array
    scale: Array
    slip: Array
    spread: Array
    factors: tuple[float, float]

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Slip (n,) and its sigma (n,) for features (n, d)."""
        basis = quadratic_basis((x - self.mean) / self.scale)
        sigma = np.exp(0.5 * np.clip(basis @ self.spread, -9.0, 1.0))
        return np.clip(basis @ self.slip, -1.0, 1.5), np.maximum(sigma, LEAST_SIGMA)

    def sha256(self) -> str:
        """Hash of all numbers, six digits."""
        numbers = np.concatenate([self.mean, self.scale, self.slip, self.spread, self.factors])
        return hashlib.sha256(" ".join(f"{n:.6g}" for n in numbers).encode()).hexdigest()


def fit(x: Array, slip: Array, groups: Sequence[str]) -> SlipModel:
    """A model of windows (n, d); `groups` (n,) are left out in turn to find spread and interval widths."""
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    basis, group = quadratic_basis((x - mean) / scale), np.asarray(groups)
    names = np.unique(group)
    left_out = np.empty(len(slip))
    for name in names:
        inside = group == name
        left_out[inside] = basis[inside] @ _ridge(basis[~inside], slip[~inside])
    log_square = np.log((slip - left_out) ** 2 + 1e-4) + 1.27  # mean of log chi-square of one degree
    spread = _ridge(basis, log_square)
    scaled = np.empty(len(slip))
    for name in names:
        inside = group == name
        log_variance = basis[inside] @ _ridge(basis[~inside], log_square[~inside])
        sigma = np.exp(0.5 * np.clip(log_variance, -9.0, 1.0))
        scaled[inside] = np.abs(slip[inside] - left_out[inside]) / np.maximum(sigma, LEAST_SIGMA)
    half, most = np.quantile(scaled, SHARES).tolist()
    return SlipModel(mean, scale, _ridge(basis, slip), spread, (half, most))


def quadratic_basis(z: Array) -> Array:
    """One, standardised features (n, d), and their products."""
    z = np.clip(z, -MOST, MOST)
    rows, columns = np.triu_indices(z.shape[1])
    return np.hstack([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns] / MOST])


def _ridge(basis: Array, values: Array) -> Array:
    penalty = RIDGE * np.eye(basis.shape[1])
    penalty[0, 0] = 0.0
    return np.asarray(np.linalg.solve(basis.T @ basis + penalty, basis.T @ values))
