"""Levenberg-Marquardt on the problem's normal equations, with noise that is learnt on the way.

Each step solves (H + lambda diag H) d = -g (Marquardt 1963) within a trust region of `MAX_STEP` prior sigmas
and the parameters' ranges; a step that does not lower the cost, or makes the twin diverge, is taken back and
lambda raised. From one pass to the next the noise of each channel is estimated from its residuals (iterated
generalised least squares): its scale first, then its correlation in time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.calibrate.noise import ResidualNoise, autoregressive, clipped, gauss_markov
from terrafusion.twin.calibrate.problem import Key, Normal, Point, Problem, ResidualBlock

Array = NDArray[np.float64]

MAX_STEP = 1.5
"""Longest step of a parameter, in prior sigmas."""
MAX_RUNS = 80
"""The search ends after this many evaluations of the twin."""
GOALS = (10.0, 1e-3)
"""A pass ends when a step promises to lower the cost by less than this (in nats), at first and in the end: a
parameter then moves by less than sqrt(2 x) of its sigma."""
SETTLED = 1.3
"""The scales of the noise are settled when none changes by more than this factor."""
MOST_AHEAD = 0.2
"""Scales are taken ahead of what the residuals show by this factor at most."""
MAX_RESCALES, CORRELATED_PASSES = 6, 2
"""Passes with white noise until the scales are settled, at most; passes with correlated noise."""
DAMPING = (1e-3, 1e-8, 1e8)
"""lambda at the start, its least and its greatest value."""

OUTCOMES = {
    "converged": "converged: another step would not lower the cost",
    "at_bound": "converged, with a parameter at the end of its range",
    "stalled": "stopped: no step lowers the cost any more, although the gradient is not zero; the model may "
    "be rough here",
    "too_long": f"stopped after {MAX_RUNS} runs of the twin before it converged: values and sigma are those "
    "of the last step",
    "diverged": "failed: the twin's run diverged at the start values already",
}


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended.

    Attributes:
        point, blocks, normal, noise: there; None, (), None and the first guess where it failed at once.
        outcome: key of `OUTCOMES`.
        runs: evaluations of the twin.
        first: the blocks at the start values.
        history: cost after each accepted step, in nats, by pass.
    """

    point: Point
    blocks: Sequence[ResidualBlock]
    normal: Normal | None
    noise: dict[Key, ResidualNoise]
    outcome: str
    runs: int
    first: Sequence[ResidualBlock]
    history: tuple[tuple[float, ...], ...]


class Search:
    """One search: counts the runs, tells the progress."""

    def __init__(self, problem: Problem, progress: Callable[[float], None] | None) -> None:
        self.problem, self.progress, self.runs = problem, progress, 0
        bounds = np.array([c.bounds() for c in problem.coordinates])
        self.low, self.high = bounds[:, 0], bounds[:, 1]

    def blocks(self, point: Point) -> list[ResidualBlock] | None:
        """Residuals at a point; None where the twin diverges."""
        self.runs += 1
        if self.progress is not None:
            self.progress(min(0.95, 1.0 - math.exp(-self.runs / 6.0)))
        try:
            blocks = self.problem.blocks(point)
        except TerrafusionError:
            return None
        finite = all(np.isfinite(b.residual).all() and np.isfinite(b.change).all() for b in blocks)
        return blocks if finite else None


def solve(
    problem: Problem,
    *,
    free: NDArray[np.bool_] | None = None,
    start: Solution | None = None,
    progress: Callable[[float], None] | None = None,
) -> Solution:
    """Search for the most probable parameters.

    Args:
        free: (P,) which parameters may move; None: all of them.
        start: go on from there, with its noise, in the last pass only.
        progress: told the share done, 0 to 1.
    """
    search = Search(problem, progress)
    free = np.ones(len(problem.coordinates), dtype=bool) if free is None else free
    point = problem.start() if start is None else start.point
    noise = first_noise(problem) if start is None else start.noise
    blocks = search.blocks(point)
    if blocks is None:
        return Solution(point, (), None, noise, "diverged", search.runs, (), ())
    first, history, outcome, normal = blocks, [], "converged", problem.normal(point, blocks, noise)
    for learn, goal in _passes(start is None):
        if learn is not None:
            new = learn(problem, blocks, normal, noise)
            settled = all(1.0 / SETTLED < new[k].scale / noise[k].scale < SETTLED for k in new)
            if learn is rescaled and settled:
                continue
            noise = _ahead(problem, noise, new) if learn is rescaled else new
            normal = problem.normal(point, blocks, noise)
        point, blocks, normal, outcome, costs = _descend(search, point, blocks, normal, noise, free, goal)
        history.append(costs)
    if start is None:
        noise = rescaled(problem, blocks, normal, noise)
        normal = problem.normal(point, blocks, noise)
    return Solution(point, blocks, normal, noise, outcome, search.runs, first, tuple(history))


def raised(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: dict[Key, ResidualNoise]
) -> dict[Key, ResidualNoise]:
    """The first guess, raised to what the residuals are at the start: so far off, none is to be trusted."""
    new = rescaled(problem, blocks, normal, noise)
    return {k: ResidualNoise(max(n.scale, noise[k].scale), n.rho) for k, n in new.items()}


def _ahead(
    problem: Problem, noise: dict[Key, ResidualNoise], new: dict[Key, ResidualNoise]
) -> dict[Key, ResidualNoise]:
    """Scales that fall are taken down as much again: they do so because the numbers are still off."""
    share = {k: min(1.0, max(new[k].scale / noise[k].scale, MOST_AHEAD)) for k in new}
    least = {k: problem.logs[k[0]].observed[k[1]].least for k in new}
    return {k: ResidualNoise(max(n.scale * share[k], least[k]), n.rho) for k, n in new.items()}


Learn = Callable[
    [Problem, Sequence[ResidualBlock], Normal, dict[Key, ResidualNoise]], dict[Key, ResidualNoise]
]


def _passes(whole: bool) -> list[tuple[Learn | None, float]]:
    """How the noise is learnt before each pass, and the pass's goal.

    First the scales only, until they are settled: while the numbers are off, a channel's residuals hang
    together because of them, and a correlation learnt then would hide what is left to be fitted.
    """
    if not whole:
        return [(None, GOALS[1])]
    white: list[tuple[Learn | None, float]] = [(None, GOALS[0]), *[(rescaled, GOALS[0])] * MAX_RESCALES]
    return [(raised, GOALS[0]), *white, *[(learnt_noise, GOALS[1])] * CORRELATED_PASSES]


def _descend(
    search: Search,
    point: Point,
    blocks: list[ResidualBlock],
    normal: Normal,
    noise: dict[Key, ResidualNoise],
    free: NDArray[np.bool_],
    goal: float,
) -> tuple[Point, list[ResidualBlock], Normal, str, tuple[float, ...]]:
    """Steps until one promises less than `goal`: point, blocks, normal equations, outcome and costs."""
    problem, damping, costs = search.problem, DAMPING[0], [normal.cost]
    while True:
        held = _held(search, point, normal, free)
        d = _step(normal, held, damping)
        newton = _step(normal, held, 0.0)
        promised = -float(normal.g @ newton) - 0.5 * float(newton @ normal.H @ newton)
        if promised + normal.pose_gain() < goal:
            bound = bool((held[: len(free)] & free).any())
            return point, blocks, normal, "at_bound" if bound else "converged", tuple(costs)
        if search.runs >= MAX_RUNS:
            return point, blocks, normal, "too_long", tuple(costs)
        d = d * min(1.0, MAX_STEP / max(float(np.abs(d[: len(free)]).max()), 1e-300))
        tried = _moved(search, point, normal, d)
        found = search.blocks(tried)
        new = None if found is None else problem.normal(tried, found, noise)
        if new is not None and found is not None and new.cost < normal.cost:
            foreseen = -float(normal.g @ d) - 0.5 * float(d @ normal.H @ d) + normal.pose_gain()
            share = (normal.cost - new.cost) / max(foreseen, 1e-300)
            damping = (
                max(damping / 10.0, DAMPING[1]) if share > 0.75 else damping * (3.0 if share < 0.25 else 1.0)
            )
            point, blocks, normal = tried, found, new
            costs.append(normal.cost)
        else:
            damping *= 10.0
            if damping > DAMPING[2]:
                return point, blocks, normal, "stalled", tuple(costs)


def _held(search: Search, point: Point, normal: Normal, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the unknowns (G,) stay: those not free, or at a bound that the gradient pushes against."""
    w, g = point.w, normal.g[: len(free)]
    tight = ((w <= search.low + 1e-9) & (g > 0.0)) | ((w >= search.high - 1e-9) & (g < 0.0))
    held = np.zeros(len(normal.g), dtype=bool)
    held[: len(free)] = ~free | tight
    return held


def _step(normal: Normal, held: NDArray[np.bool_], damping: float) -> Array:
    """Step (G,) of parameters and offsets; zero for those held."""
    d, move = np.zeros(len(normal.g)), ~held
    H = normal.H[np.ix_(move, move)]
    d[move] = np.linalg.solve(H + damping * np.diag(np.diag(H)), -normal.g[move])
    return d


def _moved(search: Search, point: Point, normal: Normal, d: Array) -> Point:
    """The point after a step, within the ranges."""
    dw, derrors, dpose = search.problem.step(normal, d)
    new = point.moved(dw, derrors, dpose)
    return Point(np.clip(new.w, search.low, search.high), new.errors, new.pose)


def first_noise(problem: Problem) -> dict[Key, ResidualNoise]:
    """White noise of the data sheets' sigma, with the correlation they tell."""
    return {
        (i, j): ResidualNoise(1.0, _sheet_rho(problem, i, j) or (1.0,))
        for i, log in enumerate(problem.logs)
        for j in range(len(log.observed))
    }


def _sheet_rho(problem: Problem, i: int, j: int) -> tuple[float, ...] | None:
    log = problem.logs[i]
    observed = log.observed[j]
    if observed.correlation is None:
        return None
    share, time_s = observed.correlation
    return gauss_markov(share, time_s, observed.slot_s, _lags(problem, i, j))


def _lags(problem: Problem, i: int, j: int) -> int:
    """Most lags between two rows of one window."""
    slots, windows = problem.logs[i].observed[j].slot, problem.windows[i][j]
    spans = [int(np.ptp(slots[windows == k])) for k in np.unique(windows)]
    return max(spans, default=0) + 1


def learnt_noise(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, _: dict[Key, ResidualNoise]
) -> dict[Key, ResidualNoise]:
    """The noise of every channel as its residuals show it."""
    found: dict[Key, ResidualNoise] = {}
    for key, mine in by_channel(blocks).items():
        observed = problem.logs[key[0]].observed[key[1]]
        rho = _sheet_rho(problem, *key)
        if rho is None:
            series = [(observed.slot[b.rows], clipped(b.residual / observed.sigma[b.rows])) for b in mine]
            rho = autoregressive(series, _lags(problem, *key))
        found[key] = ResidualNoise(1.0, rho)
    return rescaled(problem, blocks, normal, found)


def rescaled(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: dict[Key, ResidualNoise]
) -> dict[Key, ResidualNoise]:
    """The noise, scaled so that whitened residuals have variance one (less what the fit has used up)."""
    out = {}
    used = degrees_used(problem, blocks, normal, noise)
    for key, mine in by_channel(blocks).items():
        whitened = np.concatenate([problem.whitened(b, noise)[0] for b in mine])
        freedom = max(len(whitened) - used[key], 0.5 * len(whitened), 1.0)
        variance = float(whitened @ whitened) / freedom
        scale = max(noise[key].scale * math.sqrt(variance), problem.logs[key[0]].observed[key[1]].least)
        out[key] = ResidualNoise(scale, noise[key].rho)
    return out


def degrees_used(
    problem: Problem, blocks: Sequence[ResidualBlock], normal: Normal, noise: dict[Key, ResidualNoise]
) -> dict[Key, float]:
    """Degrees of freedom the fit takes from each channel: trace of J (J'J + prior)^-1 J' over its rows."""
    covariance = np.linalg.inv(normal.H)
    others = len(problem.coordinates) + len(problem.errors)
    out = dict.fromkeys(noise, 0.0)
    for block in blocks:
        _, J = problem.whitened(block, noise)
        e = normal.poses[block.log, block.window]
        own = J[:, others:]
        reduced = J[:, :others] - own @ e.by
        used = float(np.sum((reduced @ covariance[np.ix_(e.at, e.at)]) * reduced))
        used += float(np.sum((own @ np.linalg.inv(e.information)) * own))
        out[block.log, block.channel] += used
    return out


def by_channel(blocks: Sequence[ResidualBlock]) -> dict[Key, list[ResidualBlock]]:
    """Blocks of each log's channels."""
    out: dict[Key, list[ResidualBlock]] = {}
    for block in blocks:
        out.setdefault((block.log, block.channel), []).append(block)
    return out
