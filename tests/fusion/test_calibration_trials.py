"""Faults that the calibration trials put into a vehicle file, and what doubt does to GNSS velocities."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.recording import Recording
from terrafusion.fusion.graph.key_state import ANTENNA, CALIBRATION, DIM, dim_of
from terrafusion.fusion.inputs.gnss import _calibration_doubt_mps
from terrafusion.fusion.replay import choose_vehicle
from terrafusion.fusion.scores.calibration_trials import (
    GROUND,
    IMU_YAW_RAD,
    TRACK_SHARE,
    VEHICLE,
    effective_yaw_scale,
    exciting,
    faults,
    narrow_track,
)
from terrafusion.twin.simulate import simulate
from terrafusion.twin.vehicle import load_vehicle


@pytest.fixture(scope="module")
def drive() -> Recording:
    short = dataclasses.replace(exciting(), duration_s=25.0)
    return simulate(short, vehicle=load_vehicle(VEHICLE), terrain=GROUND, seed=1)


def test_each_fault_is_what_its_state_is_to_find(drive: Recording) -> None:
    made = {fault.state: fault for fault in faults()}
    assert set(made) < set(CALIBRATION)
    right = load_vehicle(VEHICLE).rig()

    def told(state: str):
        return choose_vehicle(made[state].made(drive), None)[0].rig()

    radius = told("radius_scale").wheel_radius_m
    assert radius * (1.0 + made["radius_scale"].expected) == pytest.approx(right.wheel_radius_m)
    moved = np.array(right.sensors.gnss.antenna_m) - np.array(told("antenna_y_m").sensors.gnss.antenna_m)
    assert moved == pytest.approx([0.0, made["antenna_y_m"].expected, 0.0])
    for state, channel in (("wheel_delay_s", "wheels"), ("gnss_delay_s", "gnss")):
        late = getattr(made[state].made(drive), channel).t_ns - getattr(drive, channel).t_ns
        assert late * 1e-9 == pytest.approx(made[state].expected)


def test_the_small_rotation_brings_a_turned_imu_back(drive: Recording) -> None:
    fault = next(fault for fault in faults() if fault.state == "imu_yaw_rad")
    turned = fault.made(drive).imu
    assert turned is not None
    assert drive.imu is not None
    back = turned.accel_mps2 + np.cross([0.0, 0.0, fault.expected], turned.accel_mps2)
    assert np.abs(back - drive.imu.accel_mps2).max() < IMU_YAW_RAD**2 * np.abs(drive.imu.accel_mps2).max()
    assert turned.gyro_radps[:, 2] == pytest.approx(drive.imu.gyro_radps[:, 2])


def test_a_narrow_track_lowers_the_yaw_scale_by_its_share(drive: Recording) -> None:
    track = load_vehicle(VEHICLE).rig().track_m
    rig = choose_vehicle(narrow_track(drive), None)[0].rig()
    right, narrow = effective_yaw_scale(drive, track), effective_yaw_scale(drive, rig.track_m)
    assert right < 0.0  # skid steering turns less than its wheels say
    assert 1.0 + narrow == pytest.approx((1.0 + right) * (1.0 - TRACK_SHARE))


def test_doubt_of_the_antenna_counts_only_in_turns_and_only_when_calibrated() -> None:
    turning, straight, rest = np.array([0.0, 0.0, 0.5]), np.zeros(3), np.zeros(3)
    P = np.zeros((DIM, DIM))
    P[ANTENNA, ANTENNA] = np.diag([0.03**2, 0.04**2])
    assert _calibration_doubt_mps(P, turning, rest) == pytest.approx(0.5 * 0.05)
    assert _calibration_doubt_mps(P, straight, rest) == 0.0
    plain = dim_of(calibrate=False)
    assert _calibration_doubt_mps(P[:plain, :plain], turning, rest) == 0.0
