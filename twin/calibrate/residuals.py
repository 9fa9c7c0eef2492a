"""How each channel fits before and after, from the search's first and last residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.problem import Problem, ResidualBlock
from terrafusion.twin.calibrate.result import ChannelFit
from terrafusion.twin.calibrate.solver import Solution, by_channel

Array = NDArray[np.float64]


def channel_fits(problem: Problem, solution: Solution) -> tuple[ChannelFit, ...]:
    """Every channel of every log; "before" has the numbers at their start, sensor errors and poses fitted."""
    first = _nuisances_fitted(problem, solution)
    fits = []
    before, after = by_channel(first), by_channel(solution.blocks)
    for key, mine in after.items():
        log = problem.logs[key[0]]
        observed = log.observed[key[1]]
        rows = np.concatenate([b.rows for b in mine])
        residual = np.concatenate([b.residual for b in mine])
        old = np.concatenate([b.residual for b in before[key]])
        white = [problem.whitened(b, solution.noise)[0] for b in mine]
        noise, every = solution.noise[key], np.concatenate(white)
        measured = observed.value[rows]
        fits.append(
            ChannelFit(
                log.name, observed.channel, 0.5 * (observed.begin_s + observed.end_s)[rows], measured,
                measured + old, measured + residual, noise.scale * float(np.median(observed.sigma)),
                noise.rho[1] if len(noise.rho) > 1 else 0.0, _neighbours(white),
                float(np.mean(np.abs(every) > 4.0)),
            )
        )  # fmt: skip
    return tuple(fits)


def _neighbours(white: list[Array]) -> float:
    """Autocorrelation of whitened residuals at one row's distance, over all windows."""
    below = sum(float(w @ w) for w in white)
    return sum(float(w[1:] @ w[:-1]) for w in white) / below if below > 0.0 else 0.0


def _nuisances_fitted(problem: Problem, solution: Solution) -> list[ResidualBlock]:
    """The first blocks after one step of sensor errors and poses, which enter all but linearly."""
    point, P = problem.start(), len(problem.coordinates)
    normal = problem.normal(point, solution.first, solution.noise)
    d = np.zeros(len(normal.g))
    d[P:] = np.linalg.solve(normal.H[P:, P:], -normal.g[P:])
    _, derrors, dpose = problem.step(normal, d)
    out = []
    for b in solution.first:
        local = np.concatenate([np.zeros(P), derrors[b.log], dpose[b.log][b.window]])
        out.append(ResidualBlock(b.log, b.channel, b.window, b.rows, b.residual + b.change @ local, b.change))
    return out
