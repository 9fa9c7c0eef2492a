"""The covariance of the body twist: its Jacobian, and what it says of heading errors."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.graph.body_twist import bias_sigma, twist_covariance, twist_jacobian
from terrafusion.fusion.graph.key_state import DIM, LINEAR, KeyState


def key_state(rng: np.random.Generator) -> KeyState:
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    bias = gtsam.imuBias.ConstantBias(rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.1)
    return KeyState(pose, rng.normal(size=3), bias, rng.normal(size=len(LINEAR)) * 0.1)


def body_twist(key: KeyState, gyro: np.ndarray) -> np.ndarray:
    R = key.pose.rotation().matrix()
    return np.concatenate([R.T @ key.velocity, gyro - key.bias.gyroscope()])


@given(st.integers(0, 2**32 - 1))
def test_the_jacobian_is_the_derivative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    key, gyro, h = key_state(rng), rng.normal(size=3), 1e-6
    steps = [
        (body_twist(key.retract(h * e), gyro) - body_twist(key.retract(-h * e), gyro)) / (2 * h)
        for e in np.eye(DIM)
    ]
    J = twist_jacobian(key.pose.rotation().matrix(), key.velocity)
    np.testing.assert_allclose(J, np.stack(steps, axis=1), atol=1e-8)


def test_heading_errors_that_turn_the_velocity_too_leave_the_body_velocity_alone() -> None:
    """A robot that drives straight ahead with an unknown heading still has no lateral velocity."""
    R, v = np.eye(3), np.array([1.5, 0.0, 0.0])
    turned = np.zeros(DIM)
    turned[2], turned[7] = 0.2, 0.2 * 1.5  # yaw, and the lateral world velocity that goes with it
    P = np.outer(turned, turned)
    assert P[7, 7] == pytest.approx(0.09)
    np.testing.assert_allclose(twist_covariance(P, R, v, 0.0), 0.0, atol=1e-15)


def test_the_gyro_noise_comes_on_top_of_the_bias() -> None:
    P = np.diag(np.arange(1.0, DIM + 1.0))
    Q = twist_covariance(P, np.eye(3), np.zeros(3), 2.0)
    np.testing.assert_allclose(np.diagonal(Q), [7.0, 8.0, 9.0, 13.0 + 4.0, 14.0 + 4.0, 15.0 + 4.0])
    np.testing.assert_allclose(bias_sigma(P) ** 2, [13.0, 14.0, 15.0, 10.0, 11.0, 12.0])


@given(st.integers(0, 2**32 - 1))
def test_it_is_a_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    key, root = key_state(rng), rng.normal(size=(DIM, DIM))
    Q = twist_covariance(root @ root.T, key.pose.rotation().matrix(), key.velocity, 0.01)
    np.testing.assert_array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > 0.0
