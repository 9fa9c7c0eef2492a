"""Live use: odometry between keyframes, and the message loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.odometry import transition
from terrafusion.fusion.live.loop import run
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate


@pytest.fixture(scope="module")
def drive() -> Recording:
    return until(simulate("figure_eight", terrain="asphalt", seed=5), 30.0)


@pytest.fixture(scope="module")
def odometry(drive: Recording) -> tuple[list[State], list[bool]]:
    """All odometry of the drive, and whether a keyframe had just been made."""
    estimator = Estimator.for_vehicle("elevate")
    states: list[State] = []
    keyframes: list[State | None] = []

    def publish(state: State) -> None:
        states.append(state)
        keyframes.append(estimator.latest())

    run(estimator, drive.messages(), publish)
    fresh = [a is not b for a, b in zip(keyframes[1:], keyframes[:-1], strict=True)]
    return states, fresh


def test_odometry_comes_with_every_imu_sample(drive: Recording, odometry: Any) -> None:
    times = [s.t_ns for s in odometry[0]]
    assert drive.imu is not None
    assert times == drive.imu.t_ns[-len(times) :].tolist()


def test_live_gives_what_replay_gives(drive: Recording) -> None:
    """Encoder angles, velocity and class of the fixes, commands: the same bits at every keyframe."""
    assert drive.wheels is not None
    assert drive.wheels.angle_rad is not None
    assert drive.gnss is not None
    assert drive.gnss.velocity_enu_mps is not None
    first = replay(drive).estimate.trajectory
    config = EstimatorConfig(load_vehicle("elevate").rig(), "elevate")
    states: list[State] = []
    estimator = Estimator(config, on_state=states.append)
    run(estimator, drive.messages(), lambda _: None)
    estimator.finish()
    np.testing.assert_array_equal(first.t_ns, [s.t_ns for s in states])
    np.testing.assert_array_equal(first.position_m, [s.position_m for s in states])
    np.testing.assert_array_equal(first.covariance, [s.covariance for s in states])


def test_odometry_is_continuous_between_keyframes(odometry: Any) -> None:
    """Between keyframes a step is velocity times time; at a keyframe its correction, some centimetres."""
    states, fresh = odometry
    p, v = (np.array([getattr(s, name) for s in states]) for name in ("position_m", "velocity_mps"))
    dt = np.diff([s.t_ns for s in states]) * 1e-9
    jump = np.linalg.norm(np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt[:, None], axis=1)
    at = np.array(fresh)
    assert at.any()
    assert jump[~at].max() < 1e-5
    assert jump[at].max() < 0.1


def test_odometry_follows_the_truth(drive: Recording, odometry: Any) -> None:
    states, _ = odometry
    assert drive.truth is not None
    truth = drive.truth.positions_at(np.array([s.t_ns for s in states]))
    off = np.array([s.position_m for s in states]) - truth
    assert np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()) < 0.3
    for state in states[::50]:
        assert np.linalg.eigvalsh(state.covariance).min() > 0.0
        assert np.linalg.eigvalsh(state.twist_covariance).min() > 0.0


def test_the_transition_is_the_derivative_of_the_motion() -> None:
    """Against central differences of R_j = R_i dR, p_j = p_i + v dt + R_i dp, v_j = v + R_i dv."""
    import gtsam

    rng = np.random.default_rng(1)
    start, turn = (gtsam.Rot3.Expmap(rng.normal(0.0, s, 3)) for s in (1.0, 0.05))
    dp, dv, v, dt = rng.normal(0.0, 0.1, 3), rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, 3), 0.2

    def end(x: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        R = start.compose(gtsam.Rot3.Expmap(x[:3]))
        p, speed = start.matrix() @ x[3:6], v + x[6:9]
        return R.compose(turn), p + speed * dt + R.matrix() @ dp, speed + R.matrix() @ dv

    R_j = end(np.zeros(9))[0]
    F, _ = transition(start.matrix(), R_j.matrix(), dp, dv, dt)
    for i in range(9):
        step = np.zeros(9)
        step[i] = 1e-6
        (Ra, pa, va), (Rb, pb, vb) = end(step), end(-step)
        column = [gtsam.Rot3.Logmap(Rb.between(Ra)), R_j.matrix().T @ (pa - pb), va - vb]
        np.testing.assert_allclose(F[:9, i], np.concatenate(column) / 2e-6, atol=1e-6)
