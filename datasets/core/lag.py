"""Lag between two signals on different clocks, by cross-correlation, with its interval."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.datasets.core.conventions import true_updates

STEP_S = 0.02
"""Resolution of the search; the peak is refined by a parabola."""
LONGEST_GRID = 1 << 18
LEAST_COMMON_S, LEAST_SAMPLES = 10.0, 20
GAP_PERIODS, GAP_S = 5.0, 0.2
"""Longer intervals between samples are gaps, in which the signal is unknown."""
WIDEST_MEAN_S = 1.0
"""Both signals are averaged over the period of the slower one, but no longer than this."""
PEAK_SHARES, PEAK_LAGS = (0.3, 0.1, 0.03), 10
"""Parabolas are fitted to these upper shares of the peak, at this many lags on each side; the one with the
smallest interval is used: wide against noise, narrow where the signal changes seldom."""
CHOICE = 1.15
"""Factor on the interval because the best of several fits is selected."""
RESAMPLES, LEAST_BLOCKS, MOST_BLOCKS, BLOCK_S = 400, 10, 60, 3.0
SEED = 20_240_607
RESOLUTION_S = 0.001
"""Error of grid and parabola without noise; part of every interval."""


@dataclass(frozen=True)
class Lag:
    """Seconds by which the second signal lags the first, their 95 % interval, and the correlation there."""

    seconds: float
    low_s: float
    high_s: float
    r: float


def lag_between(
    t_a_s: Array, a: Array, t_b_s: Array, b: Array, *, reach_s: float = 2.0, least_r: float = 0.0
) -> Lag | None:
    """Lag of signal `b` behind signal `a`.

    Args:
        t_a_s, a: times (N,) s and values (N,) of the first signal, in any order; NaN is left out.
        t_b_s, b: the same of the second, (M,).
        reach_s: largest lag searched, in either direction; at most a quarter of the common time.
        least_r: correlation below which the result is None, which is quicker.

    Returns:
        Lag, or None where the common time is below 10 s, a signal is constant, or no peak lies inside
        the reach. A positive lag is removed by subtracting it from the times of `b`. Only positive
        correlation counts: signals of opposite sign have no peak.

    Both signals are averaged over the period of the slower one; of held values only the updates count.
    The lag is the vertex of a parabola through Pearson's r over the peak. The
    interval is a bootstrap over blocks of the common time (Carlstein 1986), widened by Student's t
    for the number of blocks.
    """
    first, second = _cleaned(t_a_s, a), _cleaned(t_b_s, b)
    if min(len(first[0]), len(second[0])) < LEAST_SAMPLES:
        return None
    start = max(first[0][0], second[0][0])
    common_s = min(first[0][-1], second[0][-1]) - start
    if not common_s >= LEAST_COMMON_S:
        return None
    step = max(STEP_S, common_s / LONGEST_GRID)
    grid = start + np.arange(0.0, common_s, step)
    width_s = min(max(step, _period(first[0]), _period(second[0])), WIDEST_MEAN_S)
    moments = _moments(_resampled(grid, *first, width_s), _resampled(grid, *second, width_s))
    if moments is None:
        return None
    reach = max(int(min(reach_s, common_s / 4) / step), 2)
    r = _correlation(_at_all_lags(*moments, reach))
    if r.max() < least_r:
        return None
    blocks = int(np.clip(common_s / BLOCK_S, LEAST_BLOCKS, MOST_BLOCKS))
    fits = [_fit(*moments, lags, blocks) for lags in _peaks(r)]
    sharp = [fit for fit in fits if fit is not None]
    if not sharp:
        return None
    vertex, spread, r_peak = min(sharp, key=lambda fit: fit[1])
    lag_s, spread_s = vertex * step, CHOICE * spread * step + RESOLUTION_S
    return Lag(lag_s, lag_s - spread_s, lag_s + spread_s, min(r_peak, 1.0))


def _cleaned(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Known samples in order of time, without repeated times and held values."""
    t_s, values = np.asarray(t_s, dtype=float), np.asarray(values, dtype=float)
    known = np.isfinite(t_s) & np.isfinite(values)
    t_s, index = np.unique(t_s[known], return_index=True)
    values = values[known][index]
    keep = true_updates(values[:, None], held_rows(values[:, None]))
    return t_s[keep], values[keep]


def held_rows(values: Array) -> int:
    """Rows for which `values` (N, k) hold each update; 1 where they are not held.

    Runs of equal rows have similar lengths where a slower sensor is held, any length where a slow
    signal is quantised.
    """
    if len(values) < LEAST_SAMPLES:
        return 1
    starts = np.flatnonzero(true_updates(values, len(values)))
    runs = np.diff(starts)
    if len(runs) < 5:
        return 1
    median = float(np.median(runs))
    typical = np.abs(runs - median) <= max(1.0, 0.25 * median)
    if median < 2.0 or typical.mean() < 0.7:
        return 1
    return int(runs[typical].max())


def _period(t_s: Array) -> float:
    return float(np.median(np.diff(t_s)))


def _resampled(grid: Array, t_s: Array, values: Array, width_s: float) -> Array:
    """Means over `width_s` around the times of the grid; NaN inside gaps."""
    dt = np.diff(t_s)
    values = values - values.mean()
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * dt)])
    low, high = (np.clip(grid + side * width_s / 2, t_s[0], t_s[-1]) for side in (-1, 1))
    means = _integral(high, t_s, values, area) - _integral(low, t_s, values, area)
    means /= np.maximum(high - low, 1e-12)
    gap = dt > max(GAP_PERIODS * _period(t_s), GAP_S)
    inside = np.clip(np.searchsorted(t_s, grid, side="right") - 1, 0, len(dt) - 1)
    return np.where(gap[inside], np.nan, means)


def _integral(at: Array, t_s: Array, values: Array, area: Array) -> Array:
    """Integral of the piecewise linear signal from its first sample to the times `at`."""
    i = np.clip(np.searchsorted(t_s, at, side="right") - 1, 0, len(t_s) - 2)
    since = at - t_s[i]
    slope = (values[i + 1] - values[i]) / (t_s[i + 1] - t_s[i])
    return area[i] + since * (values[i] + 0.5 * slope * since)


def _moments(a: Array, b: Array) -> tuple[Array, Array] | None:
    """Powers 0, 1, 2 of each signal on the grid, (3, N), zero where unknown; None where it is constant."""
    powers = []
    for values in (a, b):
        known = np.isfinite(values)
        if known.sum() < LEAST_SAMPLES:
            return None
        values = np.where(known, values - values[known].mean(), 0.0)
        size = float(np.abs(values).max())
        if not size > 0.0 or not np.isfinite(size):
            return None
        values = values / size
        powers.append(np.stack([known.astype(float), values, values**2]))
    return powers[0], powers[1]


PAIRS = ((0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1))
"""Powers of a and of b whose products give Pearson's r."""


def _at_all_lags(a: Array, b: Array, reach: int) -> Array:
    """Sums of the products of `PAIRS` for the lags -reach .. reach, (6, 2 reach + 1)."""
    from scipy import fft

    size = fft.next_fast_len(a.shape[1] + reach, real=True)
    A, B = fft.rfft(a, size), fft.rfft(b, size)
    sums = [fft.irfft(np.conj(A[i]) * B[j], size) for i, j in PAIRS]
    return np.stack([np.concatenate([s[-reach:], s[: reach + 1]]) for s in sums])


def _in_blocks(a: Array, b: Array, lags: NDArray[np.int64], blocks: int) -> Array:
    """Sums of the products of `PAIRS` over blocks of the time of `a`, (6, blocks, len(lags))."""
    length = -(-a.shape[1] // blocks)
    margin, tail = int(np.abs(lags).max(initial=0)), blocks * length - a.shape[1]
    a = np.pad(a, ((0, 0), (0, tail))).reshape(3, blocks, length).swapaxes(0, 1)
    b = np.pad(b, ((0, 0), (margin, margin + tail)))
    parts = np.empty((len(PAIRS), blocks, len(lags)))
    for k, lag in enumerate(lags):
        shifted = b[:, margin + lag : margin + lag + blocks * length].reshape(3, blocks, length)
        products = a @ shifted.transpose(1, 2, 0)
        for p, (i, j) in enumerate(PAIRS):
            parts[p, :, k] = products[:, i, j]
    return parts


def _correlation(sums: Array) -> Array:
    """Pearson's r from sums of the products of `PAIRS` along the first axis."""
    n, a, aa, b, bb, ab = sums
    n = np.maximum(n, 1.0)
    spread = np.maximum(aa - a * a / n, 0.0) * np.maximum(bb - b * b / n, 0.0)
    return np.asarray((ab - a * b / n) / np.sqrt(np.maximum(spread, 1e-300)))


def _peaks(r: Array) -> list[NDArray[np.int64]]:
    """Ranges of lags around the highest r to fit, widest first; none at the edge or where r is flat."""
    centre, reach = int(np.argmax(r)), len(r) // 2
    room = min(centre, len(r) - 1 - centre)
    if not r[centre] > 0.0 or room < 2:
        return []
    found = []
    for share in PEAK_SHARES:
        below = np.flatnonzero(r < r[centre] - share * (r[centre] - r.min()))
        half = max(int(np.abs(below - centre).min(initial=room)), 2)
        lags = np.unique(np.rint(np.linspace(-half, half, 2 * PEAK_LAGS + 1)).astype(np.int64))
        found.append(lags + centre - reach)
    return found


def _fit(a: Array, b: Array, lags: NDArray[np.int64], blocks: int) -> tuple[float, float, float] | None:
    """Vertex and half of its interval, in steps, and the highest r; None where the blocks have no peak."""
    parts = _in_blocks(a, b, lags, blocks)
    r = _correlation(parts.sum(axis=1))
    vertex, spread = float(_vertex(lags, r)), _spread(lags, parts)
    return (vertex, spread, float(r.max())) if spread is not None and np.isfinite(vertex) else None


def _vertex(lags: NDArray[np.int64], r: Array) -> Array:
    """Lags of the vertices of parabolas through r (..., len(lags)); NaN where there is no maximum."""
    middle, half = 0.5 * (lags[0] + lags[-1]), 0.5 * (lags[-1] - lags[0])
    x = (lags - middle) / half
    fit = np.linalg.pinv(np.stack([np.ones(len(x)), x, x * x], axis=1))
    _, c1, c2 = np.moveaxis(r @ fit.T, -1, 0)
    at = -0.5 * c1 / np.where(c2 < 0.0, c2, np.nan)
    return np.asarray(middle + half * np.clip(at, -2.0, 2.0))


def _spread(lags: NDArray[np.int64], parts: Array) -> float | None:
    """Half of the 95 % interval of the vertex, in steps; None where resamples often have no peak."""
    from scipy.special import stdtrit

    blocks = parts.shape[1]
    r = _correlation(np.tensordot(parts, _resampled_blocks(blocks), axes=(1, 1)).swapaxes(1, 2))
    vertex = _vertex(lags, r)
    found = np.isfinite(vertex)
    if found.mean() < 0.95:
        return None
    low, high = percentile_interval(vertex[found])
    return float(0.5 * (high - low) * stdtrit(blocks - 1, 0.975) / 1.96)


@functools.cache
def _resampled_blocks(blocks: int) -> NDArray[np.int64]:
    """How often each block is drawn, (RESAMPLES, blocks)."""
    return np.random.default_rng(SEED).multinomial(blocks, np.full(blocks, 1.0 / blocks), RESAMPLES)
