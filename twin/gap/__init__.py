"""The gap between twin and robot: where, which effect, how far it shrinks."""

from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.diagnose import diagnose

__all__ = ["GapDiagnosis", "diagnose"]
