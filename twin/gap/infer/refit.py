"""Errors of the judged runs against the twin with effects in it, by simulating it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.rollout.residuals import whitened_error
from terrafusion.twin.gap.rollout.run_soil import referred_to_model, with_run_soil
from terrafusion.twin.gap.rollout.sensitivities import Rollout, aligned_predictions


@dataclass(frozen=True, eq=False)
class RunWithEffects:
    """A judged run, by index, with effects in the twin, on the soil (S,), in typical sizes; None: the soil
    that fits it without them."""

    run: int
    effects: Mapping[str, float]
    soil: Array | None = None


def whitened_errors(
    evidence: GapEvidence, tried: Sequence[RunWithEffects], clip: bool = True
) -> list[Array | None]:
    """Whitened errors of the judged runs against the twin with these effects; None where it diverges."""
    soils = [evidence.runs[t.run].residuals.soil if t.soil is None else t.soil for t in tried]
    applied = [with_run_soil(s, evidence.cache, t.effects) for t, s in zip(tried, soils, strict=True)]
    rollouts = [
        Rollout(evidence.runs[t.run].log, effects) for t, (effects, _) in zip(tried, applied, strict=True)
    ]
    predicted = aligned_predictions(rollouts, evidence.model, evidence.candidates, evidence.jobs)

    def whitened(i: int) -> Array | None:
        y, run = predicted[i], evidence.runs[tried[i].run]
        if y is None:
            return None
        error = referred_to_model(run.residuals, applied[i][1], run.residuals.errors_of(y))
        return whitened_error(run, evidence.noise, error, clip)

    return in_threads(evidence.jobs, whitened, range(len(tried)))
