"""The p-value of a gap, calibrated by those of references that are judged by the others.

Without a gap -log p is exponential of mean one, if run and twin scatter as the test assumes. On a robot that
scatters otherwise, references left out are unlikely, too: their mean is larger. It is known from a few of
them only, so that the tail is the predictive one of an exponential variable with a gamma prior of its rate
(Lomax 1954). So few references leave more doubt.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.detection import Detection, detect
from terrafusion.twin.gap.infer.other_drives import FEWEST, RobotOffsets, groups
from terrafusion.twin.gap.null.score import Score

PRIOR_REFERENCES = 4.0  # weight of the test's own assumptions, in references (assumed)


def calibrated(
    found: Detection,
    runs: int,
    references: Sequence[Score],
    robot: RobotOffsets,
    candidates: Candidates,
    seed: int,
) -> Detection:
    """The detection in so many runs with a p-value as large as the references demand, which are judged by as
    many together where enough others are left."""
    together = min(runs, max(len(references) - FEWEST, 1))
    judged = zip(groups(len(references), together), robot.left_out(references, together), strict=True)
    others = [detect(references[group], offsets, candidates, seed).p_value for group, offsets in judged]
    return dataclasses.replace(found, p_value=predictive_tail(found.p_value, others))


def predictive_tail(p_value: float, others: Sequence[float]) -> float:
    """Chance of a p-value as small, by those of runs without a gap; no less than the p-value."""
    total = PRIOR_REFERENCES - sum(math.log(p) for p in others)
    tail = (1.0 - math.log(p_value) / total) ** -(PRIOR_REFERENCES + len(others))
    return max(p_value, float(tail))
