"""The gates: what they let in, what they keep out, and when they give in."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.gates import GnssGate, Verdict, WheelGate

GATE = float(chi2.ppf(0.999, 2))


def test_a_consistent_sensor_is_refused_as_often_as_the_gate_says() -> None:
    rng = np.random.default_rng(0)
    P = np.array([[2.0, 0.6], [0.6, 1.0]])
    draws = rng.multivariate_normal(np.zeros(2), P, 20_000)
    gate = GnssGate(GATE, patience=10**9)
    refused = sum(gate.test(d, P)[0] is Verdict.REJECT for d in draws)
    assert 8 <= refused <= 35  # 20 expected; the bounds are beyond its 99.9 % interval


def test_lone_spikes_never_reacquire() -> None:
    gate = GnssGate(GATE)
    rng = np.random.default_rng(1)
    for _ in range(20):
        assert gate.test(rng.normal(0, 500.0, 2), np.eye(2))[0] in (Verdict.REJECT, Verdict.ACCEPT)
    assert gate.test(np.zeros(2), np.eye(2))[0] is Verdict.ACCEPT


def test_fixes_that_agree_are_let_in() -> None:
    gate = GnssGate(GATE)
    verdicts = [gate.test(np.array([40.0, 0.1 * i]), np.eye(2))[0] for i in range(5)]
    assert verdicts == [Verdict.REJECT] * 4 + [Verdict.REACQUIRE]


def test_one_good_fix_clears_the_count() -> None:
    gate = GnssGate(GATE)
    for _ in range(4):
        gate.test(np.array([40.0, 0.0]), np.eye(2))
    gate.test(np.zeros(2), np.eye(2))
    assert gate.test(np.array([40.0, 0.0]), np.eye(2))[0] is Verdict.REJECT


def test_wheels_are_not_locked_out_for_ever() -> None:
    gate = WheelGate(limit_sigma=6.0)
    answers = [gate.test(1.0, 0.01)[0] for _ in range(22)]
    assert answers.count(True) == 2
    assert answers[10]


def test_a_wheel_increment_counts_the_less_the_farther_off_it_is() -> None:
    gate = WheelGate(limit_sigma=6.0)
    assert gate.doubt(36.0) == 1.0  # no step at the limit
    factors = [gate.doubt(off**2) for off in np.linspace(6.0, 17.9, 20)]
    assert (np.diff(factors) > 0.0).all()
    assert gate.doubt(18.0**2) == np.inf
    wheels = WheelIncrement(np.array([0.1, 0.0, 0.0]), np.array([0.01, 0.02, 0.03, 0.04]), 0.1, 0.0)
    variance_m2 = 0.03**2
    less = wheels.doubted(variance_m2, 2.5)
    assert variance_m2 - wheels.sigma[0] ** 2 + less.sigma[0] ** 2 == pytest.approx(2.5 * variance_m2)
    assert less.sigma[3] / wheels.sigma[3] == pytest.approx(less.sigma[0] / wheels.sigma[0])
    assert (less.sigma[1:3] == wheels.sigma[1:3]).all()
    assert np.isinf(wheels.doubted(variance_m2, np.inf).sigma[[0, 3]]).all()
