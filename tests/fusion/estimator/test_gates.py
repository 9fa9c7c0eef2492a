"""The gates: what they let in, what they keep out, and when they give in."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from terrafusion.fusion.estimator.gates import GateDecision, GnssGate, WheelGate
from terrafusion.fusion.graph.wheel_factor import WheelIncrement

GATE = float(chi2.ppf(0.999, 2))


def test_a_consistent_sensor_is_refused_as_often_as_the_gate_says() -> None:
    rng = np.random.default_rng(0)
    P = np.array([[2.0, 0.6], [0.6, 1.0]])
    draws = rng.multivariate_normal(np.zeros(2), P, 20_000)
    gate = GnssGate(GATE, patience=10**9)
    refused = sum(gate.test(d, P)[0] is GateDecision.REJECT for d in draws)
    assert 8 <= refused <= 35  # 20 expected; the bounds are beyond its 99.9 % interval


def test_lone_spikes_never_reacquire() -> None:
    gate = GnssGate(GATE)
    rng = np.random.default_rng(1)
    for _ in range(20):
        assert gate.test(rng.normal(0, 500.0, 2), np.eye(2))[0] in (GateDecision.REJECT, GateDecision.ACCEPT)
    assert gate.test(np.zeros(2), np.eye(2))[0] is GateDecision.ACCEPT


def test_fixes_that_agree_are_let_in() -> None:
    gate = GnssGate(GATE)
    verdicts = [gate.test(np.array([40.0, 0.1 * i]), np.eye(2))[0] for i in range(5)]
    assert verdicts == [GateDecision.REJECT] * 4 + [GateDecision.REACQUIRE]


def test_one_good_fix_clears_the_count() -> None:
    gate = GnssGate(GATE)
    for _ in range(4):
        gate.test(np.array([40.0, 0.0]), np.eye(2))
    gate.test(np.zeros(2), np.eye(2))
    assert gate.test(np.array([40.0, 0.0]), np.eye(2))[0] is GateDecision.REJECT


DT_S = 0.1


def increment(speed_mps: float, change_mps: float = 0.0) -> WheelIncrement:
    sigma = np.array([0.01, 0.02, 0.03, 0.04])
    way = speed_mps * DT_S
    return WheelIncrement(np.array([way, 0.0, 0.0]), sigma, way, 0.0, speed_change_mps=change_mps)


def believes(gate: WheelGate, innovation_m: float, sigma_m: float) -> bool:
    """Whether the gate believes an increment of a robot that keeps its speed."""
    return gate.test(innovation_m, sigma_m, increment(1.0), (1.0, 1.0), DT_S)[0]


def test_wheels_are_not_locked_out_for_ever() -> None:
    gate = WheelGate(limit_sigma=6.0)
    answers = [believes(gate, 1.0, 0.01) for _ in range(22)]
    assert answers.count(True) == 2
    assert answers[10]


def test_a_wheel_increment_counts_the_less_the_farther_off_it_is() -> None:
    factors = []
    for off in (6.001, *np.linspace(6.1, 17.9, 20)):
        gate = WheelGate(limit_sigma=6.0)
        assert not believes(gate, 0.01 * off, 0.01)
        factors.append(gate.doubt(off**2))
    assert factors[0] == pytest.approx(1.0, abs=1e-3)  # no step at the limit
    assert (np.diff(factors) > 0.0).all()
    gate = WheelGate(limit_sigma=6.0)
    assert not believes(gate, 0.18, 0.01)
    assert gate.doubt(18.0**2) == np.inf
    wheels = increment(1.0)
    variance_m2 = 0.03**2
    less = wheels.doubted(variance_m2, 2.5)
    assert variance_m2 - wheels.sigma[0] ** 2 + less.sigma[0] ** 2 == pytest.approx(2.5 * variance_m2)
    assert less.sigma[3] / wheels.sigma[3] == pytest.approx(less.sigma[0] / wheels.sigma[0])
    assert (less.sigma[1:3] == wheels.sigma[1:3]).all()
    assert np.isinf(wheels.doubted(variance_m2, np.inf).sigma[[0, 3]]).all()


def changes_told(speeds_mps: list[float], sigma_m: float = 0.05) -> list[float | None]:
    """What increments tell of the wheels' change of speed after a gate that the robot's steady 1 m/s
    contradicts; None for a fault. `sigma_m` is so wide that the innovation alone contradicts nothing."""
    gate, told, before = WheelGate(limit_sigma=6.0, patience=4), [], 1.0
    for speed in speeds_mps:
        wheels = gate.rejoined(increment(speed, speed - before), DT_S)
        gate.test((1.0 - speed) * DT_S, sigma_m, wheels, (1.0, 1.0), DT_S)
        told.append(None if gate.faulty else round(wheels.speed_change_mps, 9))
        before = speed
    return told


def test_a_counter_that_jumps_says_nothing_of_slip() -> None:
    """Neither in its own keyframes nor in the one after, whose wheels are 2 m/s slower than the jump's."""
    assert changes_told([1.0, 3.0, 1.0, 1.1]) == [0.0, None, 0.0, 0.1]
    assert changes_told([1.0, 2.0, 2.0, 1.0, 1.0]) == [0.0, None, None, 0.0, 0.0]


def test_wheels_that_break_loose_tell_it_once_they_are_believed() -> None:
    """Soon, where the IMU alone is not sure; after the gate's patience, where it is."""
    loose = [1.0, *[3.0] * 6]
    assert changes_told(loose) == [0.0, None, None, 2.0, 0.0, 0.0, 0.0]
    assert changes_told(loose, sigma_m=0.02) == [0.0, *[None] * 4, 2.0, 0.0]


def test_wheels_that_speed_up_as_motors_do_are_no_fault() -> None:
    assert changes_told([1.0 + 0.3 * i for i in range(5)]) == [0.0, *[0.3] * 4]


def test_a_fault_tells_no_change_of_speed_and_one_that_counts_less_does() -> None:
    wheels = increment(3.0, 2.0)
    assert wheels.doubted(0.03**2, np.inf).speed_change_mps == 0.0
    assert wheels.doubted(0.03**2, 2.5).speed_change_mps == 2.0
