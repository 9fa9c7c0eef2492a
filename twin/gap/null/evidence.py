"""Evidence of a diagnosis: whitened residuals of all runs against one twin, set to the references."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.start import Soils
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.logs import order_of, prepared
from terrafusion.twin.gap.data.samples import driven_by
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.channel_noise import learn_noise
from terrafusion.twin.gap.null.loud_noise import reference_loudness, with_loud_noise
from terrafusion.twin.gap.null.patchiness import PATCHIER, patchier, with_patches
from terrafusion.twin.gap.null.reference_twin import all_residuals, differences, set_as_before
from terrafusion.twin.gap.rollout.batch import is_thread_safe
from terrafusion.twin.gap.rollout.outliers import limit_outliers
from terrafusion.twin.gap.rollout.residuals import (
    LinearisationCache,
    WhitenedRun,
    initial_state_sigma,
    whitened,
)
from terrafusion.twin.gap.rollout.run_soil import at_run_soil, soil_limit
from terrafusion.twin.gap.rollout.sensitivities import Linearisation
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise
from terrafusion.twin.model.vehicle import VehicleParams


@dataclass(frozen=True, eq=False)
class GapEvidence:
    """Everything that a diagnosis compares.

    Attributes:
        model: the twin, set to the references.
        candidates: effects, as changes of that twin's.
        channels: observed channels.
        noise: of each channel.
        runs, references: whitened residuals of each; references in the order of `order_of`.
        reference_names: in the order given.
        soil_limit: (S,) how far a judged run's soil may lie from the model's, typical sizes.
        cache: linearisations, shared by runs with equal commands.
        notes: assumptions, in sentences.
        patchier: how many times as much the ground of the judged runs varies along the path as that of the
            references; None where it does not.
        jobs: threads.
    """

    model: Model
    candidates: Candidates
    channels: tuple[str, ...]
    noise: ChannelNoise
    runs: list[WhitenedRun]
    references: list[WhitenedRun]
    reference_names: tuple[str, ...]
    soil_limit: Array
    cache: LinearisationCache
    notes: tuple[str, ...]
    patchier: float | None = None
    jobs: int = 1


def gather_evidence(
    runs: Sequence[Recording],
    references: Sequence[Recording],
    vehicle: VehicleParams,
    soils: Soils,
    candidates: Candidates,
    *,
    source: str = "auto",
    jobs: int = 2,
    progress: Callable[[float], None] | None = None,
    cache: dict[str, Linearisation] | None = None,
) -> GapEvidence:
    """Evidence of all runs; arguments as those of `diagnose`. One thread where not everything is compiled.

    Raises:
        DataError: a log lacks a channel that is needed.
        TerrafusionError: the twin diverges on every reference.
    """
    names, references = tuple(r.name for r in references), sorted(references, key=order_of)
    logs, model, notes = prepared([*runs, *references], vehicle, soils, source)
    jobs, R = jobs if is_thread_safe(model, candidates) else 1, len(runs)
    channels = tuple(o.channel for o in logs[0].observed)
    known = {} if cache is None else cache
    if references:
        given = model
        model = set_as_before(logs[R:], LinearisationCache(model, candidates, known), channels, jobs)
        logs, notes = [driven_by(log, model.vehicle) for log in logs], [*notes, *differences(given, model)]
    candidates = candidates.beside(model.effects)
    linearised, done = LinearisationCache(model, candidates, known), itertools.count(1)

    def count() -> None:
        if progress is not None:
            progress(0.7 * next(done) / len(logs))

    residuals = all_residuals(logs, linearised, channels, jobs, count, R)
    first = learn_noise(residuals[R:], residuals[:R], candidates, jobs)
    free = at_run_soil(residuals, linearised, first, jobs=jobs)
    limit = soil_limit(free[R:], candidates)
    # The same search for all, or a run that is but a further reference would differ from them.
    beyond = [not (abs(run.soil) <= limit).all() for run in free]
    limited = iter(at_run_soil([*itertools.compress(residuals, beyond)], linearised, first, limit, jobs))
    every = [next(limited) if far else run for run, far in zip(free, beyond, strict=True)]
    noise = learn_noise(every[R:], every[:R], candidates, jobs, first)
    errors = in_threads(jobs, lambda run: whitened(run.errors_alone(), noise), every)
    usual = reference_loudness(errors[R:])
    every = [with_loud_noise(run, own, usual) for run, own in zip(every, errors, strict=True)]
    white = in_threads(jobs, lambda run: whitened(run, noise), every)
    first_sigma = initial_state_sigma(candidates)
    white, patches = with_patches(every, white, len(references), noise, first_sigma, jobs)
    more = patchier(patches, len(references))
    notes += [PATCHIER.format(more)] if more is not None else []
    clipped = limit_outliers(white[:R], white[R:], first_sigma, jobs)
    notes += [f"{log.name}: {note}" for log in logs for note in log.notes]
    return GapEvidence(
        model, candidates, channels, noise, *clipped, names, limit, linearised,
        tuple(dict.fromkeys(notes)), more, jobs,
    )  # fmt: skip
