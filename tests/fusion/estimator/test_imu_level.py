"""A twin's IMU that is tilted: learned and levelled live, in a batch and for the vehicle file."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.learned_numbers import NumberAfterDrive
from terrafusion.fusion.outputs.robot_file import write_robot
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.fusion.sensor_calibration import calibrate_sensors
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

ROLL, PITCH = math.radians(-3.0), math.radians(4.0)


def drive(slope_deg: float) -> Recording:
    lap = (
        DriveSegment(5.0, 1.5),
        DriveSegment(4.0, 1.2, 0.5),
        DriveSegment(4.0, 1.5),
        DriveSegment(3.0, 1.2, -0.6),
    )
    route = (RouteLeg("asphalt"),)
    laps = Scenario("laps", 82.0, route=route, drive=(DriveSegment(2.0), *5 * lap), slope_deg=slope_deg)
    return simulate(laps, seed=3)


def mounted(run: Recording, yaw_rad: float) -> Recording:
    """The drive as a tilted IMU measures it."""
    assert run.imu is not None
    R = gtsam.Rot3.RzRyRx(ROLL, PITCH, yaw_rad).matrix()  # turns its readings into body axes
    imu = dataclasses.replace(run.imu, gyro_radps=run.imu.gyro_radps @ R, accel_mps2=run.imu.accel_mps2 @ R)
    return dataclasses.replace(run, imu=imu)


@pytest.fixture(scope="module")
def tilted() -> Recording:
    return mounted(drive(6.0), 0.0)


def level(result: ReplayResult) -> tuple[NumberAfterDrive, NumberAfterDrive]:
    """Learned roll and pitch."""
    numbers = {number.state: number for number in result.learned}
    return numbers["imu_roll_rad"], numbers["imu_pitch_rad"]


def off_level_deg(result: ReplayResult, since_s: float) -> np.ndarray:
    """Largest errors (2,) of pitch and roll from a time on."""
    path, truth = result.estimate.trajectory, result.recording.truth
    assert truth is not None
    late = path.t_ns >= path.t_ns[0] + since_s * 1e9
    i = np.searchsorted(truth.t_ns, path.t_ns[late]).clip(max=len(truth.t_ns) - 1)
    ours, true = (
        Rotation.from_quat(q).as_euler("ZYX", True)[:, 1:]
        for q in (path.quaternion[late], truth.quaternion[i])
    )
    return np.abs(ours - true).max(axis=0)


def test_a_tilted_imu_is_found_and_levelled(tilted: Recording) -> None:
    found = replay(tilted, mode="fixed")
    for number, truth in zip(level(found), (ROLL, PITCH), strict=True):
        assert number.corrects
        assert abs(number.value - truth) < 3.0 * number.sigma
    assert off_level_deg(found, 75.0).max() < 1.0
    (note,) = (note for note in found.estimate.notes if "the IMU is tilted" in note)
    assert "calibrate LOG --sensors" in note


def test_the_tilt_of_an_imu_that_points_backwards_is_found_by_its_own_axes() -> None:
    yaw_rad, robot = math.radians(-150.0), load_vehicle("elevate")
    known = dataclasses.replace(robot.robot, imu_yaw_rad=KnownNumber(yaw_rad, "measured", 0.02))
    found = replay(
        mounted(drive(0.0), yaw_rad), mode="fixed", vehicle=dataclasses.replace(robot, robot=known)
    )
    for number, truth in zip(level(found), (ROLL, PITCH), strict=True):
        assert number.corrects
        assert abs(number.value - truth) < 3.0 * number.sigma
    assert off_level_deg(found, 75.0).max() < 1.0


def test_a_batch_is_levelled_from_its_start(tilted: Recording) -> None:
    found = replay(tilted, mode="fixed", batch=True)
    assert all(number.corrects for number in level(found))
    assert off_level_deg(found, 0.0).max() < 1.0


def test_a_level_imu_on_a_slope_stays_as_it_is() -> None:
    for number in level(replay(drive(10.0), mode="fixed")):
        assert (number.value, number.corrects) == (0.0, False)
        assert number.sigma < number.prior_sigma


def test_the_file_carries_the_tilt_on(tilted: Recording, tmp_path: Path) -> None:
    found = calibrate_sensors([tilted], "elevate")
    file = write_robot(tmp_path / "my_robot.yaml", found)
    robot = load_vehicle(file)
    assert robot.robot.imu_pitch_rad is not None
    assert robot.robot.imu_pitch_rad.known == "calibrated"
    estimator = Estimator(EstimatorConfig(robot.rig(), robot.name))
    assert estimator.imu.level is not None
    np.testing.assert_allclose(
        Rotation.from_matrix(estimator.imu.level).as_euler("ZYX")[1:], [PITCH, ROLL], atol=math.radians(1.0)
    )
