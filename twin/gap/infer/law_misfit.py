"""Model error of the offsets learned from references when they are used on other drives.

The robot's laws differ from the twin's. Offsets that compensate for that on the references' drives are not
quite right on another drive, in proportion to their effect there (after Kennedy and O'Hagan 2001, with a
basis in place of a Gaussian process): what they predict in a channel, and what the laws of the ground, of the
vehicle and of the sensors predict in all of them, times functions of the commands, join the random effects as
columns of their own. References know their coefficients as far as their drives excite them. These and the
offsets themselves change from drive to drive, the more the less the commands of judged runs and references
overlap. Only offsets beyond their uncertainty count: where the twin fits the references, none are wrong.
Columns that act alike share what they explain (`RobotOffsets.modest`): large offsets of opposite sign, which
cancel, are no law that could be wrong by as much.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.effects.terrain import FORMS as GROUND_FORMS
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.infer.close_look import modulation
from terrafusion.twin.gap.infer.other_drives import RobotOffsets, learn_misfit
from terrafusion.twin.gap.null.drives import overlap
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

MISFIT = 0.3  # 1 sigma (assumed): how wrong a law is, as a share of what it does
GROUND = frozenset(form.effect for form in GROUND_FORMS)


def with_law_misfit(
    evidence: GapEvidence, sigma: Array, robot: RobotOffsets
) -> tuple[GapEvidence, RobotOffsets]:
    """Evidence with the columns of the misfit behind those of effects and nuisance, and what the references
    know of all of them.

    Args:
        sigma: (T,) 1 sigma of the states.
        robot: offsets without the misfit.
    """
    plain = [score(run, sigma) for run in evidence.references]
    groups, certain = _groups(evidence.candidates), robot.modest(plain).certain()

    def extended(run: WhitenedRun) -> WhitenedRun:
        return run.with_columns(_columns(run, evidence.model, certain, groups))

    runs, references = (
        in_threads(evidence.jobs, extended, some) for some in (evidence.runs, evidence.references)
    )
    twists = [[commanded_twist(r.log, evidence.model)[1] for r in some] for some in (runs, references)]
    count = runs[0].by_parameter.shape[1] - len(certain)
    changed = 2.0 * MISFIT**2 * (1.0 - overlap(*twists)) * np.append(certain**2, np.ones(count))
    learned = learn_misfit([score(run, sigma) for run in references], robot, MISFIT, changed)
    return dataclasses.replace(evidence, runs=runs, references=references), learned


def _groups(candidates: Candidates) -> list[list[int]]:
    """Columns of the laws of the ground, of the vehicle and of the sensors."""
    kinds = [
        0 if key.split("/")[0] in GROUND else 1 if key in candidates.moving else 2
        for key in candidates.keys[: candidates.count]
    ]
    return [[i for i, own in enumerate(kinds) if own == kind] for kind in range(3)]


def _columns(run: WhitenedRun, model: Model, offset: Array, groups: Sequence[Sequence[int]]) -> Array:
    """(n, D) of a run whose robot has offsets (P,)."""
    columns = run.by_parameter
    predicted, parts = columns @ offset, [columns[:, g] @ offset[g] for g in groups if g]
    names = np.array([CHANNEL_NAMES[o.channel] for o in run.log.observed])
    parts += [predicted * (names[run.channel] == name) for name in dict.fromkeys(names)]
    f = modulation(run, model)  # without a constant, which would be the offset itself
    return np.hstack([part[:, None] * f for part in parts])
