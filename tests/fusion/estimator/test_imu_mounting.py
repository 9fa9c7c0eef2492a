"""A twin's IMU that is mounted turned about z: learned and corrected, carried on by the vehicle file."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.writers import write_log_folder
from terrafusion.fusion.calibration.mounting import ANY_ANGLE_RAD, Angle
from terrafusion.fusion.config.estimator_config import EstimatorConfig, EstimatorOptions
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.learned_numbers import NumberAfterDrive
from terrafusion.fusion.inputs.streams import turned
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.outputs.robot_file import write_robot
from terrafusion.fusion.replay import replay
from terrafusion.fusion.sensor_calibration import calibrate_sensors
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

ANGLE_RAD = math.radians(120.0)


def mounted(run: Recording, angle_rad: float) -> Recording:
    """The drive as an IMU mounted at an angle about z measures it."""
    assert run.imu is not None
    gyro, accel = (
        np.array([turned(row, -angle_rad) for row in rows])
        for rows in (run.imu.gyro_radps, run.imu.accel_mps2)
    )
    return dataclasses.replace(run, imu=dataclasses.replace(run.imu, gyro_radps=gyro, accel_mps2=accel))


@pytest.fixture(scope="module")
def run() -> Recording:
    lap = (
        DriveSegment(5.0, 1.0),
        DriveSegment(5.0, 0.6, 0.5),
        DriveSegment(4.0, 1.4),
        DriveSegment(6.0, 0.7, -0.5),
    )
    route = (RouteLeg("asphalt"),)
    laps = Scenario("laps", 82.0, route=route, drive=(DriveSegment(2.0), *lap, *lap, *lap, *lap))
    return mounted(simulate(laps, seed=7), ANGLE_RAD)


def learned(numbers: tuple[NumberAfterDrive, ...]) -> NumberAfterDrive:
    return next(number for number in numbers if number.state == "imu_yaw_rad")


def test_a_turned_imu_is_found_and_corrected(run: Recording) -> None:
    outage = [Outage(45.0, 30.0)]
    found = replay(run, mode="fixed", outages=outage)
    without = replay(run, mode="fixed", outages=outage, settings=EstimatorOptions(self_calibrate=False))
    angle = learned(found.learned)
    assert angle.corrects
    assert abs(angle.value - ANGLE_RAD) < 3.0 * angle.sigma
    drifts = [result.scores.outages[0].end_error_m or 0.0 for result in (found, without)]
    assert drifts[0] < 0.5
    assert drifts[1] > 3.0 * drifts[0]


def test_the_file_carries_the_angle_on_and_makes_the_drive_good(run: Recording, tmp_path: Path) -> None:
    found, straight = (calibrate_sensors([r], "elevate") for r in (run, mounted(run, -ANGLE_RAD)))
    assert found.numbers["imu_yaw_rad"].observed
    delay, right = (sensors.numbers["gnss_delay_s"] for sensors in (found, straight))
    assert delay.value == pytest.approx(right.value, abs=0.005), "not learned with the wrong angle"
    assert abs(delay.value) < delay.sigma
    file = write_robot(tmp_path / "my_robot.yaml", found)
    robot = load_vehicle(file)
    estimator = Estimator(EstimatorConfig(robot.rig(), robot.name))
    assert estimator.imu.mounting_rad == pytest.approx(ANGLE_RAD, abs=math.radians(5.0))
    blind = dataclasses.replace(run, truth=None)
    assert "refuted" in replay(blind, vehicle="elevate", mode="fixed").verdict.lines()[-1]
    for known in (run, blind):
        assert replay(known, vehicle=file, mode="fixed").verdict.value == "good"


@pytest.mark.parametrize(("sigma", "of_yaw", "of_tilt"), [(None, ANY_ANGLE_RAD, 0.1), (0.2, 0.2, 0.2)])
def test_assumed_angles_are_where_learning_begins(sigma: float | None, of_yaw: float, of_tilt: float) -> None:
    rig = load_vehicle("elevate").rig()
    yaw, roll = KnownNumber(1.5, "assumed", sigma), KnownNumber(0.05, "assumed", sigma)
    known = dataclasses.replace(rig.known, imu_yaw_rad=yaw, imu_roll_rad=roll)
    estimator = Estimator(EstimatorConfig(dataclasses.replace(rig, known=known), "elevate"))
    mounting = estimator.learned.mounting
    assert mounting.known == Angle(1.5, of_yaw)
    assert mounting.level.known == (Angle(0.05, of_tilt), Angle(0.0, 0.1))
    assert estimator.imu.mounting_rad == 1.5


@pytest.mark.usefixtures("no_report")
def test_a_corrected_imu_is_no_reason_for_doubt_and_none_to_refuse(
    run: Recording, tmp_path: Path, terrafusion
) -> None:
    """A quarter turn, which the log checks call an error; with `--calibrate` the angle is not learned."""
    turn_rad = 0.5 * math.pi
    log = write_log_folder(mounted(run, turn_rad - ANGLE_RAD), tmp_path / "log")
    assert terrafusion("inspect", log).status == 1
    outcome = terrafusion("replay", log, "--mode", "fixed", "--out", tmp_path / "out")
    assert outcome.status == 0, outcome.err
    verdict = outcome.out.partition(f"{run.name}:")[0]
    assert "point forward" not in verdict
    line = next(line for line in outcome.out.splitlines() if line.startswith("log check, imu: x does not"))
    assert line.endswith("deg); self-calibration corrects it")
    refused = terrafusion("replay", log, "--calibrate", "--out", tmp_path / "calibrated")
    assert refused.refused("x does not point forward", "--apply-fixes")
