"""The p-value of a gap against those of references left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terrafusion.twin.gap.infer.left_out_references import predictive_tail

EVEN = [(i + 0.5) / 12.0 for i in range(12)]


def test_references_as_likely_as_the_test_assumes_leave_a_small_p_value_small() -> None:
    assert 1e-6 < predictive_tail(1e-6, EVEN) < 1e-3


def test_unlikely_references_and_few_of_them_leave_more_doubt() -> None:
    unlikely = [p**2.5 for p in EVEN]
    tails = [predictive_tail(1e-4, some) for some in (EVEN, EVEN[::3], unlikely)]
    assert tails == sorted(tails)
    assert tails[-1] > 0.01


@pytest.mark.parametrize(("inflation", "most"), [(1.0, 0.05), (2.0, 0.08)])
def test_false_alarms_of_robots_that_scatter_as_assumed_and_more(inflation: float, most: float) -> None:
    """Twice as large logarithms alone give 22 % of false alarms at 5 %."""
    rng = np.random.default_rng(3)
    logs = -inflation * rng.exponential(size=(4000, 13))
    found = [predictive_tail(math.exp(own), np.exp(others).tolist()) for own, *others in logs]
    assert np.mean(np.array(found) <= 0.05) < most
