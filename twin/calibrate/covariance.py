"""Covariance of the fit, raised where the scores scatter more than the noise model says.

Vibration grows with speed, an encoder's error beats with the sampling, unmodelled physics lasts for seconds:
noise is neither as steady nor as independent between channels as the model of `noise` has it. So the scores
(J' r) are summed over all channels in bins of time, and their long-run variance is measured with Bartlett's
weights (Newey and West 1987): H^-1 (M + prior) H^-1 (Huber 1967; White 1980).
"""

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.observations import BIN_S
from terrafusion.twin.calibrate.problem import Problem
from terrafusion.twin.calibrate.solver import Solution

MEMORY_S = 2.0
"""Scores further apart than this are taken as independent."""


def covariance_of(problem: Problem, solution: Solution) -> Array:
    """Covariance (G, G) of parameters in prior sigmas, then of sensor errors; poses marginalised.

    Sigma is raised from that of the noise model to that of the scores' scatter, and never above the prior's.
    """
    if solution.normal is None:
        return np.eye(len(problem.coordinates) + len(problem.logs) * len(problem.errors))
    modelled = np.linalg.inv(solution.normal.H)
    scores = np.eye(len(modelled))
    for series in _scores(problem, solution).values():
        scores += long_run_variance(series, round(MEMORY_S / BIN_S))
    ratio = np.diag(modelled @ scores @ modelled) / np.diag(modelled)
    raised = np.sqrt(np.clip(ratio, 1.0, np.maximum(1.0 / np.diag(modelled), 1.0)))
    return np.asarray(modelled * np.outer(raised, raised))


def _scores(problem: Problem, solution: Solution) -> dict[int, Array]:
    """Scores (bins, G) of each log, poses eliminated, summed over its channels in bins of `BIN_S`."""
    normal = solution.normal
    assert normal is not None
    out: dict[int, Array] = {}
    for block in solution.blocks:
        log = problem.logs[block.log]
        r, J = problem.whitened(block, solution.noise)
        pose = normal.poses[block.log, block.window]
        scores = pose.reduced(J) * r[:, None]
        bins = np.floor(log.observed[block.channel].end_s[block.rows] / BIN_S + 1e-6).astype(np.int64)
        if block.log not in out:
            last = max(float(o.end_s.max()) for o in log.observed)
            out[block.log] = np.zeros((int(last / BIN_S) + 2, len(normal.g)))
        np.add.at(out[block.log], (np.maximum(bins, 0)[:, None], pose.at[None, :]), scores)
    return out


def long_run_variance(series: Array, lags: int) -> Array:
    """Variance (G, G) of the sum of a zero-mean series (n, G), with Bartlett's weights."""
    total = series.T @ series
    for lag in range(1, min(lags + 1, len(series))):
        part = series[lag:].T @ series[:-lag]
        total += (1.0 - lag / (lags + 1.0)) * (part + part.T)
    return np.asarray(total)
