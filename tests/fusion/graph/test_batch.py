"""The batch on arrays against the chain it is made from."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import V, X

from terrafusion.fusion.graph.batch import BatchSmoother
from terrafusion.fusion.graph.batch_rows import RowBlock
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import ANTENNA, DIM, IMU_ROTATION, LINEAR, VELOCITY, KeyState
from terrafusion.fusion.graph.velocity_factor import GnssVelocity, lever_arm_velocity, rows
from tests.fusion.graph.test_chain import SIGMAS, STEP, drive, iso

NS = 100_000_000


def varied(calibrate: bool, n: int = 12, seed: int = 0) -> Chain:
    """A chain with everything a keyframe can have: no wheels, no IMU, rest, velocities, two fixes."""
    chain = Chain(calibrate=calibrate)
    points, links, wheels, fixes = drive(n, seed=seed + 2)
    rng = np.random.default_rng(seed)
    for k, point in enumerate(points):
        point = KeyState(point.pose, point.velocity, point.bias, rng.normal(0.0, 0.05, len(LINEAR)))
        if k == 0:
            chain.append(0, point)
            chain.set_prior(SIGMAS[: chain.dim])
            continue
        increment = None if k == 3 else dataclasses.replace(wheels[k - 1], surge_m=0.02 * calibrate)
        rates = np.array([0.01, 0.02, 0.2]), np.array([0.1, 0.2, 9.8])
        chain.append(k * NS, point, links[k - 1], STEP, increment, *rates, k != 4)
        if k == 5:
            links[k - 1].add(gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), iso(6, 0.1)))
        if k == 6:
            chain.add(k, gtsam.PriorFactorVector(V(k), np.zeros(3), iso(3, 0.5)))
        for i in range(k % 3):
            lever, velocity = np.array([0.2, 0.1 * i, 0.3]), np.array([0.9, 0.3, 0.0])
            fix = GnssPosition(fixes[k], lever, np.array([0.3, 0.4, 1.0]), 0.7, velocity, delay_s=0.02)
            chain.add_fix(k, fix)
            turned = lever_arm_velocity(calibrate * np.array([0.1, -0.2, 0.3 * k]), -0.05)
            chain.add_velocity(k, GnssVelocity(velocity, np.array([0.1, 0.2, 9.0]), lever, turned))
    return chain


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("calibrate", [False, True])
def test_rows_are_those_of_the_chain(calibrate: bool, seed: int) -> None:
    """Rows may come in another order, so that their information matrices are compared."""
    chain = varied(calibrate, seed=seed)
    chain.rebuild()
    block = RowBlock(chain.nodes, 0, 0, 12)
    linear = np.array([node.point.linear for node in chain.nodes])
    found_rows, counts = block.rows(chain.values, linear)
    for k in range(11):
        wanted = chain._stacked(k)[len(chain.nodes[k].prior) :]
        found = found_rows[k, chain.dim : counts[k]]
        scale = np.sqrt(np.diag(wanted.T @ wanted)) + 1e-6
        np.testing.assert_allclose(
            found.T @ found / np.outer(scale, scale), wanted.T @ wanted / np.outer(scale, scale), atol=1e-12
        )
        assert not found_rows[k, counts[k] :].any()
    if calibrate:
        assert found_rows[0, :, IMU_ROTATION].any()
        assert found_rows[1, :, ANTENNA].any()


def test_a_velocity_of_the_body_origin_is_a_prior_of_the_velocity() -> None:
    point, sigma = drive(3, seed=2)[0][1], np.array([0.1, 0.2, 9.0])
    prior = rows(GnssVelocity(point.velocity + 0.3, sigma), point, DIM)
    assert np.count_nonzero(prior) == 6
    np.testing.assert_allclose(prior[:, VELOCITY], np.diag(1.0 / sigma))
    np.testing.assert_allclose(prior[:, DIM], 0.3 / sigma)
    hardly = GnssVelocity(point.velocity + 0.3, sigma, np.zeros(3), np.full((3, 3), 1e-300))
    np.testing.assert_allclose(prior, rows(hardly, point, DIM), atol=1e-15)


def test_blocks_hand_on_what_they_know(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the chain is cut into blocks changes nothing."""
    whole = BatchSmoother(varied(calibrate=False))
    whole.optimise()
    monkeypatch.setattr("terrafusion.fusion.graph.batch.BLOCK", 5)
    cut = BatchSmoother(varied(calibrate=False))
    cut.optimise()
    for a, b in zip(whole.states(), cut.states(), strict=True):
        np.testing.assert_allclose(a.local(b), 0.0, atol=1e-12)
    np.testing.assert_allclose(whole.covariances(), cut.covariances(), rtol=1e-9, atol=1e-12)


def test_step_halving_ends_where_plain_steps_end() -> None:
    """From a start that is metres and half a radian off the same minimum is found."""
    chain = varied(calibrate=False)
    near = BatchSmoother(chain)
    near.optimise(tolerance=1e-5)
    far = []
    for k, state in enumerate(near.states()):
        off = np.zeros(21)
        off[:6] = 0.4 * np.sin(k), -0.2, 0.5, 2.0, np.cos(k), 1.0
        far.append(state.retract(off))
    away = BatchSmoother(chain, far)
    away.optimise(tolerance=1e-5)
    sigma = np.sqrt(np.array([np.diag(P) for P in near.covariances()]))
    for a, b, s in zip(near.states(), away.states(), sigma, strict=True):
        assert (np.abs(a.local(b)[:21]) < 1e-4 * s).all()


def test_a_keyframe_that_nothing_ties_down_is_refused() -> None:
    chain = Chain()
    for k, point in enumerate(drive(3, seed=2)[0]):
        chain.append(k * NS, point)
    with pytest.raises(ArithmeticError, match="not determined"):
        BatchSmoother(chain).optimise()
