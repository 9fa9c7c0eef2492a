"""Log checks: inconsistencies of a recording, with the evidence and what to do about them.

Each check is one function from a `CheckContext` to findings; `run.CHECKS` lists them. `run_checks` reports,
`repair` also applies the repairs that the findings offer.
"""

from terrafusion.datasets.checks.finding import CheckContext, Finding
from terrafusion.datasets.checks.outliers import check_magnitude
from terrafusion.datasets.checks.run import CHECKS, repair, run_checks

__all__ = ["CHECKS", "CheckContext", "Finding", "check_magnitude", "repair", "run_checks"]
