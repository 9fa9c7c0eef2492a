"""Sets the twin's soil to that of the reference runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.rollout.residuals import LinearisationCache, RunResiduals, run_residuals
from terrafusion.twin.gap.rollout.run_soil import SoilSearch, search_soil, with_run_soil

RUNS = 3  # references that are used
TOGETHER = (3.0, 1.0)
"""1 sigma of a step of the soil that they share and of the effects beside it, in typical sizes (assumed)."""


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


def set_soil(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """The twin with the soil's strength, bearing and rolling resistance set to the references.

    Effects of typical size take part as nuisances, so that a calibration error does not pass for soil.
    """
    runs = all_residuals(logs[:RUNS], cache, channels, jobs)
    noise = learn_noise(runs, [], cache.candidates, jobs)
    search, model = SoilSearch.of(runs, noise, TOGETHER), cache.model
    search_soil([search], cache, noise, jobs=jobs)
    return dataclasses.replace(model, effects={**model.effects, **with_run_soil(search.soil, cache, {})[0]})
