"""Noise of every channel estimated from its residuals, between passes of the search.

Iterated generalised least squares: the scale of each channel first, then its correlation in time.
"""

import math
from collections.abc import Sequence

import numpy as np

from terrafusion.twin.calibrate.noise import ResidualNoise, autoregressive, clipped, sheet_correlation
from terrafusion.twin.calibrate.problem import Key, NoiseModel, Normal, Problem, ResidualBlock

MAX_EXTRAPOLATION = 0.2
"""Falling scales are extrapolated by this factor at most."""


def first_noise(problem: Problem) -> NoiseModel:
    """Noise of the data sheets, with their time constants where they give any."""
    return {
        (i, j): ResidualNoise(1.0, sheet_correlation(o, _lags(problem, i, j)) or (1.0,))
        for i, log in enumerate(problem.logs)
        for j, o in enumerate(log.observed)
    }


def learnt_noise(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, _: NoiseModel
) -> NoiseModel:
    """Scale and autocorrelation of every channel as its residuals show them."""
    learnt: NoiseModel = {}
    for (i, j), mine in by_channel(blocks).items():
        observed = problem.logs[i].observed[j]
        lags = _lags(problem, i, j)
        rho = sheet_correlation(observed, lags)
        if rho is None:
            series = [(observed.slot[b.rows], clipped(b.residual / observed.sigma[b.rows])) for b in mine]
            rho = autoregressive(series, lags)
        learnt[i, j] = ResidualNoise(1.0, rho)
    return rescaled(problem, blocks, normal, learnt)


def rescaled(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: NoiseModel
) -> NoiseModel:
    """The noise, scaled so that whitened residuals have variance one at their degrees of freedom."""
    out, used = {}, _degrees_used(problem, blocks, normal, noise)
    for key, mine in by_channel(blocks).items():
        whitened = np.concatenate([problem.whitened(b, noise)[0] for b in mine])
        freedom = max(len(whitened) - used[key], 0.5 * len(whitened), 1.0)
        scale = noise[key].scale * math.sqrt(float(whitened @ whitened) / freedom)
        out[key] = ResidualNoise(max(scale, _least(problem, key)), noise[key].rho)
    return out


def raised(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: NoiseModel
) -> NoiseModel:
    """The noise with scales raised to the residuals at the start values, and none lowered."""
    new = rescaled(problem, blocks, normal, noise)
    return {k: ResidualNoise(max(n.scale, noise[k].scale), n.rho) for k, n in new.items()}


def extrapolated(problem: Problem, noise: NoiseModel, new: NoiseModel) -> NoiseModel:
    """`new` with falling scales lowered by the same factor again: parameters still converge."""
    out = {}
    for k, n in new.items():
        factor = min(1.0, max(n.scale / noise[k].scale, MAX_EXTRAPOLATION))
        out[k] = ResidualNoise(max(n.scale * factor, _least(problem, k)), n.rho)
    return out


def by_channel(blocks: Sequence[ResidualBlock]) -> dict[Key, list[ResidualBlock]]:
    """Blocks of each log's channels."""
    out: dict[Key, list[ResidualBlock]] = {}
    for block in blocks:
        out.setdefault((block.log, block.channel), []).append(block)
    return out


def _least(problem: Problem, key: Key) -> float:
    return problem.logs[key[0]].observed[key[1]].least


def _lags(problem: Problem, i: int, j: int) -> int:
    """Most lags between two rows of one window."""
    slots, windows = problem.logs[i].observed[j].slot, problem.windows[i][j]
    spans = [int(np.ptp(slots[windows == k])) for k in np.unique(windows)]
    return max(spans, default=0) + 1


def _degrees_used(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: NoiseModel
) -> dict[Key, float]:
    """Degrees of freedom the fit takes from each channel: trace of J (J'J + prior)^-1 J' over its rows."""
    covariance = np.linalg.inv(normal.H)
    out = dict.fromkeys(noise, 0.0)
    for block in blocks:
        _, J = problem.whitened(block, noise)
        pose = normal.poses[block.log, block.window]
        own, reduced = J[:, len(pose.at) :], pose.reduced(J)
        used = float(np.sum((reduced @ covariance[np.ix_(pose.at, pose.at)]) * reduced))
        used += float(np.sum((own @ np.linalg.inv(pose.information)) * own))
        out[block.log, block.channel] += used
    return out
