"""Noise, averaging, identifiability and coverage, each by itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.quantity import Quantity
from terrafusion.twin.calibrate.coordinates import Coordinate
from terrafusion.twin.calibrate.covariance import long_run_variance
from terrafusion.twin.calibrate.identifiability import COMBINED, IDENTIFIED, NOT_IDENTIFIED, examine
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.noise import ResidualNoise, autoregressive, gauss_markov
from terrafusion.twin.calibrate.observations import Observed, binned
from terrafusion.twin.calibrate.predict import averaging
from tests.studies.coverage import Case, interval, outcomes


def series(rho: float, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = rng.normal(size=count)
    for i in range(1, count):
        out[i] = rho * out[i - 1] + math.sqrt(1.0 - rho**2) * out[i]
    return out


@pytest.mark.parametrize("rho", [-0.6, 0.0, 0.7, 0.9])
def test_correlation_is_learnt_and_whitened(rho: float) -> None:
    windows = [(np.arange(100), series(rho, 100, seed)) for seed in range(30)]
    learnt = autoregressive(windows, 100)
    assert (learnt[1] if len(learnt) > 1 else 0.0) == pytest.approx(rho, abs=0.06)
    noise = ResidualNoise(1.0, learnt)
    white = np.concatenate([noise.whiten(s, np.ones(100), v[:, None])[:, 0] for s, v in windows])
    assert 0.85 < white.var() < 1.08  # the white share that is added makes it a little less than one
    assert abs(np.mean(white[1:] * white[:-1])) < 0.06


def test_stretches_are_whitened_together_as_each_by_itself() -> None:
    rng = np.random.default_rng(4)
    noise, slots = ResidualNoise(0.7, tuple(0.6**k for k in range(30))), np.array([0, 1, 2, 5, 6, 9])
    sigma, columns = rng.uniform(0.5, 2.0, (3, 6)), rng.standard_normal((3, 6, 4))
    together = noise.whiten_alike(slots, sigma, columns)
    for one, s, c in zip(together, sigma, columns, strict=True):
        np.testing.assert_allclose(one, noise.whiten(slots, s, c), rtol=1e-12)


def test_whitening_bridges_missing_rows() -> None:
    """The Cholesky factor of rows with gaps is that of their own covariance."""
    slots, rho = np.array([0, 1, 4, 9]), gauss_markov(0.7, 2.0, 0.5, 10)
    root = ResidualNoise(1.0, rho).whiten(slots, np.ones(4), np.eye(4))
    covariance = np.linalg.inv(root.T @ root)
    table = np.array(rho)
    expected = table[np.abs(slots[:, None] - slots[None, :])]
    assert np.abs(covariance - expected - 0.01 * np.eye(4)).max() < 1e-9


def test_long_run_variance_of_a_correlated_series() -> None:
    """Var(sum) / n of an AR(1) process is (1 + rho) / (1 - rho)."""
    x = series(0.5, 20000, 1)[:, None]
    assert long_run_variance(x, 40)[0, 0] / len(x) == pytest.approx(3.0, rel=0.15)


@given(st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4), st.floats(0.01, 0.6), st.floats(0.03, 0.3))
def test_mean_over_an_interval_is_exact_for_parabolas(c: list[float], begin: float, length: float) -> None:
    windows = np.array([[0, 100]])
    none = np.zeros(0)
    rows = Observed(
        "x",
        np.array([begin]),
        np.array([begin + length]),
        np.zeros(1),
        np.ones(1),
        np.zeros(1, dtype=int),
        0.1,
        1.0,
    )
    log = PreparedLog(
        "x", np.zeros((101, 2)), False, ("a",), none, windows, np.zeros((1, 3)), (rows,), True, ()
    )
    at, weight = averaging(rows, log)
    t = 0.01 * np.arange(101)
    f = c[0] + c[1] * t + c[2] * t**2
    a, b = begin, begin + length
    mean = c[0] + c[1] * (a + b) / 2 + c[2] * (a * a + a * b + b * b) / 3
    assert float((weight * f[at]).sum()) == pytest.approx(mean, abs=1e-6)
    assert float(weight.sum()) == pytest.approx(1.0, abs=1e-12)


def test_bins_are_means_over_what_they_cover() -> None:
    t = np.round(0.01 * np.arange(1, 101), 6)
    rows = binned("x", t, t, 1.0)
    assert len(rows.value) == 10
    assert rows.begin_s[0] == pytest.approx(0.0, abs=1e-9)
    assert rows.end_s[0] == pytest.approx(0.1)
    assert rows.value[0] == pytest.approx(np.mean(t[:10]))


def test_identifiability_in_words() -> None:
    # One number known, two only as a sum, one not at all.
    information = np.zeros((4, 4))
    information[0, 0] = 1e4
    information[1:3, 1:3] = 1e4
    found = examine(("a", "b", "c", "d"), np.linalg.inv(information + np.eye(4)))
    assert found.status == (IDENTIFIED, COMBINED, COMBINED, NOT_IDENTIFIED)
    said = [direction.sentence for direction in found.weak]
    assert any("d is not identified" in s for s in said)
    assert any("b" in s and "c" in s and "only in combination" in s for s in said)
    assert found.ratio[3] == pytest.approx(1.0)


@given(st.floats(0.02, 1.9), st.floats(-3.0, 3.0))
def test_coordinates_keep_the_range(start: float, w: float) -> None:
    c = Coordinate.of("x", Quantity("", 0.01, 2.0), start, None)
    low, high = c.bounds()
    assert 0.01 <= c.value(w) <= 2.0
    if low < w < high:
        assert c.at(c.value(w)) == pytest.approx(w, abs=1e-9)
        step = 1e-6
        assert c.rate(w) == pytest.approx((c.value(w + step) - c.value(w - step)) / (2 * step), rel=1e-4)


def test_binomial_interval() -> None:
    low, high = interval(95, 100)
    assert (round(low, 3), round(high, 3)) == (0.887, 0.984)
    assert interval(0, 10)[0] == 0.0
    assert interval(10, 10)[1] == 1.0


@pytest.mark.parametrize("number", [0, 1, 2])
def test_truth_lies_where_sigma_says(number: int) -> None:
    """A small fixed part of the coverage study (docs/how-to/calibration.md has the whole)."""
    case = dataclasses.replace(Case.drawn(number, seed=77), drive="figure_eight")
    identified = [o for o in outcomes(case) if o.status == IDENTIFIED]
    assert len(identified) >= 4
    assert np.mean([abs(o.score) <= 2.0 for o in identified]) >= 0.6
    assert max(abs(o.score) for o in identified) < 4.0
