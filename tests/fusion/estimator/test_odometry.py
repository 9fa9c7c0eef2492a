"""The newest state carried to the newest sample of the IMU."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.key_states import key_state_of
from terrafusion.fusion.estimator.odometry import Propagator
from terrafusion.fusion.graph.key_state import IMU_ROTATION, LINEAR, NAV, KeyState
from terrafusion.fusion.inputs.streams import ImuStream
from terrafusion.twin.model.vehicle import load_vehicle

ROTATION = np.array([0.01, -0.03, 0.02])


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    """At rest, level, started at a given place."""
    made = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", calibrate=True))
    made.set_start([0.0, 0.0, 0.0], 0.0)
    for i in range(200):
        made.add_wheels(i * 10**7, 0.0, 0.0)
        made.add_imu(i * 10**7, [0.0, 0.0, 0.0], [0.0, 0.0, GRAVITY_MPS2])
    return made


def turned(state: State) -> State:
    """The same robot whose IMU is mounted `ROTATION` off."""
    linear = np.zeros(len(LINEAR))
    linear[IMU_ROTATION.start - NAV.stop : IMU_ROTATION.stop - NAV.stop] = ROTATION
    return dataclasses.replace(
        state, linear=linear, velocity_mps=np.zeros(3), gyro_bias_radps=np.zeros(3),
        accel_bias_mps2=np.zeros(3), quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
    )  # fmt: skip


def test_a_mounting_that_is_known_moves_nothing(estimator: Estimator) -> None:
    state = turned(estimator.latest())
    body = np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, GRAVITY_MPS2])
    gyro, accel = (reading - np.cross(ROTATION, reading) for reading in body)
    imu = ImuStream()
    for i in range(21):
        imu.add(state.t_ns + i * 10**7, gyro, accel)
    covariance = 1e-4 * np.eye(estimator.chain.dim)
    found = Propagator(estimator._preintegrator).carry(state, covariance, imu, estimator.weights.noise)
    assert np.linalg.norm(found.velocity_mps) < 0.2 * GRAVITY_MPS2 * 2.0 * np.sum(ROTATION**2)
    assert found.angular_velocity_radps == pytest.approx(body[0], abs=2.0 * 0.3 * np.sum(ROTATION**2))


def test_rates_and_readings_are_inverse_to_first_order() -> None:
    rng = np.random.default_rng(0)
    linear = np.zeros(len(LINEAR))
    linear[IMU_ROTATION.start - NAV.stop : IMU_ROTATION.stop - NAV.stop] = ROTATION
    bias = gtsam.imuBias.ConstantBias(rng.normal(size=3), 0.01 * rng.normal(size=3))
    key = KeyState(gtsam.Pose3(), np.zeros(3), bias, linear)
    gyro, accel = rng.normal(size=3), rng.normal(size=3)
    assert key.reading(key.rate(gyro)) == pytest.approx(gyro, abs=2.0 * np.sum(ROTATION**2))
    seen = key.bias_seen(gyro, accel)
    assert key.rate(gyro) == pytest.approx(gyro - seen.gyroscope())
    assert key.specific_force(accel) == pytest.approx(accel - seen.accelerometer())


def test_a_gyro_of_one_axis_tells_no_other_rate() -> None:
    inputs = SensorConfig(imu="gyro_z")
    made = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", inputs=inputs))
    made.set_start([0.0, 0.0, 0.0], 0.0)
    for i in range(205):
        made.add_wheels(i * 10**7, 0.0, 0.0)
        made.add_imu(i * 10**7, [np.nan, np.nan, 0.1])
    assert made.odometry().t_ns > made.latest().t_ns
    assert np.isfinite(made.odometry().angular_velocity_radps).all()


@pytest.fixture(scope="module")
def turning() -> Estimator:
    """A robot of a gyro of one axis, that drives at 1.5 m/s and turns at 0.8 rad/s."""
    inputs = SensorConfig(imu="gyro_z")
    made = Estimator(EstimatorConfig(load_vehicle("elevate").rig(), "elevate", inputs=inputs))
    made.set_start([0.0, 0.0, 0.0], 0.0)
    half = 0.4 * load_vehicle("elevate").body.track_m
    for i in range(409):
        made.add_wheels(i * 10**7, 1.5 - half, 1.5 + half)
        made.add_imu(i * 10**7, [np.nan, np.nan, 0.8])
    return made


def test_without_an_accelerometer_the_velocity_turns_with_the_robot(turning: Estimator) -> None:
    state, now = turning.latest(), turning.odometry()
    assert now.t_ns - state.t_ns > 5 * 10**7
    before, after = (key_state_of(one) for one in (state, now))
    assert after.rotation.T @ after.velocity == pytest.approx(before.rotation.T @ before.velocity, abs=0.01)


def test_the_rate_is_that_of_the_robot_as_in_a_keyframe(turning: Estimator) -> None:
    imu = ImuStream()
    imu.mounting_rad, imu.turn_scale = np.pi, 0.1
    state = dataclasses.replace(turned(turning.latest()), linear=np.zeros(len(LINEAR)))
    for i in range(10):
        imu.add(state.t_ns + i * 10**7, [0.02, 0.0, 0.2], [0.0, 0.0, GRAVITY_MPS2])
    covariance = 1e-4 * np.eye(turning.chain.dim)
    propagator = Propagator(turning._preintegrator)
    for _ in range(2):
        found = propagator.carry(state, covariance, imu, turning.weights.noise)
        assert found.angular_velocity_radps == pytest.approx([-0.02, 0.0, 0.22])


def test_samples_are_levelled_by_what_is_known_when_they_are_used() -> None:
    imu = ImuStream()
    for i in range(10):
        imu.add(i * 10**7, [0.0, 0.0, 0.2], [0.0, 0.0, GRAVITY_MPS2])
    imu.level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    assert imu.segments(0, 10**7)[0].gyro_radps == pytest.approx([0.0, -0.2, 0.0])
    _, gyro, accel = imu.window(0, 10**7)
    assert gyro[0] == pytest.approx([0.0, -0.2, 0.0])
    assert accel[0] == pytest.approx([0.0, -GRAVITY_MPS2, 0.0])
