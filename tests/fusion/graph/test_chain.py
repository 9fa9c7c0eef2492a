"""The chain smoother against GTSAM's own optimisers, and its invariants."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, M, V, X
from numpy.typing import NDArray

from terrafusion.fusion.graph import gnss_factor, keyframe_rows, velocity_factor, wheel_factor
from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gauss_markov import markov_step
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import DIM, IMU_ROTATION, LINEAR, MARKOV, KeyState
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.graph.triangular import covariance_before, eliminated
from terrafusion.fusion.graph.velocity_factor import GnssVelocity, lever_arm_velocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from tests import gtsam_factors

Array = NDArray[np.float64]
N = len(LINEAR)
NS = 100_000_000
STEP = markov_step(
    0.1,
    mean=[0.05, 0.0, 0.0, -0.3, *[0.0] * (N - 4)],
    sigma=[0.1, 0.5, 0.5, 0.3, 0.1, 0.05, *[0.02] * (N - 6)],
    time_s=(5.0, *[30.0] * (N - 1)),
)
RATE = np.array([0.0, 0.0, 0.2])
SIGMAS = np.array(
    [0.05] * 2 + [0.3] + [2.0] * 3 + [0.5] * 3 + [0.1] * 3 + [0.01] * 3 + [0.1, 0.5, 0.5] + [0.1] * (N - 3)
)


def iso(dim: int, sigma: float) -> gtsam.noiseModel.Isotropic:
    return gtsam.noiseModel.Isotropic.Sigma(dim, sigma)


def drive(n: int, seed: int, heading: float = 0.4) -> tuple[list[KeyState], list, list, list]:
    """Initial states, links, wheel increments and fixes of a noisy drive on a circle."""
    rng = np.random.default_rng(seed)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.80665)
    for name, value in (("Gyroscope", 1e-6), ("Accelerometer", 1e-4), ("Integration", 1e-8)):
        getattr(params, f"set{name}Covariance")(np.eye(3) * value)
    params.setBiasAccCovariance(np.eye(3) * 1e-6)
    params.setBiasOmegaCovariance(np.eye(3) * 1e-8)
    bias = gtsam.imuBias.ConstantBias()
    points, links, wheels, fixes = [], [], [], []
    rate, speed, dt = 0.2, 1.0, 0.1
    for k in range(n):
        yaw = heading + rate * dt * k
        along = np.array([np.sin(yaw) - np.sin(heading), np.cos(heading) - np.cos(yaw), 0.0]) * speed / rate
        rotation = gtsam.Rot3.Rz(yaw).compose(gtsam.Rot3.Expmap(rng.normal(0, 0.02, 3)))
        pose = gtsam.Pose3(rotation, along + rng.normal(0, 0.3, 3))
        velocity = speed * np.array([np.cos(yaw), np.sin(yaw), 0.0]) + rng.normal(0, 0.1, 3)
        points.append(KeyState(pose, velocity, bias, np.zeros(N)))
        fixes.append(along + rng.normal(0, 0.2, 3))
        if k == 0:
            continue
        measured = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for _ in range(10):
            force = np.array([0.0, rate * speed, 9.80665]) + rng.normal(0, 0.05, 3)
            measured.integrateMeasurement(force, np.array([0, 0, rate]) + rng.normal(0, 0.005, 3), dt / 10)
        link = gtsam.NonlinearFactorGraph()
        link.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), measured))
        links.append(link)
        moved = np.array([speed * dt / 0.95, 0.001, 0.0]) + rng.normal(0, 0.002, 3)
        wheels.append(
            WheelIncrement(moved, np.array([0.003, 0.005, 0.005, 0.01]), moved[0], 0.03, 0.02, 0.01, 0.002)
        )
    return points, links, wheels, fixes


def steps(links: list, wheels: list, k: int) -> tuple:
    """What links keyframe k to the one before."""
    return (links[k - 1], STEP, wheels[k - 1]) if k else ()


def build(chain: Chain, n: int, seed: int = 1, heading: float = 0.4) -> gtsam.NonlinearFactorGraph:
    """Fill the chain; the same graph for GTSAM's optimiser, without the prior."""
    points, links, wheels, fixes = drive(n, seed, heading)
    graph = gtsam.NonlinearFactorGraph()
    for k in range(n):
        chain.append(k * 100_000_000, points[k], *steps(links, wheels, k))
        if k == 0:
            chain.set_prior(SIGMAS)
        else:
            for i in range(links[k - 1].size()):
                graph.add(links[k - 1].at(i))
            graph.add(gtsam_factors.wheel_factor_of(wheels[k - 1], X(k - 1), X(k), M(k)))
            graph.add(gtsam_factors.markov_factor(STEP, M(k - 1), M(k)))
        if k % 4 == 0:
            fix = GnssPosition(
                fixes[k], np.array([0.2, 0.0, 0.3]), np.full(3, 0.3), 1.0, np.array([0.9, 0.3, 0.0])
            )
            chain.add_fix(k, fix)
            graph.add(gtsam_factors.gnss_position_factor(fix, X(k), M(k)))
            told = GnssVelocity(
                points[k].velocity,
                np.array([0.1, 0.2, 9.0]),
                np.array([0.2, 0.0, 0.3]),
                lever_arm_velocity(RATE, -0.05),
            )
            chain.add_velocity(k, told)
            graph.add(gtsam_factors.gnss_velocity_factor(told, X(k), V(k), M(k)))
    return graph


def add_priors(graph: gtsam.NonlinearFactorGraph, start: KeyState) -> None:
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    graph.add(gtsam.PoseRotationPrior3D(X(0), start.pose, diagonal(SIGMAS[:3])))
    graph.add(gtsam.PoseTranslationPrior3D(X(0), start.pose, diagonal(SIGMAS[3:6])))  # equal: any axes
    graph.add(gtsam.PriorFactorVector(V(0), start.velocity, diagonal(SIGMAS[6:9])))
    graph.add(gtsam.PriorFactorConstantBias(B(0), start.bias, diagonal(SIGMAS[9:15])))
    graph.add(gtsam.PriorFactorVector(M(0), start.linear, diagonal(SIGMAS[MARKOV])))


def test_batch_solution_is_that_of_gtsam() -> None:
    chain = Chain(calibrate=True)
    graph = build(chain, 40)
    start = chain.nodes[0].point
    chain.rebuild()
    values = gtsam.Values(chain.values)
    for k, node in enumerate(chain.nodes):
        values.insert(M(k), node.point.linear)
    add_priors(graph, start)
    params = gtsam.GaussNewtonParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-14)
    params.setLinearSolverType("MULTIFRONTAL_QR")
    solution = gtsam.GaussNewtonOptimizer(graph, values, params).optimize()
    batch = BatchSmoother(chain)
    batch.optimise(tolerance=1e-6)
    states = batch.states()
    for k in (0, 17, 39):
        state = states[k]
        assert np.abs(state.pose.localCoordinates(solution.atPose3(X(k)))).max() < 1e-7
        assert np.abs(state.velocity - solution.atVector(V(k))).max() < 1e-7
        np.testing.assert_allclose(state.linear, solution.atVector(M(k)), atol=1e-7)
    # GTSAM's Marginals uses Cholesky, which gives up here: a dense QR of its own linear system instead.
    ordering = gtsam.Ordering()
    for k in range(40):
        for symbol in (X, V, B, M):
            ordering.push_back(symbol(k))
    A, _ = graph.linearize(solution).jacobian(ordering)
    root = np.linalg.inv(np.linalg.qr(A, mode="r"))
    dense = root @ root.T
    covariances = batch.covariances()
    for k in (0, 17, 39):
        block = slice(DIM * k, DIM * (k + 1))
        np.testing.assert_allclose(covariances[k], dense[block, block], rtol=1e-4, atol=1e-9)


def test_filter_ends_where_the_batch_ends() -> None:
    """With all keyframes in the window, live updates reach the batch solution of the newest keyframe."""
    live, batch = Chain(calibrate=True), Chain(calibrate=True)
    points, links, wheels, fixes = drive(40, 3)
    for chain in (live, batch):
        for k in range(40):
            chain.append(k * 100_000_000, points[k], *steps(links, wheels, k))
            if k == 0:
                chain.set_prior(SIGMAS)
            if k % 4 == 0:
                chain.add_fix(k, GnssPosition(fixes[k], np.zeros(3), np.full(3, 0.3)))
            if chain is live:
                chain.solve(window=40)
    live.smooth(40, iterations=10)
    whole = BatchSmoother(batch)
    whole.optimise()
    a, b = live.state(39), whole.states()[39]
    # Live keyframes are linearised again only beyond 0.02 rad: a tenth of a sigma is left.
    sigma = np.sqrt(np.diag(whole.covariances()[-1]))
    assert (np.abs(a.local(b)) < 0.1 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(live.covariance)), sigma, rtol=0.1)


def test_a_late_fix_linearises_no_link_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does what it gives depend on that: another wheel increment is seen."""
    points, links, wheels, fixes = drive(8, seed=3)
    made: list[int] = []
    whole = keyframe_rows.linearised_link
    monkeypatch.setattr(Chain, "RELINEARISE", np.full(15, np.inf))

    def counted(node: Node, k: int, values: gtsam.Values) -> Array:
        made.append(k)
        return whole(node, k, values)

    monkeypatch.setattr(keyframe_rows, "linearised_link", counted)

    def solved(late: bool) -> Chain:
        chain = Chain()
        for k, point in enumerate(points):
            chain.append(k * NS, point, *steps(links, wheels, k))
            if k == 0:
                chain.set_prior(SIGMAS[: chain.dim])
            chain.solve(1)
        made.clear()
        fix = GnssPosition(fixes[4], np.zeros(3), np.full(3, 0.3))
        chain.add_fix(4, fix)
        if late:
            chain.solve(1)
            assert not made
        chain.revise(6, wheels=wheels[5].with_extra_variance(1.0))
        chain.solve(1)
        return chain

    once, twice = solved(late=False), solved(late=True)
    assert made == [6]
    assert (once.nodes[-1].delta == twice.nodes[-1].delta).all()
    assert (once.covariance == twice.covariance).all()


def test_forgetting_keeps_the_information() -> None:
    """Dropping old keyframes changes nothing in a graph whose linearisation stands still."""
    whole, short = Chain(calibrate=True), Chain(calibrate=True)
    build(whole, 30)
    _, links, wheels, fixes = drive(30, 1)
    for k in range(30):
        short.append(k * 100_000_000, whole.nodes[k].point, *steps(links, wheels, k))
        if k == 0:
            short.set_prior(SIGMAS)
        if k % 4 == 0:
            short.add_fix(
                k,
                GnssPosition(
                    fixes[k], np.array([0.2, 0.0, 0.3]), np.full(3, 0.3), 1.0, np.array([0.9, 0.3, 0.0])
                ),
            )
            for told in whole.nodes[k].velocities:
                short.add_velocity(k, told)
        short._eliminate_all()
        short.forget(8)
    whole._eliminate_all()
    assert len(short.nodes) == 8
    assert short.first == 22
    np.testing.assert_allclose(short.nodes[-1].delta, whole.nodes[-1].delta, atol=1e-8)
    np.testing.assert_allclose(short.covariance, whole.covariance, rtol=1e-6, atol=1e-12)
    for chain in (short, whole):
        chain._back_substitute_to(24, solved=chain.last)
        chain._back_substitute_to(23, solved=26)
    for k in range(23, 30):
        found = short.nodes[k - short.first].delta
        np.testing.assert_allclose(found, whole.nodes[k].delta, atol=1e-8)


def test_moving_the_linearisation_point_of_a_prior_keeps_its_mean() -> None:
    """A prior carried to another tangent space still has its mean where it was."""
    rng = np.random.default_rng(5)
    chain = Chain(calibrate=True)
    points, *_ = drive(1, 0)
    chain.append(0, points[0])
    chain.set_prior(SIGMAS)
    delta = rng.normal(0, 1, DIM) * np.array([0.3] * 3 + [2.0] * 3 + [0.5] * 3 + [0.1] * 6 + [0.1] * N)
    chain.nodes[0].delta = delta
    chain._move(0)
    chain.smooth(1, iterations=20)
    back = chain.state(0)
    assert np.abs(back.pose.localCoordinates(points[0].pose)).max() < 1e-6
    assert np.abs(back.velocity - points[0].velocity).max() < 1e-9


def test_restart_keeps_state_and_adds_doubt() -> None:
    chain = Chain(calibrate=True)
    build(chain, 20)
    chain.solve(20)
    before, P = chain.state(19), chain.covariance
    doubt = np.zeros(DIM)
    doubt[3:6] = 25.0
    chain.restart(doubt)
    assert chain.first == chain.last == 19
    assert np.abs(chain.state(19).pose.localCoordinates(before.pose)).max() < 1e-9
    np.testing.assert_allclose(chain.covariance, P + np.diag(doubt), rtol=1e-6, atol=1e-9)


def numeric(function: Callable[[Array], Array], n: int, h: float = 1e-6) -> Array:
    """Central differences (m, n) of a function of a tangent vector, about zero."""
    return np.stack([(function(s) - function(-s)) / (2 * h) for s in h * np.eye(n)], axis=1)


def at(pose: gtsam.Pose3, linear: Array, velocity: Array | None = None) -> KeyState:
    bias = gtsam.imuBias.ConstantBias()
    return KeyState(pose, np.zeros(3) if velocity is None else velocity, bias, linear)


@pytest.mark.parametrize("seed", range(5))
def test_wheel_jacobians_match_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = gtsam.Pose3.Expmap(rng.normal(0, 1, 6))
    b = a.compose(gtsam.Pose3.Expmap(rng.normal(0, 0.4, 6)))
    wheels = WheelIncrement(rng.normal(0, 0.2, 3), np.ones(4), 0.3, 0.2, -0.1, 0.4, 0.05)
    linear = rng.uniform(-0.2, 0.4, N)

    def residual(a: gtsam.Pose3, b: gtsam.Pose3, linear: Array) -> Array:
        return wheel_factor.linearised(at(a, linear), at(b, linear), wheels)[0]

    _, H_a, H_b, H_linear = wheel_factor.linearised(at(a, linear), at(b, linear), wheels)
    for H, function, n in (
        (H_a, lambda s: residual(a.retract(s), b, linear), 6),
        (H_b, lambda s: residual(a, b.retract(s), linear), 6),
        (H_linear, lambda s: residual(a, b, linear + s), N),
    ):
        np.testing.assert_allclose(H, numeric(function, n), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_gnss_jacobians_match_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, linear = gtsam.Pose3.Expmap(rng.normal(0, 1, 6)), rng.normal(0, 1, N)
    place, lever, speed = rng.normal(0, 5, 3), rng.normal(0, 0.5, 3), rng.normal(0, 1, 3)
    fix = GnssPosition(place, lever, np.ones(3), 0.3, speed, delay_s=0.4)

    def residual(pose: gtsam.Pose3, linear: Array) -> Array:
        return gnss_factor.linearised(fix, at(pose, linear))[0]

    _, H_pose, H_linear = gnss_factor.linearised(fix, at(pose, linear))
    for H, function, n in (
        (H_pose, lambda s: residual(pose.retract(s), linear), 6),
        (H_linear, lambda s: residual(pose, linear + s), N),
    ):
        np.testing.assert_allclose(H, numeric(function, n), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_velocity_jacobians_match_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, linear, v = gtsam.Pose3.Expmap(rng.normal(0, 1, 6)), rng.normal(0, 1, N), rng.normal(0, 1, 3)
    told = GnssVelocity(
        rng.normal(0, 1, 3),
        np.full(3, 0.1),
        rng.normal(0, 0.5, 3),
        lever_arm_velocity(rng.normal(0, 1, 3), -0.1),
    )

    def residual(pose: gtsam.Pose3, v: Array, linear: Array) -> Array:
        return velocity_factor.linearised(told, at(pose, linear, v))[0]

    _, H_pose, H_linear = velocity_factor.linearised(told, at(pose, linear, v))
    for H, function, n in (
        (H_pose, lambda s: residual(pose.retract(s), v, linear), 6),
        (np.eye(3), lambda s: residual(pose, v + s, linear), 3),
        (H_linear, lambda s: residual(pose, v, linear + s), N),
    ):
        np.testing.assert_allclose(H, numeric(function, n), atol=1e-6)


def test_an_antenna_swings_as_a_point_of_the_body_does() -> None:
    """Its velocity some time before the keyframe, from its places then, in the axes of the keyframe."""
    rate, lever, offset, h = np.array([0.2, -0.3, 0.9]), np.array([0.4, 0.1, 0.6]), -0.1, 1e-5
    ahead, behind = (gtsam.Rot3.Expmap(rate * (offset + s)).matrix() @ lever for s in (h, -h))
    assert lever_arm_velocity(rate, offset) @ lever == pytest.approx((ahead - behind) / (2 * h), abs=5e-3)
    assert lever_arm_velocity(rate, 0.0) @ lever == pytest.approx(np.cross(rate, lever))


def test_a_turned_imu_acts_as_its_rows_say() -> None:
    """The rows' right-hand side with a rotation d is that of a factor made of the readings turned by d."""
    turn = np.array([0.004, -0.006, 0.005])
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.80665)
    params.setIntegrationCovariance(np.eye(3) * 1e-8)
    gyro, accel = np.array([0.05, -0.1, 0.4]), np.array([0.8, 0.3, 9.7])
    at_once = np.cross(turn, gyro), np.cross(turn, accel)
    sides = []
    for extra, linear_turn in (((0.0, 0.0), turn), (at_once, np.zeros(3))):
        chain = Chain(calibrate=True)
        linear = np.zeros(N)
        linear[IMU_ROTATION.start - 15 : IMU_ROTATION.stop - 15] = linear_turn
        point = KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), linear)
        measured = gtsam.PreintegratedCombinedMeasurements(params, point.bias)
        for _ in range(10):
            measured.integrateMeasurement(accel + extra[1], gyro + extra[0], 0.01)
        link = gtsam.NonlinearFactorGraph()
        link.add(gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), measured))
        chain.append(0, point)
        chain.append(100_000_000, point, link, gyro_radps=gyro, accel_mps2=accel, preintegrated=True)
        chain.rebuild()
        sides.append(chain._stacked(0)[:15, 2 * DIM])
        untouched = np.abs(sides[0] - sides[-1]).max()
    assert untouched < 0.02 * np.abs(sides[0]).max()
    rows = chain._stacked(0)
    assert np.abs(rows[:9, IMU_ROTATION]).max() > 0.0


def test_a_markov_step_keeps_the_stationary_variance() -> None:
    """Two half steps make a whole one, and the variance neither grows nor shrinks."""
    whole, half = (markov_step(dt, 0.3, 0.2, 4.0) for dt in (2.0, 1.0))
    assert whole.decay == pytest.approx(half.decay**2)
    assert whole.sigma**2 == pytest.approx(half.sigma**2 * (1 + half.decay**2))
    assert whole.decay**2 * 0.04 + whole.sigma**2 == pytest.approx(0.04)
    fresh = markov_step(0.1, 0.3, 0.2, 4.0, forget=1.0)
    assert fresh.decay == 0.0
    assert fresh.sigma == pytest.approx(0.2)


def test_an_undetermined_chain_says_so() -> None:
    chain = Chain(calibrate=True)
    points, *_ = drive(1, 0)
    chain.append(0, points[0])
    with pytest.raises(ArithmeticError, match="not determined"):
        chain.solve(1)


def test_the_covariance_of_an_eliminated_state_is_that_of_the_whole() -> None:
    rng, d = np.random.default_rng(3), 4
    known, rest = rng.normal(size=(d, d + 1)), rng.normal(size=(8, 2 * d + 1))  # no triangle
    both = np.vstack([np.hstack([known[:, :d], np.zeros((d, d))]), rest[:, :-1]])
    whole = np.linalg.inv(both.T @ both)
    conditional, _ = eliminated(np.asfortranarray(np.vstack([np.zeros((d, 2 * d + 1)), rest])), known)
    np.testing.assert_allclose(covariance_before(conditional, whole[d:, d:]), whole[:d, :d], rtol=1e-9)
