"""Sets the twin's soil to that of the reference runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    RunResiduals,
    WhitenedRun,
    initial_state_sigma,
    run_residuals,
    soil_columns,
    whitened,
    whitened_error,
)
from terrafusion.twin.gap.rollout.run_soil import with_run_soil
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions

RUNS, STEPS = 3, 5  # references that are used, and most steps of the search
LEAST_STEP, MOST_STEP = 0.1, 1.0
"""The search ends with a step shorter than the first, and takes none longer than the second (typical
sizes)."""
SHORTER = 0.4  # factor of a step that did not reduce the errors


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

    first = list({cache.key(log): log for log in reversed(logs)}.values())[::-1]
    made = dict[int, RunResiduals]()
    with ThreadPoolExecutor(jobs) as threads:
        for part in (first, [log for log in logs if not any(log is other for other in first)]):
            made.update(zip(map(id, part), threads.map(one, part), strict=True))
    return [made[id(log)] for log in logs]


def set_soil(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """The twin with the soil's strength, bearing and rolling resistance set to the references.

    The other columns take part as nuisances of typical size, so that a calibration error does not pass for
    soil.
    """
    model, candidates = cache.model, cache.candidates
    soil = soil_columns(candidates)
    runs = all_residuals(logs[:RUNS], cache, channels, jobs)
    noise = learn_noise(runs, [], candidates, jobs)
    white = [whitened(run.without_nuisance(), noise) for run in runs]
    errors = [whitened_error(r, w, noise, r.error) for r, w in zip(runs, white, strict=True)]
    at = np.zeros(len(soil))

    def next_step() -> Array:
        return np.clip(_common_step(white, errors, candidates, soil), -MOST_STEP, MOST_STEP)

    step = next_step()
    for _ in range(STEPS):
        if np.abs(step).max(initial=0.0) < LEAST_STEP:
            break
        tried, _ = with_run_soil(at + step, cache, {})
        rollouts = [Rollout(run.log, tried) for run in runs]
        predicted = aligned_predictions(rollouts, model, candidates, jobs)
        now = [
            whitened_error(
                run, w, noise, [o.value - y for o, y in zip(run.log.observed, values, strict=True)]
            )
            for run, w, values in zip(runs, white, predicted, strict=True)
            if values is not None
        ]
        if len(now) == len(runs) and _square(now) < _square(errors):
            at, errors = at + step, now
            step = next_step()
        else:
            step = SHORTER * step
    return dataclasses.replace(model, effects={**model.effects, **with_run_soil(at, cache, {})[0]})


def _square(errors: Sequence[Array]) -> float:
    return sum(float(e @ e) for e in errors)


def _common_step(
    runs: Sequence[WhitenedRun], errors: Sequence[Array], candidates: Candidates, soil: Sequence[int]
) -> Array:
    """Step of the soil that all runs share, in typical sizes, by their whitened errors (n,)."""
    T, K = len(initial_state_sigma(candidates)), len(candidates.keys)
    offsets = np.arange(len(soil), T)  # a run's own; the soil is shared
    effect = np.arange(T, T + K)
    H, g = np.zeros((K, K)), np.zeros(K)
    for run, error in zip(runs, errors, strict=True):
        G, gain = run.gram, run.rows[:, :-1].astype(float).T @ error
        inner = np.linalg.inv(G[np.ix_(offsets, offsets)] + np.eye(len(offsets)))
        cross = G[np.ix_(offsets, effect)]
        H += G[np.ix_(effect, effect)] - cross.T @ inner @ cross
        g += gain[effect] - cross.T @ inner @ gain[offsets]
    prior = np.ones(K)
    prior[list(soil)] = 0.1
    return np.asarray(np.linalg.solve(H + np.diag(prior), g)[list(soil)])
