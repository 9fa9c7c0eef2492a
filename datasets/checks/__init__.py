"""The input doctor: what is odd about a recording, with the evidence and what to do about it.

Each check is one function from a patient to findings; `examine.CHECKS` lists them. A clean log has
no finding. `examine` only looks; `treat` makes the repairs that the findings propose.
"""

from terrafusion.datasets.checks.finding import Finding, Patient
from terrafusion.datasets.checks.plausibility import check_magnitude
from terrafusion.datasets.checks.run import CHECKS, examine, treat

__all__ = ["CHECKS", "Finding", "Patient", "check_magnitude", "examine", "treat"]
