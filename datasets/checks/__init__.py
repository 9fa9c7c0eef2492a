"""The input doctor: what is odd about a recording, with the evidence and what to do about it.

Each check is one function from a context to findings; `run_checks.CHECKS` lists them. A clean log has
no finding. `run_checks` only looks; `repair` makes the repairs that the findings propose.
"""

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.plausibility import check_magnitude
from terrafusion.datasets.checks.run import CHECKS, repair, run_checks

__all__ = ["CHECKS", "CheckContext", "Finding", "check_magnitude", "repair", "run_checks"]
