"""The gap between twin and robot: where, which effect, how far it shrinks."""

from terrafusion.twin.gap.diagnose import Diagnosis, diagnose

__all__ = ["Diagnosis", "diagnose"]
