"""The metric of the judged runs is the inverse of the covariance that references predict for their errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.infer.predictive import Metric, Products, energies, excess, metric
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, inner_products

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


def in_two_channels(X: np.ndarray) -> WhitenedRun:
    """A run without signatures, whose first 40 samples are of one channel."""
    rows, none = np.delete(X, range(T + P, T + P + Q), axis=1).astype(np.float32), np.zeros(0)
    channel, gram = np.repeat([0, 1], [40, N - 40]), inner_products(rows, rows)
    residuals: Any = None
    return WhitenedRun(residuals, gram, rows, none, none, channel, none, channel, T, none, np.ones(2))


def test_what_states_and_robot_explain_is_no_energy() -> None:
    X, _ = run(3)
    noise = 0.1 * np.random.default_rng(4).standard_normal(N)
    used = np.array([1.5, -2.0])
    error = X[:, :T] @ (0.5, 1.0) + X[:, T : T + P] @ ROBOT.mean + X[:, T + P : -1] @ used + noise
    X, products = run(3, error)
    with_it, without = (
        energies(in_two_channels(X), products, u, error - X[:, T + P : -1] @ u, SIGMA, ROBOT)
        for u in (used, 0.0 * used)
    )
    assert (with_it < 0.1).all()
    assert (without > 1.0).all()


def test_priors_hold_states_and_robot_where_energy_is_counted() -> None:
    """Against least squares with the priors as rows; the second channel counts for a quarter."""
    X, _ = run(6)
    used, weight = np.array([0.3, -0.4]), np.repeat([1.0, 0.25], [40, N - 40])
    offsets = ROBOT.covariance + np.diag(ROBOT.scatter)
    rows = np.sqrt(weight)[:, None]
    left = X[:, -1] - X[:, T + P : -1] @ used
    prior = np.zeros((T + P, T + P))
    prior[:T, :T], prior[T:, T:] = np.diag(1.0 / SIGMA), np.linalg.cholesky(np.linalg.inv(offsets)).T
    A, own = np.vstack([rows * X[:, : T + P], prior]), left - X[:, T : T + P] @ ROBOT.mean
    best = np.linalg.lstsq(A, np.concatenate([rows[:, 0] * own, np.zeros(T + P)]), rcond=None)[0]
    square = (own - X[:, : T + P] @ best) ** 2
    products = Products((rows * X).T @ (rows * X), T, P)
    found = energies(in_two_channels(X), products, used, left, SIGMA, ROBOT)
    np.testing.assert_allclose(found, [square[:40].mean(), square[40:].mean()], rtol=1e-4)


def test_a_weight_of_a_channel_is_that_of_its_squares() -> None:
    X, _ = run(8)
    plain = in_two_channels(X)
    assert plain.weighted(np.ones(2)) is plain
    rows = plain.rows * np.repeat([1.0, 0.5], [40, N - 40])[:, None]
    np.testing.assert_allclose(
        plain.weighted(np.array([1.0, 0.25])).gram, rows.T @ rows, rtol=1e-5, atol=1e-5
    )


def test_products_with_signatures_are_those_of_all_columns() -> None:
    X, _ = run(7)
    X = X.astype(np.float32).astype(float)  # as a run has them
    found = Products.of(in_two_channels(X), X[:, T + P : T + P + Q])
    np.testing.assert_allclose(found.gram, X.T @ X)
    assert (found.states, found.shared) == (T, P)


def test_what_is_within_expectation_is_no_excess() -> None:
    rng, found = np.random.default_rng(9), list[tuple[float, float, float]]()
    for _ in range(40):
        X = rng.standard_normal((N, 11))
        change = 3.0 * X[:, 0] + X[:, :10] @ rng.standard_normal(10)
        values = list[float]()
        for error in (X[:, 10], change + X[:, 10]):
            own = np.column_stack([X[:, :10], error])
            m, used = Metric(np.pad(own.T @ own, (0, 1)), 10), np.zeros(12)
            values.append(excess(m))
        used[:10] = np.linalg.lstsq(X[:, :10], change, rcond=None)[0]
        found.append((values[0], values[1], excess(m, used)))
    without, with_it, left = np.array(found).T
    assert np.mean(without > 0.0) <= 0.1
    assert (with_it > 100.0).all()
    np.testing.assert_allclose(left, without, atol=1e-6)
