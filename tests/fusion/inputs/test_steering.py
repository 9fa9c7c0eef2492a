"""Steering angles in the estimator: the stream, the turn with its scale and zero, a log without a gyro."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import yaw_of
from terrafusion.datasets.core.messages import SteeringSample
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.core.sensors import Rig, SteeringSpec
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.config.sensor_config import SensorConfig, sensor_config_of
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.steering import SteeredTurn, front_ratio, policy_of
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import replay
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

S = 10**9
SPEC = SteeringSpec()


def steered(drive: str = "ackermann") -> VehicleParams:
    return with_overrides(load_vehicle("elevate"), Overrides(drive=drive))


def rig(drive: str = "ackermann") -> Rig:
    return steered(drive).rig()


def test_the_curvature_is_that_of_the_bicycle_model() -> None:
    stream = SteeringStream(rig())
    for k in range(11):
        stream.add(k * S // 10, 0.05 * k, -0.02 * k)
    expected = (np.tan(0.25) - np.tan(-0.1)) / rig().wheelbase_m
    assert stream.curvature_per_m(4 * S // 10, 6 * S // 10) == pytest.approx(expected, rel=0.01)
    assert stream.curvature_per_m(-3 * S, -2 * S) is None
    assert stream.curvature_per_m(5 * S, 6 * S) is None  # the last angle is too old
    stream.add(2 * S, 1.6)
    assert (stream.impossible, stream.t_ns[-1]) == (1, S)
    with pytest.raises(DataError, match="steering"):
        stream.add(2.5, 0.1)  # type: ignore[arg-type]


def increment(distance_m: float, yaw_rad: float) -> WheelIncrement:
    return WheelIncrement(np.array([distance_m, 0.0, 0.0]), np.full(4, 0.01), distance_m, 0.0, yaw_rad)


def test_scale_and_zero_are_found_within_their_sigmas() -> None:
    """200 trials of a minute: the normalised errors of scale and zero have the size of their covariance."""
    own, squares, widths = rig(), [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        turn = SteeredTurn(own, SPEC)
        first = turn.covariance.copy()
        truth = rng.normal(size=2) * np.sqrt(np.diag(first))
        bias = 1e-3 * rng.normal()
        for k in range(600):
            angle = 0.8 * np.sin(k / 25.0 + seed)
            true = (1.0 + truth[0]) * angle + truth[1]
            turn.applied(increment(0.08, 0.08 * true + 0.1 * bias), angle, 0.1, 1e-3)
        error = turn.mean - truth
        squares.append(error @ np.linalg.solve(turn.covariance, error))
        widths.append(np.sqrt(np.diag(turn.covariance) / np.diag(first)))
    assert np.mean(squares) < 2.0 + 4.0 * np.sqrt(4.0 / 200)  # not too narrow
    assert np.mean(widths, axis=0).max() < 0.9


def test_the_turn_has_a_sigma_that_covers_what_is_unknown() -> None:
    own = rig()
    fresh = SteeredTurn(own, SPEC)
    straight, bend = (fresh.applied(increment(0.1, 0.1 * k), k, 0.1, 1e-3) for k in (0.0, 1.0))
    assert bend.turn_rad == pytest.approx(0.1, abs=0.02)
    assert bend.sigma[3] > straight.sigma[3] > 0.0
    assert bend.displacement_m[1] == pytest.approx(0.5 * own.wheelbase_m * 0.1)
    assert np.isinf(fresh.applied(increment(0.1, 0.0), None, 0.1, 1e-3).sigma[3])
    middle = SteeredTurn(rig("four_wheel_steer"), SPEC).applied(increment(0.1, 0.1), 1.0, 0.1, 1e-3)
    assert middle.displacement_m[1] == 0.0


@pytest.mark.parametrize(("drive", "moved"), [("four_wheel_steer", 0.3), ("ackermann", 0.0)])
def test_wheels_that_all_turn_to_one_side_move_the_robot_aslant(drive: str, moved: float) -> None:
    own = rig(drive)
    stream = SteeringStream(own)
    for k in range(3):
        stream.add(k * S // 10, 0.3, moved)
    out = SteeredTurn(own, SPEC).between(0, S // 10, increment(0.1, 0.0), stream, np.zeros((30, 30)))
    assert out.displacement_m[:2] == pytest.approx(0.1 * np.array([np.cos(moved), np.sin(moved)]))
    assert out.distance_m == pytest.approx(0.1 * np.cos(moved))


def test_a_steered_robot_does_not_skid_to_turn() -> None:
    policy = load_policy()
    assert policy_of(load_vehicle("elevate").rig(), policy) is policy
    changed = policy_of(rig(), policy)
    assert {noise.yaw_scale_mean for noise in changed.classes.values()} == {0.0}


def test_tyres_slip_little_on_a_grade_unless_the_ground_is_known() -> None:
    policy = load_policy()
    changed = policy_of(rig(), policy)
    assert changed.fixed.slip_at(0.1) - changed.fixed.slip_mean == pytest.approx(0.005)
    assert changed.slips()[2] == pytest.approx(policy.slips()[2])
    firm = dataclasses.replace(policy, fixed=dataclasses.replace(policy.fixed, slip_per_grade=0.01))
    assert policy_of(rig(), firm).fixed.slip_per_grade == 0.01


@pytest.mark.parametrize(
    ("drive", "known", "yaw", "scale"),
    [
        ("differential", None, "gyro", 0.0),
        ("differential", 0.9, "gyro", -0.1),
        ("differential", 0.9, "wheels", 0.0),
        ("skid_steer", 0.7, "gyro", -0.3),
        ("ackermann", None, "gyro", 0.0),
    ],
)
def test_wheels_that_do_not_skid_or_are_known_turn_the_robot_by_their_factor(
    drive: str, known: float | None, yaw: str, scale: float
) -> None:
    """The track of wheels that are the source of yaw holds the factor already."""
    factor = None if known is None else KnownNumber(known, "measured")
    plain = load_vehicle("elevate").rig()
    robot = dataclasses.replace(plain, drive=drive, known=dataclasses.replace(plain.known, yaw_factor=factor))
    for noise in (*(changed := policy_of(robot, load_policy(), yaw)).classes.values(), changed.fixed):
        assert noise.yaw_scale_mean == pytest.approx(scale)
        assert noise.yaw_scale_sigma == 0.15


def test_a_steering_wheel_is_divided_by_its_ratio() -> None:
    own = dataclasses.replace(rig(), steering=dataclasses.replace(SPEC, ratio=20.0))
    estimator = Estimator(EstimatorConfig(own, inputs=SensorConfig(steered=True)))
    estimator.add(SteeringSample(0, np.array([2.0]), ("steering_wheel",)))
    assert estimator.steering.per_m == [pytest.approx(np.tan(0.1) / own.wheelbase_m)]
    assert front_ratio(rig()) == 16.0
    skidding = Estimator(EstimatorConfig(load_vehicle("elevate").rig()))
    skidding.add(SteeringSample(0, np.array([0.1]), ("angle",)))
    assert skidding.steering.t_ns == []


def test_without_a_gyro_the_steering_turns_the_path() -> None:
    """One speed for the whole robot and no IMU: only the steering shows the bends."""
    bends = (DriveSegment(30.0, v_mps=0.8, yaw_rate_amplitude_radps=0.4, period_s=7.0),)
    scenario = Scenario("bends", 30.0, drive=bends, route=(RouteLeg("asphalt"),))
    drive = dataclasses.replace(simulate(scenario, vehicle=steered(), seed=3), imu=None, gnss=None)
    assert drive.wheels is not None
    speed = dataclasses.replace(
        drive.wheels, names=("speed",), unit="mps", angle_rad=None,
        speed=drive.wheels.speed.mean(axis=1, keepdims=True) * steered().wheel.radius_m,
    )  # fmt: skip
    drive = dataclasses.replace(drive, wheels=speed)
    assert sensor_config_of(drive, None).yaw == "steering"
    with pytest.raises(DataError, match="heading"):
        sensor_config_of(dataclasses.replace(drive, steering=None), None)
    result = replay(drive, vehicle=steered(), findings=())
    path = result.estimate.trajectory.position_m
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum() == pytest.approx(24.0, rel=0.1)
    yaw = np.unwrap(np.arctan2(*np.diff(path[::5, 1::-1], axis=0).T))
    assert np.ptp(yaw) > 0.4  # the wave of the heading, 2 x 0.4 x 7 / 2 pi
    assert any("steering angles" in note for note in result.estimate.notes)


def test_a_late_angle_does_not_turn_back_the_clock_of_all_sensors() -> None:
    estimator = Estimator(EstimatorConfig(rig(), "elevate", inputs=SensorConfig(steered=True)))
    estimator.set_start([0.0, 0.0, 0.0], 0.0)
    for i in range(400):
        estimator.add_wheels(i * S // 100, 1.0, 1.0)
        estimator.add_imu(i * S // 100, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])
        if i % 80 == 0:
            estimator.add_steering(i * S // 100, 0.0)
    newest, known = estimator.newest.t_ns, list(estimator.steering.t_ns)
    estimator.add_steering(newest - 3 * S // 2, 0.0)
    assert estimator.newest.t_ns == newest
    assert estimator.steering.t_ns == known


def test_where_the_imu_dies_in_a_bend_the_steering_turns_the_robot() -> None:
    own = rig()
    estimator = Estimator(EstimatorConfig(own, inputs=SensorConfig(sides=False, gnss=False, steered=True)))
    estimator.set_start([0.0, 0.0, 0.0], 0.0)
    rate = np.tan(0.05) / own.wheelbase_m
    for i in range(2000):
        t_ns = i * S // 100
        estimator.add_wheels(t_ns, 1.0, 1.0)
        estimator.add_steering(t_ns, 0.05 if i < 500 else -0.05)
        if i < 400:
            estimator.add_imu(t_ns, [0.0, 0.0, rate], [0.0, rate, 9.80665])
    state = estimator.latest()
    assert state is not None
    assert state.t_ns > 19 * S
    assert yaw_of(state.quaternion) == pytest.approx(rate * (5.0 - 1e-9 * state.t_ns + 5.0), abs=0.02)
    assert state.angular_velocity_radps[2] == pytest.approx(-rate, abs=0.01)
    assert estimator._motion._turn is not None
    assert np.abs(estimator._motion._turn.mean).max() < 0.01
