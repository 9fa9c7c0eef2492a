"""Covariance from the scores' own scatter, for what the noise model leaves out.

Vibration grows with speed, an encoder's error beats with the sampling, a twin that misses some physics is
off for seconds: noise is neither as steady nor as separate between channels as the model of `noise` has it.
So the scores (J' r) are added up over all channels in bins of time, and their long-run variance is measured
with Bartlett's weights (Newey and West 1987): H^-1 (M + prior) H^-1 (Huber 1967; White 1980).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.calibrate.observations import BIN_S
from terrafusion.twin.calibrate.problem import Key, Normal, Problem, ResidualBlock

Array = NDArray[np.float64]

MEMORY_S = 2.0
"""Scores further apart than this are taken as independent."""


def scattered(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: dict[Key, ResidualNoise]
) -> Array:
    """Covariance (G, G) of parameters and sensor errors from the scatter of the scores."""
    inverse = np.linalg.inv(normal.H)
    meat = np.eye(len(inverse))
    for series in _series(problem, blocks, normal, noise).values():
        meat += long_run_variance(series, round(MEMORY_S / BIN_S))
    return np.asarray(inverse @ meat @ inverse)


def _series(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: dict[Key, ResidualNoise]
) -> dict[int, Array]:
    """Scores (bins, G) of each log, poses eliminated, added up over its channels in bins of `BIN_S`."""
    others = len(problem.coordinates) + len(problem.errors)
    out: dict[int, Array] = {}
    for block in blocks:
        log = problem.logs[block.log]
        observed = log.observed[block.channel]
        r, J = problem.whitened(block, noise)
        e = normal.poses[block.log, block.window]
        scores = (J[:, :others] - J[:, others:] @ e.by) * r[:, None]
        bins = np.floor(observed.end_s[block.rows] / BIN_S + 1e-6).astype(np.int64)
        if block.log not in out:
            last = max(float(o.end_s.max()) for o in log.observed)
            out[block.log] = np.zeros((int(last / BIN_S) + 2, len(normal.g)))
        np.add.at(out[block.log], (np.maximum(bins, 0)[:, None], e.at[None, :]), scores)
    return out


def long_run_variance(series: Array, lags: int) -> Array:
    """Variance (G, G) of the sum of a series (n, G) of mean zero, with Bartlett's weights."""
    total = series.T @ series
    for lag in range(1, min(lags + 1, len(series))):
        part = series[lag:].T @ series[:-lag]
        total += (1.0 - lag / (lags + 1.0)) * (part + part.T)
    return np.asarray(total)
