"""Properties of the patch filter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from terrafusion.fusion.terrain.sequence import FLOOR, PatchFilter

EVIDENCE = st.lists(
    st.one_of(st.floats(-1e4, 1e4), st.sampled_from([-np.inf, np.inf, np.nan])), min_size=5, max_size=5
)
DISTANCE = st.one_of(st.floats(0.0, 1e6), st.sampled_from([-1.0, np.inf, np.nan]))


@given(st.lists(st.tuples(DISTANCE, EVIDENCE), max_size=20))
def test_stays_a_probability_whatever_comes(steps: list[tuple[float, list[float]]]) -> None:
    patch = PatchFilter(5, 25.0)
    for distance, evidence in steps:
        patch.predict(distance)
        p = patch.update(evidence)
        assert np.isfinite(p).all()
        assert (p >= FLOOR * (1 - 1e-12)).all()
        assert p.sum() == pytest.approx(1.0, abs=1e-12)


def test_leaves_a_class_it_was_sure_of() -> None:
    patch = PatchFilter(5, 1e9)
    for _ in range(1000):
        patch.update([0.0, -50.0, -50.0, -50.0, -50.0])
    assert patch.probabilities[0] > 0.999
    for _ in range(4):
        patch.update([-5.0, 0.0, -5.0, -5.0, -5.0])
    assert patch.probabilities.argmax() == 1


@given(st.floats(0.0, 200.0), st.floats(0.0, 200.0))
def test_prediction_is_that_of_the_markov_chain(first_m: float, second_m: float) -> None:
    length, k = 25.0, 4
    patch = PatchFilter(k, length)
    start = np.array([0.7, 0.2, 0.06, 0.04])
    patch.probabilities = start.copy()
    generator = (np.ones((k, k)) / (k - 1) - np.eye(k) * k / (k - 1)) / length
    assert np.diag(generator) == pytest.approx(-1.0 / length)
    expected = start @ expm(generator * first_m)
    assert patch.predict(first_m) == pytest.approx(expected, abs=k * FLOOR)
    before = patch.probabilities.copy()
    assert patch.predict(0.0) == pytest.approx(before, abs=k * FLOOR)
    # Two stretches are one of their length together; without looking, certainty can only be lost.
    assert patch.predict(second_m) == pytest.approx(
        start @ expm(generator * (first_m + second_m)), abs=2 * k * FLOOR
    )
    assert patch.probabilities.max() <= before.max() + k * FLOOR


@given(st.floats(0.0, 500.0))
def test_an_unequal_prior_is_where_it_rests(distance_m: float) -> None:
    prior = np.array([0.9, 0.06, 0.04])
    patch = PatchFilter(3, 25.0, prior)
    assert patch.predict(distance_m) == pytest.approx(prior, abs=3 * FLOOR)
    patch.update([-10.0, 0.0, -10.0])
    assert patch.probabilities.argmax() == 1
    assert patch.predict(1e4) == pytest.approx(prior, abs=3 * FLOOR)


def test_no_evidence_changes_nothing() -> None:
    patch = PatchFilter(3, 25.0)
    patch.update([0.0, -1.0, -2.0])
    before = patch.probabilities.copy()
    patch.update([np.nan, 0.0, 0.0])
    patch.update([-np.inf, -np.inf, -np.inf])
    assert np.array_equal(patch.probabilities, before)
    patch.update([-3.0, -3.0, -3.0])
    assert patch.probabilities == pytest.approx(before, abs=3 * FLOOR)
