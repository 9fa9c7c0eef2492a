"""Lags by correlation: recovered, with an interval of nominal coverage, or refused."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.core.lag import held_rows, lag_between

Array = np.ndarray


def winding(seed: int, low_hz: float = 0.05, high_hz: float = 0.5) -> Callable[[Array], Array]:
    """A signal such as a drive's yaw rate: twelve sines of random frequency, phase and size."""
    rng = np.random.default_rng(seed)
    f, phase, size = rng.uniform(low_hz, high_hz, 12), rng.uniform(0, 2 * np.pi, 12), rng.normal(size=12)
    return lambda t: np.sin(2 * np.pi * np.multiply.outer(t, f) + phase) @ size / 3.0


def pair(seed: int, lag_s: float, *, rate_b: float = 20.0, hold: int = 1, noise: float = 0.1,
         seconds: float = 60.0) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """100 Hz and `rate_b` samples of one signal, the second late by `lag_s`, scaled and offset."""
    rng = np.random.default_rng(seed + 1000)
    t_a, t_b = np.arange(0.0, seconds, 0.01), np.arange(rng.uniform(0, 0.05), seconds, 1.0 / rate_b)
    signal = winding(seed)
    a = signal(t_a) + rng.normal(0.0, noise, len(t_a))
    b = signal(t_b - lag_s) + rng.normal(0.0, noise, len(t_b))
    return t_a, a, t_b + 0.0, 3.0 * b[np.arange(len(b)) // hold * hold] + 1.0


@pytest.mark.parametrize("lag_s", [-1.0, -0.32, 0.0, 0.05, 0.5, 1.0])
@pytest.mark.parametrize(
    ("rate_b", "hold", "tolerance_s"),
    [(100.0, 1, 0.006), (20.0, 1, 0.010), (20.0, 4, 0.015), (5.0, 1, 0.015)],
)
def test_known_lags_are_recovered(lag_s: float, rate_b: float, hold: int, tolerance_s: float) -> None:
    for seed in range(3):
        lag = lag_between(*pair(seed, lag_s, rate_b=rate_b, hold=hold))
        assert lag is not None
        assert abs(lag.seconds - lag_s) < tolerance_s
        assert lag.low_s < lag.seconds < lag.high_s
        assert lag.r > 0.95


@pytest.mark.parametrize(
    ("seconds", "noise", "rate_b"),
    [(60.0, 0.5, 20.0), (60.0, 0.1, 20.0), (300.0, 0.5, 100.0), (15.0, 0.3, 20.0)],
)
def test_interval_covers_the_truth(seconds: float, noise: float, rate_b: float) -> None:
    """Measured: 56, 59, 59 and 58 of 60."""
    covered = 0
    for seed in range(60):
        true_s = float(np.random.default_rng(seed).uniform(-1.0, 1.0))
        lag = lag_between(*pair(seed, true_s, seconds=seconds, noise=noise, rate_b=rate_b))
        assert lag is not None
        covered += lag.low_s <= true_s <= lag.high_s
    assert covered >= 54


def test_interval_shrinks_with_the_noise() -> None:
    widths = []
    for noise in (0.5, 0.1):
        lags = [lag_between(*pair(seed, 0.2, noise=noise)) for seed in range(10)]
        widths.append(np.median([lag.high_s - lag.low_s for lag in lags if lag]))
    assert widths[1] < 0.75 * widths[0]


def test_scale_and_offset_do_not_matter() -> None:
    t_a, a, t_b, b = pair(0, 0.3)
    plain, scaled = lag_between(t_a, a, t_b, b), lag_between(t_a, 1e-6 * a + 5.0, t_b, 1e4 * b - 7e3)
    assert plain is not None
    assert scaled is not None
    assert scaled.seconds == pytest.approx(plain.seconds, abs=1e-6)
    assert scaled.low_s == pytest.approx(plain.low_s, abs=1e-6)
    assert scaled.r == pytest.approx(plain.r, abs=1e-6)


def test_swapping_the_signals_changes_the_sign() -> None:
    t_a, a, t_b, b = pair(0, 0.3)
    there, back = lag_between(t_a, a, t_b, b), lag_between(t_b, b, t_a, a)
    assert there is not None
    assert back is not None
    assert back.seconds == pytest.approx(-there.seconds, abs=1e-6)
    assert back.r == pytest.approx(there.r, abs=1e-6)
    assert back.low_s == pytest.approx(-there.high_s, abs=0.01)


def test_unrelated_signals_have_a_low_r() -> None:
    t = np.arange(0.0, 120.0, 0.01)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        lag = lag_between(t, rng.normal(size=len(t)), t, rng.normal(size=len(t)))
        assert lag is None or lag.r < 0.1
        lag = lag_between(t, winding(seed)(t), t, winding(seed + 100)(t))
        assert lag is None or lag.r < 0.7


def test_opposite_signs_correlate_worse() -> None:
    for seed in range(10):
        t_a, a, t_b, b = pair(seed, 0.0)
        lag = lag_between(t_a, a, t_b, -b)
        assert lag is None or lag.r < 0.85


def test_order_repeats_nan_and_gaps_do_not_matter() -> None:
    t_a, a, t_b, b = pair(1, 0.4)
    clean = lag_between(t_a, a, t_b, b)
    mixed = np.random.default_rng(0).permutation(len(t_b))
    spoilt_a = a.copy()
    spoilt_a[::7] = np.nan
    spoilt_a[50] = np.inf
    gap = (t_a < 20.0) | (t_a > 30.0)
    spoilt = lag_between(t_a[gap], spoilt_a[gap], np.repeat(t_b[mixed], 2), np.repeat(b[mixed], 2))
    assert clean is not None
    assert spoilt is not None
    assert abs(spoilt.seconds - 0.4) < 0.01
    assert abs(spoilt.seconds - clean.seconds) < 0.01


def test_unix_times_are_as_good() -> None:
    t_a, a, t_b, b = pair(1, 0.4)
    near, far = lag_between(t_a, a, t_b, b), lag_between(t_a + 1.7e9, a, t_b + 1.7e9, b)
    assert near is not None
    assert far is not None
    assert far.seconds == pytest.approx(near.seconds, abs=1e-3)


def test_undetermined_lags_are_none() -> None:
    t_a, a, t_b, b = pair(0, 0.3)
    empty = np.zeros(0)
    assert lag_between(empty, empty, t_b, b) is None
    assert lag_between(t_a[:1], a[:1], t_b, b) is None
    assert lag_between(t_a[:900], a[:900], t_b, b) is None  # 9 s in common
    assert lag_between(t_a, a, t_b + 100.0, b) is None  # none in common
    assert lag_between(t_a, a, t_b, np.ones(len(t_b))) is None
    assert lag_between(t_a, np.full(len(t_a), np.nan), t_b, b) is None
    assert lag_between(t_a, a, t_b + 5.0, b) is None or lag_between(t_a, a, t_b + 5.0, b).r < 0.9


def test_a_lag_beyond_the_reach_is_found_with_a_longer_reach() -> None:
    t_a, a, t_b, b = pair(0, 0.0)
    lag = lag_between(t_a, a, t_b + 5.0, b, reach_s=10.0)
    assert lag is not None
    assert abs(lag.seconds - 5.0) < 0.01


def test_same_input_same_output() -> None:
    signals = pair(0, 0.3)
    assert lag_between(*signals) == lag_between(*signals)


def test_held_rows_are_counted() -> None:
    t = np.arange(0.0, 60.0, 0.05)
    values = winding(0)(t)[:, None] + np.random.default_rng(0).normal(0.0, 0.01, (len(t), 1))
    quantised = np.round(winding(0)(np.arange(0.0, 60.0, 0.01)) * 8.0)[:, None] / 8.0
    assert held_rows(values) == 1
    assert held_rows(values[np.arange(len(t)) // 4 * 4]) == 4
    assert held_rows(quantised) == 1
    assert held_rows(np.zeros((500, 1))) == 1
    assert held_rows(values[:3]) == 1


def test_ten_minutes_are_quick() -> None:
    signals = pair(0, 0.3, rate_b=100.0, seconds=600.0)
    lag_between(*signals)
    took = []
    for _ in range(3):
        start = time.process_time()
        lag_between(*signals)
        took.append(time.process_time() - start)
    assert min(took) < 0.1  # 0.03 s on an idle core
