"""Sets the twin to the robot that the reference runs show.

How all laws act depends on the ground and on how stiffly the motors follow, which owners hardly know. Effects
are changes of a twin that drives as the references do: such numbers are fitted to them by damped Gauss-Newton
steps (Marquardt 1963), from the best of a few starts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.coordinates import Coordinate
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.predict import plant_of
from terrafusion.twin.calibrate.start import coordinates_of
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.rollout.batch import INTEGRATOR_ORDER
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    RunResiduals,
    WhitenedRun,
    run_residuals,
    soil_columns,
    whitened,
    whitened_error,
)
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise

RUNS = 3  # references that are used
NUMBERS = (
    "effects.soil_strength/shear", "effects.soil_strength/bearing", "soil.shear.shear_modulus_m",
    "soil.resistance.rolling", "vehicle.drive.speed_loop_p_nms", "vehicle.drive.speed_loop_i_nm",
)  # fmt: skip
"""What is fitted: strength of the ground, and how soft and how sticky it is; gains of the speed loop."""
STARTS = {"shear_modulus_m": -3.0, "speed_loop_p_nms": 2.7, "speed_loop_i_nm": -6.0}
"""Where the search may begin instead, in scales: ground without give, motors that follow stiffly, and ones
without an integral. From too soft a loop it would end in a minimum with too large an integral."""
SIGMA = 2.0  # 1 sigma of a number, in scales of `Coordinate` (assumed)
EFFECT_SIGMA = 0.1
"""1 sigma of effects beside, in typical sizes (assumed): the numbers explain what they can."""
DIFFERENCE, LONGEST = 0.25, 1.5  # step of the differences, and the longest one of the search, in scales
STEPS, TRIES, ENOUGH = 6, 4, 0.01
"""Most steps of the search, tries of each, and the gain, as a share, below which one is the last."""
MOST_STEPS = 4
"""Integration steps a sample beyond which harder ground and stiffer motors than the given twin's are not
tried: logs hardly tell them from softer ones, and all rollouts would take longer."""
DAMPING, LESS, MORE = 1.0, 1.0 / 6.0, 8.0
"""First damping, as a share of the information, and its factors after a step that is better, or is not."""


def all_residuals(
    logs: Sequence[PreparedLog],
    cache: LinearisationCache,
    channels: Sequence[str],
    jobs: int,
    done: Callable[[], None] = lambda: None,
) -> list[RunResiduals]:
    """Errors and derivatives of each run. The first run of each drive makes its linearisation, whichever
    thread is faster."""

    def one(log: PreparedLog) -> RunResiduals:
        found = run_residuals(log, cache, channels)
        done()
        return found

    first = {cache.key(log): log for log in reversed(logs)}
    in_threads(jobs, cache.of, reversed(first.values()))
    return in_threads(jobs, one, logs)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The fit of numbers w (K,), in scales, to runs about the given model."""

    cache: LinearisationCache
    noise: ChannelNoise
    numbers: Sequence[Coordinate]
    runs: Sequence[WhitenedRun]
    jobs: int

    def model(self, w: Array) -> Model:
        return self.cache.model.replaced(
            {c.name: c.value(float(x)) for c, x in zip(self.numbers, w, strict=True)}
        )

    def steps(self, model: Model) -> int:
        """Integration steps a sample that a twin needs."""
        return stable_steps(DT_S, plant_of(self.runs[0].log, model), INTEGRATOR_ORDER)

    def errors(self, points: Sequence[Array]) -> list[list[Array] | None]:
        """Whitened errors (n,) of the runs at each of some points; None where the twin diverges or needs too
        many steps."""
        models, count = [self.model(w) for w in points], len(self.runs)
        most = max(MOST_STEPS, self.steps(self.cache.model))
        soft = [self.steps(model) <= most for model in models]
        tried = [Rollout(r.log, {}, model=m) for m in itertools.compress(models, soft) for r in self.runs]
        found = iter(aligned_predictions(tried, self.cache.model, self.cache.candidates, self.jobs))
        out = list[list[Array] | None]()
        for near in soft:
            own = list(itertools.islice(found, count if near else 0))
            pairs = zip(self.runs[: len(own)], own, strict=True)
            known = [
                whitened_error(r, self.noise, r.residuals.errors_of(y)) for r, y in pairs if y is not None
            ]
            out.append(known if len(known) == count else None)
        return out

    def inner(self, columns: Sequence[Array]) -> Array:
        """Inner products of columns (n, M) of each run, sensor states and effects projected out."""
        soil, total = len(soil_columns(self.cache.candidates)), np.zeros((columns[0].shape[1],) * 2)
        for run, own in zip(self.runs, columns, strict=True):
            J = run.rows[:, soil:-1].astype(float)
            J[:, run.states - soil :] *= EFFECT_SIGMA
            cross = J.T @ own
            total += own.T @ own - cross.T @ np.linalg.solve(J.T @ J + np.eye(J.shape[1]), cross)
        return total

    def cost(self, w: Array, errors: Sequence[Array] | None) -> float:
        if errors is None:
            return np.inf
        return float(self.inner([e[:, None] for e in errors])[0, 0] + np.square(w / SIGMA).sum())

    def solve(self) -> Array:
        """The numbers that fit best."""
        w, errors, cost = self._start()
        damping = DAMPING
        for _ in range(STEPS):
            if errors is None:
                break
            H, gradient = self._normal(w, errors)
            for _ in range(TRIES):
                step = np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
                tried = w + np.clip(step, -LONGEST, LONGEST)
                (after,) = self.errors([tried])
                now = self.cost(tried, after)
                if now < cost:
                    break
                damping *= MORE
            else:
                break
            gain, damping = 1.0 - now / cost, damping * LESS
            w, errors, cost = tried, after, now
            if gain < ENOUGH:
                break
        return w

    def _start(self) -> tuple[Array, list[Array] | None, float]:
        """The best of the starts, with its errors and cost."""
        others = [STARTS.get(c.name.rpartition(".")[2]) for c in self.numbers]
        points = [np.array(p) for p in itertools.product(*((0.0, x) if x else (0.0,) for x in others))]
        errors = self.errors(points)
        costs = [self.cost(w, e) for w, e in zip(points, errors, strict=True)]
        best = int(np.argmin(costs))
        return points[best], errors[best], costs[best]

    def _normal(self, w: Array, errors: Sequence[Array]) -> tuple[Array, Array]:
        """Information (K, K) on the numbers and gradient (K,) of the fit; none where the twin diverges."""
        moved = self.errors([w + d for d in DIFFERENCE * np.eye(len(w))])
        columns = [
            np.column_stack([*((e - (m[i] if m else e)) / DIFFERENCE for m in moved), e])
            for i, e in enumerate(errors)
        ]
        G, prior = self.inner(columns), np.eye(len(w)) / SIGMA**2
        return G[:-1, :-1] + prior, G[:-1, -1] - w / SIGMA**2


def set_to_references(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """The twin of the cache with the numbers that fit the references; those that are zero stay so."""
    runs = all_residuals(logs[:RUNS], cache, channels, jobs)
    noise = learn_noise(runs, [], cache.candidates, jobs)
    keys = {f"effects.{key}" for key in cache.candidates.keys}
    names = [name for name in NUMBERS if name in keys or not name.startswith("effects.")]
    numbers = [c for c in coordinates_of(names, cache.model, {}) if c.logarithmic or c.name in keys]
    fit = _Fit(cache, noise, numbers, [whitened(run.without_nuisance(), noise) for run in runs], jobs)
    return fit.model(fit.solve())
