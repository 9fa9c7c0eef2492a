"""The robots of the study `unseen_robots` drive as bodies must, and their sensors say what happened."""

from __future__ import annotations

import dataclasses
import importlib.util

import numpy as np
import pytest

from terrafusion.datasets.core.frames import quaternion_to_matrix, yaw_of
from tests.studies.unseen_robots.draw import DRIVES, KINDS, Robot, draw
from tests.studies.unseen_robots.machine import LOOP_S, STANDING_S, Driven, drive
from tests.studies.unseen_robots.sensors import recording_of
from tests.studies.unseen_robots.starts import Start, part
from tests.studies.unseen_robots.starts import table as start_table
from tests.studies.unseen_robots.study import (
    EKF,
    MODES,
    Learned,
    Result,
    numbers_table,
    table,
    true_numbers,
)

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed")


def plain(kind: str, **changes: object) -> Robot:
    """A robot of a kind of drive on level ground with grip, without errors, for 20 s."""
    ideal: dict[str, object] = {
        "drive": kind, "duration_s": 20.0, "bumps_m": 0.0, "slick_share": 0.0, "friction": 0.9,
        "imu_yaw_rad": 0.0, "imu_tilt_rad": (0.0, 0.0), "imu_m": (0.0, 0.0, 0.0), "receiver": KINDS["rtk"],
        "imu_hz": 100.0, "wheels_hz": 20.0, "wheel_error": 1.0, "fix_delay_s": 0.0,
    }  # fmt: skip
    return dataclasses.replace(draw(0), **{**ideal, **changes})


@pytest.fixture(scope="module", params=DRIVES)
def driven(request: pytest.FixtureRequest) -> tuple[Robot, Driven]:
    robot = plain(request.param)
    return robot, drive(robot)


def test_the_same_seed_is_the_same_log() -> None:
    robot = plain("skid_steer", duration_s=6.0, bumps_m=0.1, slick_share=0.4)
    one, other = (recording_of(robot, drive(robot)) for _ in range(2))
    assert one.imu is not None
    assert other.imu is not None
    assert np.array_equal(one.imu.gyro_radps, other.imu.gyro_radps)
    assert draw(7) == draw(7) != draw(8)


def test_at_rest_the_specific_force_is_gravity_upwards(driven: tuple[Robot, Driven]) -> None:
    rest = driven[1].force_mps2[round(1.5 / LOOP_S) : round(STANDING_S / LOOP_S)].mean(axis=0)
    assert rest == pytest.approx([0.0, 0.0, 9.81], abs=0.1)


def test_the_gyro_is_the_rate_of_the_heading(driven: tuple[Robot, Driven]) -> None:
    _, moved = driven
    turned = np.unwrap(yaw_of(moved.quaternion))
    assert abs(turned[-1] - turned[0]) > 0.5
    assert np.sum(moved.gyro_radps[:, 2]) * LOOP_S == pytest.approx(turned[-1] - turned[0], abs=0.02)


def test_with_grip_the_wheels_roll_the_path_of_the_body(driven: tuple[Robot, Driven]) -> None:
    robot, moved = driven
    lever = quaternion_to_matrix(moved.quaternion) @ np.array(robot.antenna_m)
    path_m = np.hypot(*np.diff((moved.antenna_m - lever)[:, :2], axis=0).T).sum()
    used = moved.wheels_rad[:, :2] if robot.drive == "differential" else moved.wheels_rad
    rolled_m = np.abs(np.diff(used.mean(axis=1))).sum() * robot.radius_m
    assert path_m > 5.0
    assert rolled_m == pytest.approx(path_m, rel=0.06)


def test_slick_ground_lets_the_wheels_slip() -> None:
    grip, slick = (plain("skid_steer", friction=mu, duration_s=12.0) for mu in (0.9, 0.02))
    ahead = [np.hypot(*np.diff(drive(r).antenna_m[:, :2], axis=0).T).sum() for r in (grip, slick)]
    assert ahead[1] < 0.8 * ahead[0]


def test_a_turned_imu_and_late_fixes_are_in_the_log() -> None:
    robot = plain("ackermann", duration_s=8.0)
    changed = dataclasses.replace(robot, imu_yaw_rad=0.5 * np.pi, fix_delay_s=1.0)
    log, other = recording_of(robot, drive(robot)), recording_of(changed, drive(changed))
    for one in (log, other):
        assert one.imu is not None
        assert one.gnss is not None
        assert one.steering is not None
    forward, sideways = log.imu.accel_mps2[:, 0], -other.imu.accel_mps2[:, 1]
    assert np.std(forward) > 0.1
    assert np.corrcoef(forward, sideways)[0, 1] > 0.95
    assert other.gnss.t_ns[0] - log.gnss.t_ns[0] == 1_000_000_000


def test_the_table_compares_with_the_filter() -> None:
    results = [
        Result("one", 10.0, name, 4, error, 1.0, inside)
        for name, error, inside in ((EKF, 2.0, None), (MODES[0], 1.0, 0.9), (MODES[1], 3.0, 1.0))
    ]
    results += [Result("slow", 10.0, name, 0, np.nan, np.nan, None) for name in (EKF, *MODES)]
    lines = table(results)
    assert "fixed over EKF, 10 s: 0.50, lost 0 of 1, worst 0.50, inside 95 % ellipses 90 %" in lines
    assert "adaptive over EKF, 10 s: 1.50, lost 1 of 1, worst 1.50, inside 95 % ellipses 100 %" in lines


def test_learned_numbers_are_held_against_the_truth() -> None:
    robot = plain("differential", fix_delay_s=0.3, imu_yaw_rad=np.pi)
    truth = true_numbers(robot)
    assert truth["antenna_x_m"] == robot.antenna_m[0] - 0.5 * robot.wheelbase_m
    assert truth["gnss_delay_s"] == pytest.approx(0.3)
    numbers = [Learned("one", "imu_yaw_rad", value, 0.01, truth["imu_yaw_rad"]) for value in (-3.13, 3.0)]
    assert numbers_table(numbers) == [
        "imu_yaw_rad: within 2 sigma 1 of 2, sigma 0.01 (median), worst 14.2 sigma"
    ]


def test_starts_are_tabled_by_receiver() -> None:
    rows = [Start("rtk", 8.0, 2.0, 1.0, 0.9, 0.0), Start("dgps", 8.0, 1.0, 4.0, 0.5, 0.3)]
    lines = start_table(rows)
    assert lines[0].startswith("rtk, outage 8 s after the start (1): error 1.00 m, worst 1.0, over EKF 0.50;")
    assert lines[-1].startswith("all, outage 8 s after the start (2): error 2.50 m, worst 4.0")
    assert lines[-1].endswith("inside 95 % ellipses 70 %, outside those of 99 % 15 %")


def test_a_part_of_a_log_begins_later() -> None:
    robot = plain("differential", duration_s=8.0)
    whole = recording_of(robot, drive(robot))
    cut = part(whole, 3.0, 4.0)
    assert cut.start_ns == whole.start_ns + 3_000_000_000
    assert cut.wheels is not None
    assert (np.diff(cut.wheels.t_ns) > 0).all()
    assert cut.wheels.t_ns[-1] - cut.start_ns <= 4_000_000_000
