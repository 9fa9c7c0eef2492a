"""What a verdict is passed on, and what its rules share."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from terrafusion.datasets.checks import Finding
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.estimate.corrections import Corrections
from terrafusion.fusion.estimate.estimate import Estimate, Innovation
from terrafusion.fusion.metrics.baselines import Baselines
from terrafusion.fusion.metrics.scores import Scores

GOOD, DOUBTFUL, UNUSABLE = "good", "doubtful", "not_to_be_used"
FIVE_SIGMA = 25.0
"""e' P^-1 e of an error of five sigma; for a right covariance its chance is exp(-12.5), 4e-6."""
STRAY_SHARE = 0.01
"""Share of single samples beyond five sigma that is put down to the reference (its jumps, its stamps)."""


@dataclass(frozen=True, eq=False)
class Run:
    """What a verdict is passed on.

    Attributes:
        imu: which of the IMU's axes the estimator uses (`SensorConfig.imu`).
        assumed: names of the robot's numbers that nobody gave.
    """

    recording: Recording
    estimate: Estimate
    scores: Scores
    baselines: Baselines
    used: Gnss | None
    findings: Sequence[Finding]
    rig: Rig
    corrections: Corrections = field(default_factory=Corrections)
    imu: str = "six_axis"
    assumed: frozenset[str] = frozenset()


Reason = tuple[str, str]
"""A value and a sentence."""


def doubtful(sentence: str) -> Reason:
    """A reason to doubt a run."""
    return DOUBTFUL, sentence


def gnss_innovations(run: Run) -> list[Innovation]:
    """The innovations of fixes."""
    return [i for i in run.estimate.innovations if i.sensor == "gnss"]


def since_s(run: Run, t_ns: int) -> float:
    """Seconds from the start of the recording."""
    return (t_ns - run.recording.start_ns) * 1e-9
