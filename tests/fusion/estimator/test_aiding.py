"""Barometer and magnetometer: the bias beside the graph, the factors, the gates."""

from __future__ import annotations

import dataclasses
import math

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.atmosphere import pressure_at
from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.estimator.alignment import Start
from terrafusion.fusion.estimator.barometer import BarometerAiding, height_factor, height_jacobian
from terrafusion.fusion.estimator.magnetometer import (
    CHANCES,
    FieldReference,
    MagnetometerAiding,
    heading_factor,
    levelled,
    wrapped,
    yaw_jacobian,
)
from terrafusion.fusion.estimator.slow_bias import MOST_AHEAD_NS, SlowBias, split_by_time
from terrafusion.fusion.graph.key_state import yaw_of

ANGLES = st.floats(-3.1, 3.1)
TILTS = st.floats(-0.5, 0.5)


def rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return np.asarray(gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix())


def test_the_bias_beside_the_graph_is_the_joint_filter() -> None:
    """Motion, fixes and biased measurements in turn: state and bias as a Kalman filter over both has them."""
    rng = np.random.default_rng(0)
    x, P = np.zeros(2), np.diag([4.0, 100.0])
    s, variance, bias = 0.0, 4.0, SlowBias.of(np.zeros(1), np.array([10.0]))
    for k in range(60):
        P[0, 0] += 0.3
        variance += 0.3
        if k % 7 == 0:  # a fix; the bias is only considered, so the joint filter leaves it as it is
            z = rng.normal()
            gain = P[0, 0] / (P[0, 0] + 1.0)
            x[0] += gain * (z - x[0])
            P = np.array(
                [[(1.0 - gain) * P[0, 0], (1.0 - gain) * P[0, 1]], [(1.0 - gain) * P[1, 0], P[1, 1]]]
            )
            s, before = s + variance / (variance + 1.0) * (z - s), variance
            variance = before / (before + 1.0)
            bias.state_updated(before, variance)
        P[1, 1] += 0.01
        bias.drift(np.array([0.01]))
        z, H, noise = 5.0 + rng.normal(), np.ones(2), 0.5
        S = H @ P @ H + noise
        K = P @ H / S
        x, P = x + K * (z - H @ x), P - np.outer(K, K) * S
        own = bias.measure(z - s - bias.mean[0], np.ones(1), variance, noise)
        if own is not None:
            gain = variance / (variance + own.sigma**2)
            s, variance = s + gain * own.innovation, (1.0 - gain) * variance
            assert s == pytest.approx(x[0], abs=1e-6)
            assert variance == pytest.approx(P[0, 0], rel=1e-6)
        else:  # what so little would have told
            assert variance == pytest.approx(P[0, 0], rel=2e-3)
            x[0], P[0, 0] = s, variance
        assert bias.covariance[0, 0] == pytest.approx(P[1, 1], rel=1e-9)
        assert bias.cross[0] == pytest.approx(P[0, 1], rel=1e-6)


def test_a_bias_that_is_all_unknown_tells_nothing_of_the_state() -> None:
    """The first pressure says how high the weather is, not how high the robot."""
    bias = SlowBias.of(np.zeros(1), np.array([1e4]))
    own = bias.measure(432.1, np.ones(1), 0.04, 0.09)
    assert own is None or own.sigma > 1e3
    assert bias.mean[0] == pytest.approx(432.1, abs=1e-4)
    assert bias.covariance[0, 0] == pytest.approx(0.13, rel=1e-3)
    again = bias.measure(0.0, np.ones(1), 0.04, 0.09)
    assert again is None or again.sigma > 1.0


def test_a_variance_that_shrinks_unseen_leaves_a_possible_covariance() -> None:
    """Late fixes: the height's variance falls between two looks; the joint covariance must stay one."""
    bias, state = SlowBias.of(np.zeros(1), np.array([1e4])), 30.0
    bias.measure(3.0, np.ones(1), state, 0.07)
    for _ in range(10):
        state *= 0.9
        bias.state_updated(state, 0.95 * state)
        state *= 0.95
        assert bias.cross[0] ** 2 <= state * bias.covariance[0, 0] * (1.0 + 1e-9)
        assert bias.variance(np.ones(1), state, 0.07) > 0.07
        bias.measure(0.1, np.ones(1), state, 0.07)


@given(st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_what_the_graph_gets_never_has_negative_variance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bias, state = SlowBias.of(rng.normal(size=3), rng.uniform(0.01, 3.0, 3)), 1.0
    for _ in range(20):
        own = bias.measure(rng.normal(), rng.normal(size=3), state, rng.uniform(0.01, 1.0))
        if own is not None:
            assert own.sigma > 0.0
            state = state * own.sigma**2 / (state + own.sigma**2)
        assert np.linalg.eigvalsh(bias.covariance).min() > -1e-9
        assert (bias.cross**2 <= state * np.diag(bias.covariance) * (1.0 + 1e-6) + 1e-12).all()
        state += rng.uniform(0.0, 0.1)


@given(TILTS, TILTS, ANGLES)
@settings(max_examples=50, deadline=None)
def test_jacobians_against_finite_differences(roll: float, pitch: float, yaw: float) -> None:
    pose = gtsam.Pose3(gtsam.Rot3(rotation(roll, pitch, yaw)), np.array([1.0, -2.0, 3.0]))
    lever = np.array([0.2, -0.1, 0.4])

    def height(at: gtsam.Pose3) -> float:
        return float((at.translation() + at.rotation().matrix() @ lever)[2])

    eps = 1e-6
    heights, yaws = [], []
    for axis in np.eye(6) * eps:
        plus, minus = pose.retract(axis), pose.retract(-axis)
        heights.append((height(plus) - height(minus)) / (2.0 * eps))
        turn = wrapped(yaw_of(plus.rotation().matrix()) - yaw_of(minus.rotation().matrix()))
        yaws.append(turn / (2.0 * eps))
    R = pose.rotation().matrix()
    np.testing.assert_allclose(height_jacobian(R, lever), heights, atol=1e-8)
    np.testing.assert_allclose([*yaw_jacobian(R), 0.0, 0.0, 0.0], yaws, atol=1e-8)


def linear(factor: gtsam.NonlinearFactor, pose: gtsam.Pose3) -> tuple[np.ndarray, np.ndarray]:
    """Whitened Jacobian (m, 6) and right-hand side (m,) of a unary factor."""
    values = gtsam.Values()
    values.insert(X(0), pose)
    packed = factor.linearize(values).augmentedJacobian()
    return packed[:, :6], packed[:, 6]


@given(TILTS, TILTS, ANGLES, st.floats(-0.3, 0.3))
@settings(max_examples=50, deadline=None)
def test_the_factors_say_height_and_heading_and_nothing_else(
    roll: float, pitch: float, yaw: float, turn: float
) -> None:
    pose = gtsam.Pose3(gtsam.Rot3(rotation(roll, pitch, yaw)), np.array([1.0, -2.0, 3.0]))
    R, lever = pose.rotation().matrix(), np.array([0.2, -0.1, 0.4])
    J, b = linear(height_factor(0, 5.0, 0.5, lever), pose)
    wanted = 5.0 - (3.0 + (R @ lever)[2])
    np.testing.assert_allclose(
        J.T @ J, np.outer(height_jacobian(R, lever), height_jacobian(R, lever)) / 0.25, atol=1e-8
    )
    np.testing.assert_allclose(J.T @ b, height_jacobian(R, lever) * wanted / 0.25, atol=1e-6)
    J, b = linear(heading_factor(0, R, turn, 0.1), pose)
    vertical = np.append(R[2], np.zeros(3))  # a turn about the world's vertical, in body axes
    assert vertical @ J.T @ J @ vertical == pytest.approx(math.cos(turn) ** 2 / 0.01, rel=1e-6)
    assert vertical @ J.T @ b == pytest.approx(math.cos(turn) * math.sin(turn) / 0.01, rel=1e-6, abs=1e-9)
    east, north = np.append(R[0], np.zeros(3)), np.append(R[1], np.zeros(3))
    assert max(east @ J.T @ J @ east, north @ J.T @ J @ north) < 1e-4


@given(TILTS, TILTS, ANGLES)
@settings(max_examples=50, deadline=None)
def test_a_field_tells_the_heading_at_any_tilt_and_iron_is_linear(
    roll: float, pitch: float, yaw: float
) -> None:
    declination, world = 0.2, np.array([0.0, 0.0, -45e-6])
    world[:2] = 19e-6 * math.sin(declination), 19e-6 * math.cos(declination)
    R = rotation(roll, pitch, yaw)
    aid = MagnetometerAiding(None, declination, lambda _: None)
    told, H = aid._heading_of_field(R, R.T @ world)
    assert wrapped(told - yaw) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(levelled(R) @ R.T @ world, rotation(0.0, 0.0, yaw).T @ world, atol=1e-18)
    for k, step in enumerate((1e-6, 1e-10, 1e-10)):
        errors = []
        for sign in (1.0, -1.0):
            aid.bias.mean = np.array([declination, 0.0, 0.0])
            aid.bias.mean[k] -= sign * step  # the true bias is `step` above the estimate
            errors.append(wrapped(aid._heading_of_field(R, R.T @ world)[0] - told))
        assert (errors[0] - errors[1]) / (2.0 * step) == pytest.approx(
            H[k], rel=1e-4, abs=1e-3 * abs(H[1:]).max()
        )


def test_a_start_at_rest_and_its_sigma() -> None:
    level = Start(0, np.zeros(3), 1e-3, 0.0, 1e-3, 0.05, -0.1, 0.01, 0.0, np.zeros(3))
    R = rotation(0.05, -0.1, 2.0)
    field = R.T @ np.array([19e-6 * math.sin(0.1), 19e-6 * math.cos(0.1), -45e-6])
    aid = MagnetometerAiding(None, 0.1, lambda _: None)
    assert aid.stationary_heading(level, 0.01) is None, "no sample yet"
    for i in range(20):
        aid.add(i * 50_000_000, field)
    told = aid.stationary_heading(level, 0.01)
    assert told is not None
    assert told[0] == pytest.approx(2.0, abs=1e-6)
    assert told[1] == pytest.approx(math.hypot(0.03, 3e-6 / 19e-6, 0.05, 0.01 * 45 / 19), rel=0.02)
    for i in range(21, 100):  # it has begun to turn
        aid.add(i * 50_000_000, rotation(0.0, 0.0, -0.02 * i) @ field)
    assert aid.stationary_heading(level, 0.01)[0] == pytest.approx(2.0, abs=1e-6)
    late = dataclasses.replace(level, t_ns=-1_000_000_000)
    assert aid.stationary_heading(late, 0.01) is None, "a sample of the second of rest, and no other"
    moving = dataclasses.replace(level, gyro_bias_radps=None)
    assert aid.stationary_heading(moving, 0.01) is None
    unknown = MagnetometerAiding(None, None, lambda _: None)
    for i in range(20):
        unknown.add(i * 50_000_000, field)
    assert unknown.stationary_heading(level, 0.01) is None, "magnetic north is not north"


def test_a_disturbed_field_is_not_like_the_drives() -> None:
    reference = FieldReference()
    plain = np.array([0.0, 19e-6, -45e-6])
    assert reference.accepts(0, plain)
    assert reference.accepts(10**9, plain + 1e-6)
    assert not reference.accepts(2 * 10**9, plain + np.array([0.0, 15e-6, 0.0]))
    assert not reference.accepts(3 * 10**9, 3.0 * plain)
    assert not FieldReference().accepts(0, 1e-3 * plain)
    slow = [reference.accepts(i * 10**9, plain * (1.0 + 0.002 * (i - 4))) for i in range(4, 100)]
    assert all(slow), "a field that changes slowly, from place to place, is followed"


def stand(aid: BarometerAiding, heights: list[float], placed_from: int | None = None) -> None:
    """Pressures of a robot that stands, one a second, through the aid's own test; its path is laid onto the
    map before that of number `placed_from`."""
    from terrafusion.fusion.graph.chain import Chain
    from terrafusion.fusion.graph.key_state import LINEAR, KeyState

    chain = Chain()
    point = KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), np.zeros(len(LINEAR)))
    chain.append(0, point)
    chain.set_prior(np.full(chain.dim, 0.2))
    chain.solve(1)
    P = chain.covariance
    for i, height in enumerate(heights, 1):
        chain.nodes[-1].t_ns = i * 1_100_000_000
        aid.add(chain.nodes[-1].t_ns, float(pressure_at(height)))
        placed = placed_from is not None and i >= placed_from
        if aid.update(chain, chain.nodes[-1].t_ns, chain.nodes[-1].t_ns, P, P, placed):
            chain.solve(1)
            P = chain.covariance


def test_a_pressure_that_jumps_is_refused_then_taken_for_a_new_reference() -> None:
    seen: list[Innovation] = []
    aid = BarometerAiding(None, seen.append)
    stand(aid, [100.0] * 10 + [130.0] * 15)
    assert aid.jumps == 1
    assert aid.refused == 10
    assert [i.accepted for i in seen] == [True] * 9 + [False] * 10 + [True] * 5
    assert (
        aid.note()
        == "barometer: height differences of 14 s were used, 10 refused, taken to have jumped 1 times"
    )


def test_a_path_laid_onto_the_map_takes_the_barometer_along() -> None:
    """Heights shift by 30 m beside the pressures, once: nothing is refused, and the new reference holds."""
    seen: list[Innovation] = []
    aid = BarometerAiding(None, seen.append)
    stand(aid, [100.0] * 10 + [130.0] * 15, placed_from=11)
    assert aid.refused == aid.jumps == 0
    assert all(i.accepted for i in seen)
    assert max(abs(float(i.value[0])) for i in seen[-5:]) < 1.0


def test_pressures_that_are_none_are_refused() -> None:
    aid = BarometerAiding(None, lambda _: None)
    for pressure in (0.0, 1013.25, math.nan, -5.0, 2e5):
        aid.add(0, pressure)
    assert aid.refused == 5
    assert not aid.active


def test_a_magnetometer_that_does_not_turn_with_the_robot_is_left_out() -> None:
    aid = MagnetometerAiding(None, None, lambda _: None)
    for _ in range((CHANCES + 1) * MagnetometerAiding.PATIENCE):
        aid._refuse()
    assert aid.disabled
    aid.add(0, np.array([0.0, 19e-6, -45e-6]))
    assert not aid.active
    assert "left out" in aid.notes()[-1]


def test_a_stamp_of_another_clock_stops_nothing() -> None:
    due, waiting, impossible = split_by_time(
        [(10, "a"), (10**18, "b"), (30, "c"), (20 + MOST_AHEAD_NS, "d")], 20, 20
    )
    assert [value for _, value in due] == ["a"]
    assert [value for _, value in waiting] == ["c", "d"]
    assert impossible == 1
    assert split_by_time([(30 + MOST_AHEAD_NS, "late start")], 20, 30)[2] == 0


def test_a_climb_in_warm_air_is_within_the_sigma_told() -> None:
    """Air 5 % thinner than the standard's, a climb of 100 m: the share of the climb is one bias, not many."""
    bias = SlowBias.of(np.zeros(2), np.array([0.1, 0.05]))
    height, s, variance = 0.0, 0.0, 1e-4
    for _ in range(100):
        height += 1.0
        variance += 0.05**2
        bias.drift(np.array([1e-4, 0.0]))
        H = np.array([1.0, height])
        own = bias.measure(0.05 * height - float(H @ bias.mean) - s, H, variance, 0.01)
        if own is not None:
            gain = variance / (variance + own.sigma**2)
            s, before = s + gain * own.innovation, variance
            variance *= 1.0 - gain
            assert variance < before
    assert abs(s) < 2.0 * math.sqrt(variance)


def test_a_field_of_two_axes_is_refused() -> None:
    with pytest.raises(DataError, match="magnetometer"):
        MagnetometerAiding(None, 0.0, lambda _: None).add(0, [1e-5, 2e-5])
