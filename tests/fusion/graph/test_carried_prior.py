"""The prior of the oldest keyframe, moved to another linearisation point."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, V, X

from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import no_motion_factor
from terrafusion.fusion.graph.gauss_markov import markov_step
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import DIM, LINEAR, KeyState
from terrafusion.fusion.graph.keyframe_rows import carried_prior

N = len(LINEAR)
YAW_SIGMA_RAD, DRIFT_SIGMA_M = 0.3, 1.2
STEP = markov_step(
    0.1,
    mean=[0.0] * N,
    sigma=[0.1, DRIFT_SIGMA_M, DRIFT_SIGMA_M, *[0.1] * (N - 3)],
    time_s=(5.0, 60.0, 60.0, *[30.0] * (N - 3)),
)


def test_its_rows_match_finite_differences() -> None:
    rng = np.random.default_rng(0)
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    made_at = KeyState(pose, rng.normal(size=3), gtsam.imuBias.ConstantBias(), np.zeros(N))
    now = made_at.retract(0.5 * rng.normal(size=DIM))
    rows = np.hstack([rng.normal(size=(DIM, DIM)), rng.normal(size=(DIM, 1))])
    carried = carried_prior(rows, made_at.local(now))
    steps = 1e-6 * np.eye(DIM)
    moved = [made_at.local(now.retract(d)) - made_at.local(now.retract(-d)) for d in steps]
    np.testing.assert_allclose(carried[:, :DIM], rows[:, :DIM] @ np.array(moved).T / 2e-6, atol=1e-7)
    np.testing.assert_allclose(carried[:, DIM], rows[:, DIM] - rows[:, :DIM] @ made_at.local(now))


def standing(seed: int, keyframes: int = 100, kept: int = 30) -> Chain:
    """A robot that stands, its heading hardly known, with fixes that drift and scatter."""
    rng, chain, bias = np.random.default_rng(seed), Chain(), gtsam.imuBias.ConstantBias()
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.80665)
    for name, value in (("Gyroscope", 1e-6), ("Accelerometer", 1e-4), ("Integration", 1e-8)):
        getattr(params, f"set{name}Covariance")(np.eye(3) * value)
    params.setBiasAccCovariance(np.eye(3) * 1e-6)
    params.setBiasOmegaCovariance(np.eye(3) * 1e-8)
    sigmas = [0.02, 0.02, YAW_SIGMA_RAD, *[3.0] * 3, *[0.1] * 6, *[0.001] * 3]
    chain.append(0, KeyState(gtsam.Pose3(), np.zeros(3), bias, np.zeros(N)))
    chain.set_prior(np.array([*sigmas, 0.1, DRIFT_SIGMA_M, DRIFT_SIGMA_M, *[0.1] * (N - 3)])[: chain.dim])
    for k in range(1, keyframes):
        measured = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for _ in range(10):
            force, rate = np.array([0.0, 0.0, 9.80665]) + rng.normal(0, 0.05, 3), rng.normal(0, 0.005, 3)
            measured.integrateMeasurement(force, rate, 0.01)
        link = gtsam.NonlinearFactorGraph()
        link.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), measured))
        link.add(no_motion_factor(k))
        chain.append(100_000_000 * k, chain.state(chain.last), link, STEP)
        if k % 2 == 0:
            enu_m = np.array([0.5, -0.5, 0.0]) + rng.normal(0, 0.4, 3)
            chain.add_fix(k, GnssPosition(enu_m, np.zeros(3), np.full(3, 0.4)))
        chain.solve(50)
        chain.forget(kept)
        if k % 5 == 0:
            chain.smooth(50)
    return chain


@pytest.mark.parametrize("seed", [3, 5])
def test_fixes_of_a_robot_that_stands_tell_nothing_of_its_heading(seed: int) -> None:
    """They tell the sum of place and drift: both errors are large, and the heading turns the place's axes."""
    chain = standing(seed)
    assert abs(chain.state(chain.last).pose.rotation().yaw()) < 0.1 * YAW_SIGMA_RAD
    assert chain.covariance[2, 2] > (0.95 * YAW_SIGMA_RAD) ** 2
