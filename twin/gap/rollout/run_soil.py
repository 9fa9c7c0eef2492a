"""The soil of each run: residuals linearised about the run's own soil instead of that of the references.

Slip grows steeply as soil gets weaker; to first order, a run on weaker soil would look like a gap. The twin
is simulated on the soil that fits each run, as long as that reduces the errors, and the result is referred
back to the model's soil linearly.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.candidates import RANGE_SHARE, Candidates
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.rollout.batch import SOIL_SIGMAS
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    RunResiduals,
    WhitenedRun,
    soil_columns,
    whitened,
    whitened_error,
)
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise

MOST_SOIL = 4.0  # limit of a soil, in typical sizes from the model's (assumed)
LIMIT_SIGMAS = 3.0
"""A run's soil is also limited to so many sigmas of the references' soils (assumed): what goes beyond is a
gap."""
STEPS, ENOUGH, GOOD = 6, 0.97, 1.2
"""Most steps of the search; it ends when one gains less than 3 %, or the errors are near the noise."""
SHORTER, LEAST_STEP = 0.4, 0.1
"""Factor by which a step that did not reduce the errors is shortened, and the least share of a full step that
is tried. A full step overshoots where slip grows steeply; without shorter ones the run would keep the
references' soil."""
SOIL_SIGMA, EFFECT_SIGMA = 1.0, 0.3
"""1 sigma of a step of the soil and of the effects beside it, in typical sizes (assumed)."""


@dataclass(eq=False)
class SoilSearch:
    """Search for the soil (S,) of a run, in typical sizes from the model's.

    Attributes:
        run: about the model's soil.
        error, white_error: on the soil found so far, before and after whitening.
        share: of a full step.
        going: whether another step is tried.
    """

    run: WhitenedRun
    soil: Array
    error: Sequence[Array]
    white_error: Array
    share: float = 1.0
    going: bool = True

    @classmethod
    def of(cls, run: RunResiduals, noise: ChannelNoise) -> Self:
        """From the model's soil on."""
        white = whitened(run.without_nuisance(), noise)
        return cls(white, run.soil, run.error, white.error)

    def step(self, candidates: Candidates) -> Array:
        """Step (S,) of the soil; effects and sensor states take part as nuisances."""
        S, T, K = len(self.soil), self.run.states, candidates.count
        others = [T + k for k in range(K) if k not in soil_columns(candidates)]
        mine = np.array([*range(T), *others])
        sigma = np.repeat([SOIL_SIGMA, 1.0, EFFECT_SIGMA], [S, T - S, len(others)])
        H = self.run.gram[np.ix_(mine, mine)] + np.diag(sigma**-2.0)
        gain = self.run.rows[:, :-1].astype(float).T @ self.white_error
        return np.asarray(self.share * np.linalg.solve(H, gain[mine])[:S])

    def accept_if_better(self, soil: Array, predicted: Sequence[Array] | None, noise: ChannelNoise) -> None:
        """Goes to a soil where its prediction is better, one array a channel."""
        if predicted is not None:
            error = self.run.residuals.errors_of(predicted)
            white = whitened_error(self.run, noise, error)
            now, before = float(white @ white), float(self.white_error @ self.white_error)
            if now < before:
                self.soil, self.error, self.white_error = soil, error, white
                self.going = ENOUGH * before >= now >= GOOD * len(white)
                return
        self.share *= SHORTER
        self.going = self.share >= LEAST_STEP


def at_run_soil(
    runs: Sequence[RunResiduals],
    cache: LinearisationCache,
    noise: ChannelNoise,
    limit: Array | float = MOST_SOIL,
    jobs: int = 1,
) -> list[RunResiduals]:
    """Runs with errors linearised about their own soil.

    Args:
        limit: of the soil (S,), in typical sizes from the model's.
    """

    def next_soil(search: SoilSearch) -> tuple[dict[str, float], Array]:
        soil = search.soil + search.step(cache.candidates)
        return with_run_soil(np.clip(soil, -limit, limit), cache, {})

    searches = in_threads(jobs, lambda run: SoilSearch.of(run, noise), runs)
    for _ in range(STEPS):
        going = [search for search in searches if search.going]
        tried = in_threads(jobs, next_soil, going)
        rollouts = [Rollout(s.run.log, effects) for s, (effects, _) in zip(going, tried, strict=True)]
        predicted = aligned_predictions(rollouts, cache.model, cache.candidates, jobs)
        soils, same = [soil for _, soil in tried], [noise] * len(going)
        in_threads(jobs, SoilSearch.accept_if_better, going, soils, predicted, same)
    return [
        dataclasses.replace(run, soil=s.soil, error=referred_to_model(run, s.soil, s.error))
        for run, s in zip(runs, searches, strict=True)
    ]


def referred_to_model(run: RunResiduals, soil: Array, errors: Sequence[Array]) -> list[Array]:
    """Errors on the run's soil (S,) as they would be on the model's, to first order."""
    return [e + c[:, 3 : 3 + len(soil)] @ soil for e, c in zip(errors, run.columns, strict=True)]


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
