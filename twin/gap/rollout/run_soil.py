"""The soil of each run: residuals linearised about the run's own soil instead of that of the references.

Slip grows steeply as soil gets weaker; to first order, a run on weaker soil would look like a gap. The twin
is simulated on the soil that fits each run, as long as that reduces the errors, and the result is referred
back to the model's soil linearly.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.candidates import RANGE_SHARE, Candidates
from terrafusion.twin.gap.rollout.residuals import (
    SOIL_SIGMAS,
    LinearisationCache,
    RunResiduals,
    WhitenedRun,
    initial_state_sigma,
    whitened,
    whitened_error,
)
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions

MOST_SOIL = 4.0  # limit of a run's soil, in typical sizes from the model's
LIMIT_SIGMAS = 3.0
"""A run's soil is also limited to so many sigmas of the references' soils: what goes beyond is a gap."""
STEPS, ENOUGH, GOOD = 6, 0.97, 1.2
"""Most steps of the search; it ends when one gains less than 3 %, or the errors are near the noise."""
SHORTER, LEAST_STEP = 0.4, 0.1
"""Factor of a step that did not reduce the errors, and the least share of one: a full step goes too far where
slip grows steeply, and a run that stays where it is would seem to be on the references' soil."""
EFFECT_SIGMA = 0.3  # 1 sigma of the effects, in typical sizes, while a run's soil is sought


@dataclass(eq=False)
class _SoilSearch:
    """State of the search for one run's soil (S,): errors there, their square and gradient."""

    run: RunResiduals
    white: WhitenedRun
    soil: Array
    errors: list[Array]
    cost: float
    gradient: Array
    share: float = 1.0  # of a full step
    going: bool = True

    def accept_if_better(
        self, soil: Array, predicted: Sequence[Array] | None, noise: Mapping[str, ResidualNoise]
    ) -> None:
        if predicted is not None:
            error = [o.value - y for o, y in zip(self.run.log.observed, predicted, strict=True)]
            white = whitened_error(self.run, self.white, noise, error)
            now, before = float(white @ white), self.cost
            if now < before:
                self.gradient = self.white.rows[:, :-1].astype(float).T @ white
                self.soil, self.errors, self.cost = soil, error, now
                self.going = ENOUGH * before >= now >= GOOD * len(self.white.time_s)
                return
        self.share *= SHORTER
        self.going = self.share >= LEAST_STEP


def at_run_soil(
    runs: Sequence[RunResiduals],
    cache: LinearisationCache,
    noise: Mapping[str, ResidualNoise],
    limit: Array | float = MOST_SOIL,
    jobs: int = 1,
) -> list[RunResiduals]:
    """Runs with errors linearised about their own soil.

    Args:
        limit: of the soil (S,), in typical sizes from the model's.
    """

    def start(run: RunResiduals) -> _SoilSearch:
        white = whitened(run.without_nuisance(), noise)
        return _SoilSearch(run, white, run.soil, run.error, float(white.gram[-1, -1]), white.gram[:-1, -1])

    def next_soil(search: _SoilSearch) -> tuple[dict[str, float], Array]:
        step = search.share * _soil_step(search.white, search.gradient, cache.candidates, len(search.soil))
        return with_run_soil(np.clip(search.soil + step, -limit, limit), cache, {})

    with ThreadPoolExecutor(jobs) as threads:
        searches = list(threads.map(start, runs))
        for _ in range(STEPS):
            going = [search for search in searches if search.going]
            tried = list(threads.map(next_soil, going))
            rollouts = [Rollout(s.run.log, effects) for s, (effects, _) in zip(going, tried, strict=True)]
            found = aligned_predictions(rollouts, cache.model, cache.candidates, jobs)
            soils, same = [soil for _, soil in tried], [noise] * len(found)
            list(threads.map(_SoilSearch.accept_if_better, going, soils, found, same))
    return [
        dataclasses.replace(s.run, soil=s.soil, error=referred_to_model(s.run, s.soil, s.errors))
        for s in searches
    ]


def referred_to_model(run: RunResiduals, soil: Array, errors: Sequence[Array]) -> list[Array]:
    """Errors on the run's soil (S,) as they would be on the model's, to first order."""
    return [e + s[:, : len(soil)] @ soil for e, s in zip(errors, run.by_state, strict=True)]


def with_run_soil(
    soil: Array, cache: LinearisationCache, effects: Mapping[str, float]
) -> tuple[dict[str, float], Array]:
    """Effects with the run's soil (S,) on top of the model's, or of theirs, within its range; and the soil
    that this leaves."""
    c, out, applied = cache.candidates, dict(effects), soil.copy()
    for k, name in enumerate(name for name in SOIL_SIGMAS if name in c.keys):
        i = c.keys.index(name)
        base = effects.get(name, cache.model.effects.get(name, 0.0))
        low, high = min(RANGE_SHARE * c.low[i], base), max(RANGE_SHARE * c.high[i], base)
        out[name] = float(np.clip(base + soil[k] * c.scale[i], low, high))
        applied[k] = (out[name] - base) / c.scale[i]
    return out, applied


def soil_limit(references: Sequence[RunResiduals], candidates: Candidates) -> Array:
    """How far (S,) the soil of a run may lie from the model's, by the references; the first guess counts as
    one of them."""
    first = np.array([sigma for name, sigma in SOIL_SIGMAS.items() if name in candidates.keys])
    squares = sum((run.soil**2 for run in references), first**2)
    return np.minimum(LIMIT_SIGMAS * np.sqrt(squares / (1 + len(references))), MOST_SOIL)


def _soil_step(white: WhitenedRun, gradient: Array, candidates: Candidates, count: int) -> Array:
    """Step of the soil (S,), in typical sizes, by inner products of columns and error; effects take part as
    nuisances of small size."""
    sigma = initial_state_sigma(candidates)
    prior = np.concatenate([sigma**-2.0, np.full(len(candidates.keys), EFFECT_SIGMA**-2.0)])
    prior[:count] = 1.0
    K = len(prior)
    return np.asarray(np.linalg.solve(white.gram[:K, :K] + np.diag(prior), gradient)[:count])
