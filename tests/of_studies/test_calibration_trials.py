"""Faults that the calibration trials put into a vehicle file, and that a calibration finds them."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimator.gnss import keyframe_of
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import SURGE_SPEED_MPS, wheel_increment
from terrafusion.fusion.graph.key_state import CALIBRATION, LINEAR, KeyState
from terrafusion.fusion.graph.slow_states import CALIBRATION_SIGMA
from terrafusion.fusion.graph.wheel_factor import WheelIncrement, linearised, slip_of
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate
from tests.studies.calibration_trials import (
    GROUND,
    IMU_YAW_RAD,
    TRACK_SHARE,
    VEHICLE,
    calibrated,
    effective_yaw_scale,
    exciting,
    faults,
    found,
    narrow_track,
    surge_slip,
)


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


@pytest.fixture(scope="module")
def excited() -> dict[str, Recording]:
    return {g: simulate(exciting(g), vehicle=load_vehicle(VEHICLE), seed=0) for g in (GROUND, "loose_sand")}


@pytest.mark.parametrize(
    ("ground", "state"),
    [
        (GROUND, "antenna_x_m"),
        (GROUND, "wheel_delay_s"),
        (GROUND, "gnss_delay_s"),
        ("loose_sand", "antenna_x_m"),
        ("loose_sand", "wheel_delay_s"),
    ],
)
def test_what_is_wrong_is_found_within_three_sigma(
    excited: dict[str, Recording], ground: str, state: str
) -> None:
    fault = next(fault for fault in faults() if fault.state == state)
    value, sigma = found(calibrated(fault.made(excited[ground])), state)
    assert abs(value - fault.expected) < 3.0 * sigma
    assert sigma < 0.5 * CALIBRATION_SIGMA[state]


def test_the_slip_that_acceleration_asks_for_is_measured_as_it_was_made(drive: Recording) -> None:
    share, v0, radius = 0.2, 0.4, load_vehicle(VEHICLE).wheel.radius_m
    truth, wheels = drive.truth, drive.wheels
    assert truth is not None
    assert truth.twist_body is not None
    assert wheels is not None

    def speed(t_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = (t_ns - truth.t_ns[0]) * 1e-9
        return 1.0 * t - 0.4 * np.cos(t), 1.0 + 0.4 * np.sin(t), 0.4 * np.cos(t)

    twist = np.zeros_like(truth.twist_body)
    _, v, a = speed(truth.t_ns)
    twist[:, 0] = v - share * a / GRAVITY_MPS2 * (v + v0)
    angle = np.tile(speed(wheels.t_ns)[0][:, None] / radius, (1, wheels.speed.shape[1]))
    made = dataclasses.replace(
        drive,
        truth=dataclasses.replace(truth, twist_body=twist),
        wheels=dataclasses.replace(wheels, angle_rad=angle),
    )
    assert surge_slip(made) == pytest.approx((share, v0), rel=0.02)


def test_slip_told_holds_what_acceleration_asks_for() -> None:
    linear = np.zeros(len(LINEAR))
    linear[0], linear[-1] = 0.05, 0.3
    rolling, standing = (
        WheelIncrement(np.zeros(3), np.ones(4), distance, 0.0, surge_m=0.002) for distance in (0.1, 0.0)
    )
    assert slip_of(linear, rolling) == pytest.approx(0.05 + 0.3 * 0.002 / 0.1)
    assert slip_of(linear, standing) == 0.05


@pytest.mark.parametrize("forwards", [1.0, -1.0])
def test_wheels_that_gain_speed_are_expected_to_outrun_the_robot(forwards: float) -> None:
    row, pieces = load_policy().classes[GROUND], [ImuSegment(0.1, np.zeros(3), np.zeros(3))]
    travelled, change = (forwards * 0.1, forwards * 0.1), forwards * 0.2

    def increment(surging: bool) -> WheelIncrement:
        return wheel_increment(travelled, pieces, 0.0, 0.5, 0.0, row, change, surging)

    assert increment(False).surge_m == 0.0
    wanted = forwards * (0.2 / 0.1) / GRAVITY_MPS2 * (0.1 + SURGE_SPEED_MPS * 0.1)
    assert increment(True).surge_m == pytest.approx(wanted)
    linear = np.zeros(len(LINEAR))
    linear[-1] = 0.5
    start, there = (
        KeyState(
            gtsam.Pose3(gtsam.Rot3(), np.array([x_m, 0.0, 0.0])),
            np.zeros(3),
            gtsam.imuBias.ConstantBias(),
            linear,
        )
        for x_m in (0.0, forwards * 0.1 - 0.5 * wanted)
    )
    assert linearised(start, there, increment(True))[0] == pytest.approx(np.zeros(4))


def test_a_fix_belongs_to_when_it_was_measured_as_far_as_the_delay_is_known() -> None:
    fix = GnssFix(10**9, np.zeros(3), np.ones(3))
    for calibrate, delay_s, wanted in ((True, 0.0, 10), (True, 0.15, 9), (True, -9.0, 15), (False, 0.15, 10)):
        chain = Chain(calibrate=calibrate)
        linear = np.zeros(len(LINEAR))
        linear[LINEAR.index("gnss_delay_s")] = delay_s
        point = KeyState(gtsam.Pose3(), np.zeros(3), gtsam.imuBias.ConstantBias(), linear)
        for k in range(16):
            chain.append(k * 10**8, point)
        assert keyframe_of(fix, chain) == wanted
