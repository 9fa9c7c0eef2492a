"""Scale and autocorrelation of the residuals of a channel, and whitening by them.

Neighbouring residuals are correlated: a chassis vibrates in a band, GNSS errors drift, unmodelled physics
lasts for seconds. Taken as independent they would make sigma too small. So each channel has a covariance,
that of an autoregressive process fitted to its own residuals (Yule-Walker; order by the corrected Akaike
criterion, Hurvich and Tsai 1989) or, where a data sheet gives the time constant, of white plus first-order
Gauss-Markov noise; rows are whitened by its Cholesky factor before they are squared.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.observations import Observed

Rows = NDArray[np.int64]

MAX_ORDER = 12
"""Highest order of the autoregressive process."""
LEAST_ROWS = 40
"""A channel with fewer rows is taken as white."""
NUGGET = 0.01
"""White share added to every correlation, so that no frequency is free of noise."""
OUTLIER_SIGMAS = 4.0
"""Residuals are clipped at this many robust sigmas before their correlation is estimated."""


@dataclass(frozen=True)
class ResidualNoise:
    """Covariance sigma_i sigma_j scale^2 rho(|slot_i - slot_j|) of a channel's rows.

    Attributes:
        scale: factor on the rows' first guess of sigma.
        rho: autocorrelation at lags 0, 1, ... of the channel's clock; zero beyond.
    """

    scale: float
    rho: tuple[float, ...] = (1.0,)

    def whiten(self, slots: Rows, sigma: Array, columns: Array) -> Array:
        """`columns` (n, k) in units and axes in which the noise is white with variance one."""
        return self.whiten_alike(slots, sigma[None], columns[None])[0]

    def whiten_alike(self, slots: Rows, sigma: Array, columns: Array) -> Array:
        """Several stretches (g, n, k), with sigma (g, n), whose rows are all as far apart as `slots` (n,)."""
        from scipy.linalg.blas import dtrsm  # `solve_triangular` checks longer than it solves

        scaled = columns / (self.scale * sigma)[..., None]
        if len(self.rho) == 1:
            return np.asarray(scaled)
        g, n, k = columns.shape
        lower = _factor(self.rho, tuple((slots[1:] - slots[:-1]).tolist()))
        flat = scaled.transpose(1, 0, 2).reshape(n, g * k)
        solved = dtrsm(1.0, lower, flat.T, side=1, lower=1, trans_a=1).T
        return np.asarray(solved.reshape(n, g, k).transpose(1, 0, 2))

    def unwhiten_alike(self, slots: Rows, sigma: Array, white: Array) -> Array:
        """Inverse of `whiten_alike` for one column: white values (g, n) in the channel's unit."""
        steps = tuple((slots[1:] - slots[:-1]).tolist())
        coloured = white if len(self.rho) == 1 else white @ _factor(self.rho, steps).T
        return np.asarray(coloured * self.scale * sigma)


@functools.lru_cache(maxsize=4096)
def _factor(rho: tuple[float, ...], steps: tuple[int, ...]) -> Array:
    """Cholesky factor of the correlation matrix of rows that are `steps` slots apart."""
    slots = np.cumsum((0, *steps))
    lag = np.abs(slots[:, None] - slots[None, :])
    table = np.append(np.asarray(rho), 0.0)
    correlation = table[np.minimum(lag, len(rho))]
    for extra in (NUGGET, 10.0 * NUGGET, 1.0):
        correlation[np.diag_indices_from(correlation)] += extra
        try:
            return np.asfortranarray(np.linalg.cholesky(correlation))
        except np.linalg.LinAlgError:
            continue
    return np.eye(len(slots))


def gauss_markov(share: float, time_s: float, slot_s: float, lags: int) -> tuple[float, ...]:
    """Autocorrelation at `lags` lags of noise whose variance is Gauss-Markov for `share` of it."""
    return (1.0, *(share * math.exp(-lag * slot_s / time_s) for lag in range(1, lags)))


def sheet_correlation(observed: Observed, lags: int) -> tuple[float, ...] | None:
    """Autocorrelation of a channel by its data sheet's time constant, None without one."""
    if observed.correlation is None:
        return None
    share, time_s = observed.correlation
    return gauss_markov(share, time_s, observed.slot_s, lags)


def autoregressive(series: Sequence[tuple[Rows, Array]], lags: int) -> tuple[float, ...]:
    """Autocorrelation of the autoregressive process that fits the residuals best.

    `series` are slots (n,) and residuals (n,) in units of their sigma, one pair a window.
    """
    total = sum(len(values) for _, values in series)
    order = min(MAX_ORDER, total // 10)
    c = _autocovariance(series, order)
    if total < LEAST_ROWS or not c[0] > 0.0:
        return (1.0,)
    best, chosen, variance = math.inf, np.zeros(0), c[0]
    coefficients = np.zeros(0)
    for p in range(order + 1):
        if p:
            k = (c[p] - coefficients @ c[p - 1 : 0 : -1]) / variance if p > 1 else c[1] / variance
            if not abs(k) < 1.0:
                break
            coefficients = np.append(coefficients - k * coefficients[::-1], k)
            variance *= 1.0 - k * k
        criterion = total * math.log(variance) + 2.0 * (p + 1) * total / max(total - p - 2, 1)
        if criterion < best:
            best, chosen = criterion, coefficients
    return _extended(chosen, c / c[0], lags)


def _autocovariance(series: Sequence[tuple[Rows, Array]], order: int) -> Array:
    """Autocovariance (order + 1,), divided by the number of rows at all lags: positive definite."""
    sums, total = np.zeros(order + 1), 0
    for slots, values in series:
        dense = np.zeros(int(slots[-1] - slots[0]) + 1) if len(slots) else np.zeros(0)
        dense[slots - slots[0] if len(slots) else slots] = values
        total += len(values)
        for lag in range(min(order + 1, len(dense))):
            sums[lag] += float(dense[lag:] @ dense[: len(dense) - lag])
    return sums / max(total, 1)


def _extended(coefficients: Array, rho: Array, lags: int) -> tuple[float, ...]:
    """Autocorrelation of the process at `lags` lags, from its first ones by the Yule-Walker equations."""
    p = len(coefficients)
    if not p:
        return (1.0,)
    out = list(rho[: p + 1])
    while len(out) < lags:
        out.append(float(coefficients @ np.array(out[-1 : -p - 1 : -1])))
    whole = np.array(out[: max(lags, 1)])
    last = int(np.flatnonzero(np.abs(whole) > 1e-4)[-1])
    return tuple(whole[: last + 1].tolist())


def clipped(values: Array) -> Array:
    """Values clipped to `OUTLIER_SIGMAS` robust sigmas about zero."""
    limit = OUTLIER_SIGMAS * 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0
    return np.clip(values, -limit, limit) if limit > 0.0 else values
