"""The metric of the judged runs is the inverse of the covariance that references predict for their errors."""

from __future__ import annotations

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.infer.predictive import Products, metric
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

T, P, Q, N = 2, 3, 2, 65
SIGMA = np.array([0.5, 2.0])
ROBOT = RobotOffsets(
    np.array([0.3, -0.2, 0.1]), np.diag([1.0, 0.3, 0.1]) + 0.02, np.array([0.02, 0.1, 0.3]), np.ones(3), 9
)


def run(seed: int, error: np.ndarray | None = None) -> tuple[np.ndarray, Products]:
    """Columns of a run, and its products."""
    X = np.random.default_rng(seed).standard_normal((N, T + P + Q + 1))
    if error is not None:
        X[:, -1] = error
    return X, Products(X.T @ X, T, P)


def covariance(runs: list[np.ndarray]) -> np.ndarray:
    """Of the errors of several runs, which share the robot's offsets."""
    stacked = np.vstack([X[:, T : T + P] for X in runs])
    out = stacked @ ROBOT.covariance @ stacked.T
    at = 0
    for X in runs:
        J, own, mine = X[:, :T], X[:, T : T + P], slice(at, at + len(X))
        out[mine, mine] += np.eye(len(X)) + (J * SIGMA**2) @ J.T + (own * ROBOT.scatter) @ own.T
        at += len(X)
    return out


def test_products_in_the_metric_are_those_by_the_whole_covariance() -> None:
    made = [run(1), run(2)]
    columns = [X for X, _ in made]
    inverse = np.linalg.inv(covariance(columns))
    e = np.concatenate([X[:, -1] - X[:, T : T + P] @ ROBOT.mean for X in columns])
    all_ = np.column_stack([np.vstack([X[:, T:-1] for X in columns]), e])
    m = metric([products for _, products in made], SIGMA, ROBOT)
    np.testing.assert_allclose(m.K[:-1, :-1], all_.T @ inverse @ all_, atol=1e-8)
    assert not m.K[m.none].any()
    assert m.K[m.error, m.error] == pytest.approx(e @ inverse @ e)


def test_states_are_fitted_to_what_signatures_and_the_robot_leave() -> None:
    X, _ = run(5)
    used, states = np.array([0.2, -0.1, 0.3, 1.5, -2.0]), np.array([0.5, 1.0])
    shared = np.concatenate([ROBOT.mean, np.zeros(Q)])
    _, products = run(5, X[:, :T] @ states + X[:, T:-1] @ (used + shared))
    np.testing.assert_allclose(products.fitted_states(used, np.full(T, 1e4), ROBOT), states, atol=1e-6)
    assert abs(products.fitted_states(used, np.full(T, 1e-3), ROBOT)).max() < 1e-3


def test_states_are_held_by_their_prior() -> None:
    X, products = run(5)
    used = np.array([0.2, -0.1, 0.3, 1.5, -2.0])
    left = X[:, -1] - X[:, T:-1] @ (used + np.concatenate([ROBOT.mean, np.zeros(Q)]))
    J, sigma = X[:, :T], np.array([0.05, 0.2])
    wanted = np.linalg.solve(J.T @ J + np.diag(1.0 / sigma**2), J.T @ left)
    np.testing.assert_allclose(products.fitted_states(used, sigma, ROBOT), wanted)


def test_products_with_signatures_are_those_of_all_columns() -> None:
    X, _ = run(7)
    rows = np.delete(X, [T + P, T + P + 1], axis=1).astype(np.float32)
    X[:, [*range(T + P), -1]] = rows  # 32 bits, as in a run
    whitened = SimpleNamespace(rows=rows, gram=rows.astype(float).T @ rows.astype(float), states=T)
    whitened.gram_with = functools.partial(WhitenedRun.gram_with, whitened)
    found = Products.of(whitened, X[:, T + P : T + P + Q])  # type: ignore[arg-type]
    np.testing.assert_allclose(found.gram, X.T @ X)
    assert (found.states, found.shared) == (T, P)
