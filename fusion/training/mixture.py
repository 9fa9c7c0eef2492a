"""Gaussian mixtures fitted by EM to features with missing values, the class densities of the terrain model.

Missing features are NaN; the E-step uses their conditional moments given the observed ones (Ghahramani and
Jordan 1994). scikit-learn's GaussianMixture takes no missing values.
"""

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.terrain.classifier import Mixture

MOST_PARTS = 3
ITERATIONS = 60
TOLERANCE = 1e-5
WINDOWS_PER_SAMPLE = 4
"""Overlapping, correlated windows that count as one independent sample."""


def fit_best(x: Array, sigma_floor: Array, order_by: int) -> Mixture:
    """The mixture of 1 to `MOST_PARTS` Gaussians with the least BIC (Schwarz 1978) for features (n, d).

    Args:
        x: (n, d), NaN where not observed.
        sigma_floor: (d,) standard deviation added in quadrature to every Gaussian.
        order_by: feature whose quantiles initialise the Gaussians (deterministic).
    """
    best: tuple[float, Mixture] | None = None
    d = x.shape[1]
    samples = len(x) / WINDOWS_PER_SAMPLE
    for parts in range(1, MOST_PARTS + 1):
        if samples < (4 * d if parts == 1 else 10 * parts * d):
            break
        mixture, log_likelihood = fit(x, parts, sigma_floor, order_by)
        free = parts * (d + d * (d + 1) / 2) + parts - 1
        bic = free * np.log(samples) - 2.0 * log_likelihood / WINDOWS_PER_SAMPLE
        if best is None or bic < best[0]:
            best = (bic, mixture)
    if best is None:
        least = 4 * d * WINDOWS_PER_SAMPLE
        raise ValueError(f"{len(x)} windows are too few to fit {d} features, {least} are needed")
    return best[1]


def fit(x: Array, parts: int, sigma_floor: Array, order_by: int) -> tuple[Mixture, float]:
    """EM for `parts` Gaussians; the mixture, its covariances shrunk, and the total log-likelihood."""
    weight, mean, covariance = _start(x, parts, order_by)
    covariance = covariance + np.diag(sigma_floor**2)
    patterns = _patterns(x)
    before = -np.inf
    for _ in range(ITERATIONS):
        weight, mean, covariance, log_likelihood = _step(patterns, weight, mean, covariance)
        covariance = covariance + np.diag(sigma_floor**2)
        if log_likelihood - before < TOLERANCE * abs(log_likelihood):
            break
        before = log_likelihood
    counts = weight * len(x) / WINDOWS_PER_SAMPLE
    shrunk = np.stack([shrink(c, n) for c, n in zip(covariance, counts, strict=True)])
    return Mixture(np.log(weight), mean, shrunk), log_likelihood


def shrink(covariance: Array, samples: float) -> Array:
    """A covariance (d, d) shrunk towards its diagonal by its number of samples.

    Oracle approximating shrinkage (Chen, Wiesel, Eldar and Hero 2010, eq. 23)
    of the correlation matrix towards the identity.
    """
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    d = len(scale)
    square, trace2 = float((correlation * correlation).sum()), float(d * d)
    above = (1.0 - 2.0 / d) * square + trace2
    below = (samples + 1.0 - 2.0 / d) * (square - trace2 / d)
    share = 1.0 if below <= 0.0 else min(1.0, above / below)
    return np.asarray(((1.0 - share) * correlation + share * np.eye(d)) * np.outer(scale, scale))


def _start(x: Array, parts: int, order_by: int) -> tuple[Array, Array, Array]:
    seen, middle = np.isfinite(x).any(axis=0), np.zeros(x.shape[1])
    middle[seen] = np.nanmedian(x[:, seen], axis=0)
    key = np.where(np.isfinite(x[:, order_by]), x[:, order_by], middle[order_by])
    groups = np.array_split(np.argsort(key, kind="stable"), parts)
    filled = np.where(np.isfinite(x), x, middle)
    spread = np.diag(filled.var(axis=0))
    mean = np.stack([filled[rows].mean(axis=0) for rows in groups])
    return np.full(parts, 1.0 / parts), mean, np.repeat(spread[None], parts, axis=0)


def _patterns(x: Array) -> list[tuple[Array, NDArray[np.intp], NDArray[np.intp]]]:
    """Rows by missing pattern: (rows of observed values, observed columns, missing columns)."""
    codes, inverse = np.unique(np.isfinite(x), axis=0, return_inverse=True)
    groups = []
    for i, seen in enumerate(codes):
        if seen.any():
            rows = x[inverse.ravel() == i]
            groups.append((rows[:, seen], np.flatnonzero(seen), np.flatnonzero(~seen)))
    return groups


def _step(
    patterns: list[tuple[Array, NDArray[np.intp], NDArray[np.intp]]],
    weight: Array,
    mean: Array,
    covariance: Array,
) -> tuple[Array, Array, Array, float]:
    """One E and M step, and the log-likelihood of the given parameters."""
    parts, d = mean.shape
    mass, first = np.full(parts, 1e-9), np.zeros((parts, d))
    second = np.zeros((parts, d, d))
    total = 0.0
    for rows, seen, missing in patterns:
        log_p = np.stack(
            [_log_density(rows, mean[c, seen], covariance[c][np.ix_(seen, seen)]) for c in range(parts)]
        )
        log_p += np.log(weight)[:, None]
        top = log_p.max(axis=0)
        evidence = top + np.log(np.exp(log_p - top).sum(axis=0))
        total += float(evidence.sum())
        share = np.exp(log_p - evidence)
        for c in range(parts):
            gain = np.linalg.solve(covariance[c][np.ix_(seen, seen)], covariance[c][np.ix_(seen, missing)])
            filled = np.empty((len(rows), d))
            filled[:, seen] = rows
            filled[:, missing] = mean[c, missing] + (rows - mean[c, seen]) @ gain
            left = covariance[c][np.ix_(missing, missing)] - covariance[c][np.ix_(missing, seen)] @ gain
            mass[c] += share[c].sum()
            first[c] += share[c] @ filled
            second[c] += (share[c][:, None] * filled).T @ filled
            second[c][np.ix_(missing, missing)] += share[c].sum() * left
    new_mean = first / mass[:, None]
    new_covariance = second / mass[:, None, None] - new_mean[:, :, None] * new_mean[:, None, :]
    return mass / mass.sum(), new_mean, 0.5 * (new_covariance + np.swapaxes(new_covariance, 1, 2)), total


def _log_density(rows: Array, mean: Array, covariance: Array) -> Array:
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, (rows - mean).T)
    constant = np.log(np.diag(root)).sum() + 0.5 * len(mean) * np.log(2.0 * np.pi)
    return np.asarray(-constant - 0.5 * (whitened * whitened).sum(axis=0))
