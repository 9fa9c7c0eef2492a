"""The log checks know how the vehicle file says that the IMU is mounted."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.robot import KnownNumber, SensorNumbers
from terrafusion.datasets.core.sensors import Rig
from tests.datasets.checks.test_physical_faults import RADIUS_M, imu_with, level, lively_drive


@pytest.mark.parametrize("angles_rad", [(0.0, 0.0, 0.5 * np.pi), (0.0, 0.0, -0.4), (0.7, -0.2, 0.0)])
def test_an_imu_mounted_as_the_vehicle_file_says_is_no_finding(
    angles_rad: tuple[float, ...], husky_rig: Rig
) -> None:
    R = Rotation.from_euler("xyz", angles_rad).as_matrix()
    log = imu_with(gyro_radps=lambda g: g @ R, accel_mps2=lambda a: a @ R)(lively_drive())
    rig = dataclasses.replace(husky_rig, wheel_radius_m=RADIUS_M, sensors=level(husky_rig))
    assert {finding.channel for finding in run_checks(log, rig)} == {"imu"}
    names = ("imu_roll_rad", "imu_pitch_rad", "imu_yaw_rad")
    known = {name: KnownNumber(a, "measured") for name, a in zip(names, angles_rad, strict=True)}
    assert run_checks(log, dataclasses.replace(rig, known=SensorNumbers(**known))) == []


@pytest.mark.parametrize("yaw_rad", [0.0, -0.4])
def test_a_gyro_of_one_axis_is_enough_to_see_where_the_imu_points(yaw_rad: float, husky_rig: Rig) -> None:
    """Only z of the gyro is measured, and the vehicle file has its angle about z."""
    turn = Rotation.from_euler("z", 0.5 * np.pi + yaw_rad).as_matrix()
    log = imu_with(
        gyro_radps=lambda g: np.where([True, True, False], np.nan, g), accel_mps2=lambda a: a @ turn
    )(lively_drive())
    known = SensorNumbers(imu_yaw_rad=KnownNumber(yaw_rad, "measured"))
    rig = dataclasses.replace(husky_rig, wheel_radius_m=RADIUS_M, sensors=level(husky_rig), known=known)
    assert [finding.code for finding in run_checks(log, rig) if finding.channel == "imu"] == ["imu-forward"]
