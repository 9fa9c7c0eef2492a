"""Every experiment whose figures the documents quote: what it asks, how it is run, which figures it gives.

A study is a command. What it prints is its table; figures are read from it by patterns, as they are printed.
"""

from __future__ import annotations

from tests.studies.estimator_studies import ESTIMATOR
from tests.studies.product_studies import PRODUCT
from tests.studies.twin_studies import TWIN

STUDIES = (*PRODUCT, *TWIN, *ESTIMATOR)
"""All of them, quick ones and long ones."""
