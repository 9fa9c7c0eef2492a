"""Levenberg-Marquardt on the normal equations of the problem, with noise that is learnt between passes.

Each step solves (H + lambda diag H) d = -g (Marquardt 1963) within a trust region of `MAX_STEP` prior sigmas
and the ranges of the parameters; a step that does not lower the cost, or makes the twin diverge, is rejected
and lambda raised.

scipy.optimize.least_squares (trf, one call a pass) gives the same numbers within 0.12 sigma, and needs twice
the runs of the twin, which are all the time: it evaluates anew where only the noise has changed.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.calibrate.noise_learning import (
    extrapolated,
    first_noise,
    learnt_noise,
    raised,
    rescaled,
)
from terrafusion.twin.calibrate.problem import NoiseModel, Normal, Point, Problem, ResidualBlock

MAX_STEP = 1.5
"""Longest step of a parameter, in prior sigmas."""
MAX_RUNS = 80
"""The search ends after this many evaluations of the twin."""
GOALS = (10.0, 1e-3)
"""A pass ends when a step is predicted to lower the cost by less than this (in nats), at first and in the
end: a parameter then moves by less than sqrt(2 x) of its sigma."""
SETTLED = 1.3
"""The scales of the noise are settled when none changes by more than this factor."""
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

Learn = Callable[[Problem, Sequence[ResidualBlock], Normal, NoiseModel], NoiseModel]


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended.

    Attributes:
        point, blocks, normal, noise: there; None, (), None and the first guess where it failed at once.
        outcome: key of `OUTCOMES`.
        runs: evaluations of the twin.
        first: the blocks at the start values.
    """

    point: Point
    blocks: Sequence[ResidualBlock]
    normal: Normal | None
    noise: NoiseModel
    outcome: str
    runs: int
    first: Sequence[ResidualBlock]


@dataclass(frozen=True, eq=False)
class _Linearised:
    """A point with its residuals and normal equations."""

    point: Point
    blocks: list[ResidualBlock]
    normal: Normal


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
        progress: called with the share done, 0 to 1.
    """
    evaluate = _Evaluator(problem, progress)
    free = np.ones(len(problem.coordinates), dtype=bool) if free is None else free
    point = problem.start() if start is None else start.point
    noise = first_noise(problem) if start is None else start.noise
    first = evaluate(point)
    if first is None:
        return Solution(point, (), None, noise, "diverged", evaluate.runs, ())
    here = _Linearised(point, first, problem.normal(point, first, noise))
    outcome = "converged"
    for learn, goal in _passes(start is None):
        if learn is not None:
            new = learn(problem, here.blocks, here.normal, noise)
            settled = all(1.0 / SETTLED < new[k].scale / noise[k].scale < SETTLED for k in new)
            if learn is rescaled and settled:
                continue
            noise = extrapolated(problem, noise, new) if learn is rescaled else new
            here = _renewed(problem, here, noise)
        here, outcome = _descend(evaluate, here, noise, free, goal)
    if start is None:
        noise = rescaled(problem, here.blocks, here.normal, noise)
        here = _renewed(problem, here, noise)
    return Solution(here.point, here.blocks, here.normal, noise, outcome, evaluate.runs, first)


def _renewed(problem: Problem, here: _Linearised, noise: NoiseModel) -> _Linearised:
    return dataclasses.replace(here, normal=problem.normal(here.point, here.blocks, noise))


def _passes(whole: bool) -> list[tuple[Learn | None, float]]:
    """How the noise is learnt before each pass, and the pass's goal.

    First the scales only, until they are settled: while the parameters are off, they correlate the residuals
    of a channel, and a correlation learnt then would hide what is left to be fitted.
    """
    if not whole:
        return [(None, GOALS[1])]
    white: list[tuple[Learn | None, float]] = [(None, GOALS[0]), *[(rescaled, GOALS[0])] * MAX_RESCALES]
    return [(raised, GOALS[0]), *white, *[(learnt_noise, GOALS[1])] * CORRELATED_PASSES]


DIVERGED = 1e30
"""Residuals or derivatives as large as that are of a twin that is not stable."""


class _Evaluator:
    """Residuals at a point; counts the runs of the twin and reports the progress."""

    def __init__(self, problem: Problem, progress: Callable[[float], None] | None) -> None:
        self.problem, self.progress, self.runs = problem, progress, 0
        bounds = np.array([c.bounds() for c in problem.coordinates])
        self.low, self.high = bounds[:, 0], bounds[:, 1]

    def __call__(self, point: Point) -> list[ResidualBlock] | None:
        """None where the twin diverges, or its derivatives do."""
        self.runs += 1
        if self.progress is not None:
            self.progress(min(0.95, 1.0 - math.exp(-self.runs / 6.0)))
        try:
            blocks = self.problem.blocks(point)
        except TerrafusionError:
            return None
        largest = max(float(np.abs(values).max()) for b in blocks for values in (b.residual, b.change))
        return blocks if largest < DIVERGED else None


def _descend(
    evaluate: _Evaluator, here: _Linearised, noise: NoiseModel, free: NDArray[np.bool_], goal: float
) -> tuple[_Linearised, str]:
    """Steps until one is predicted to gain less than `goal`: where that is, and the outcome."""
    problem, damping = evaluate.problem, DAMPING[0]
    while True:
        normal = here.normal
        held = _held(evaluate, here, free)
        gain = _predicted_gain(normal, _step(normal, held, 0.0))
        if gain < goal:
            bound = bool((held[: len(free)] & free).any())
            return here, "at_bound" if bound else "converged"
        if evaluate.runs >= MAX_RUNS:
            return here, "too_long"
        d = _step(normal, held, damping)
        d = d * min(1.0, MAX_STEP / max(float(np.abs(d[: len(free)]).max()), 1e-300))
        point = here.point.moved(*problem.step(normal, d))
        point = dataclasses.replace(point, w=np.clip(point.w, evaluate.low, evaluate.high))
        blocks = evaluate(point)
        new = None if blocks is None else _Linearised(point, blocks, problem.normal(point, blocks, noise))
        if new is not None and new.normal.cost < normal.cost:
            share = (normal.cost - new.normal.cost) / max(_predicted_gain(normal, d), 1e-300)
            if share > 0.75:
                damping = max(damping / 10.0, DAMPING[1])
            elif share < 0.25:
                damping *= 3.0
            here = new
        else:
            damping *= 10.0
            if damping > DAMPING[2]:
                return here, "stalled"


def _held(evaluate: _Evaluator, here: _Linearised, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the unknowns (G,) stay: those not free, or at a bound that the gradient pushes against."""
    w, g = here.point.w, here.normal.g[: len(free)]
    tight = ((w <= evaluate.low + 1e-9) & (g > 0.0)) | ((w >= evaluate.high - 1e-9) & (g < 0.0))
    held = np.zeros(len(here.normal.g), dtype=bool)
    held[: len(free)] = ~free | tight
    return held


def _step(normal: Normal, held: NDArray[np.bool_], damping: float) -> Array:
    """Step (G,) of parameters and sensor errors; zero for those held."""
    d, move = np.zeros(len(normal.g)), ~held
    H = normal.H[np.ix_(move, move)]
    d[move] = np.linalg.solve(H + damping * np.diag(np.diag(H)), -normal.g[move])
    return d


def _predicted_gain(normal: Normal, d: Array) -> float:
    """By how much a step lowers the quadratic model of the cost, the steps of the poses included."""
    by_poses = 0.5 * sum(float(e.gradient @ e.own) for e in normal.poses.values())
    return -float(normal.g @ d) - 0.5 * float(d @ normal.H @ d) + by_poses
