"""Sensor numbers learned from logs of the twin whose sensors were changed, and carried on by the file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.robot import KnownNumber, SensorNumbers
from terrafusion.fusion.calibration.fit import information_gained
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    COURSE_LAG,
    GNSS_DELAY,
    TURN_SCALE,
    WHEEL_SCALE,
    assumed,
    for_the_next_run,
    known_before,
)
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.outputs.robot_file import write_robot
from terrafusion.fusion.replay import replay
from terrafusion.fusion.sensor_calibration import SensorCalibration, calibrate_sensors
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

ANTENNA_M, GYRO, DELAY_S, WHEELS = 0.35, 1.03, 0.5, 1.08


def drive(name: str, turn: float, seed: int) -> Recording:
    """72 s with turns both ways by a robot with RTK whose vehicle file is wrong in four numbers."""
    lap = (
        DriveSegment(9.0, 1.0),
        DriveSegment(7.0, 0.9, turn),
        DriveSegment(6.0, 1.4),
        DriveSegment(8.0, 0.7, -0.9 * turn),
        DriveSegment(5.0, 0.6, turn),
    )
    scenario = Scenario("laps", 72.0, route=(RouteLeg("asphalt"),), drive=(DriveSegment(2.0), *lap, *lap))
    vehicle = load_vehicle("elevate")
    gnss = dataclasses.replace(vehicle.sensors.gnss, antenna_m=(ANTENNA_M, 0.0, 0.35))
    robot = dataclasses.replace(vehicle, sensors=dataclasses.replace(vehicle.sensors, gnss=gnss))
    log = simulate(scenario, vehicle=robot, seed=seed)
    assert log.gnss is not None
    assert log.imu is not None
    assert log.wheels is not None
    gyro = log.imu.gyro_radps * np.array([1.0, 1.0, GYRO])
    angle = log.wheels.angle_rad
    return dataclasses.replace(
        log,
        name=name,
        gnss=dataclasses.replace(log.gnss, t_ns=log.gnss.t_ns + round(DELAY_S * 1e9)),
        imu=dataclasses.replace(log.imu, gyro_radps=gyro),
        wheels=dataclasses.replace(
            log.wheels,
            speed=log.wheels.speed * WHEELS,
            angle_rad=None if angle is None else angle * WHEELS,
        ),
    )


@pytest.fixture(scope="module")
def logs() -> list[Recording]:
    return [drive("monday", 0.4, 1), drive("tuesday", -0.4, 2)]


@pytest.fixture(scope="module")
def found(logs: list[Recording]) -> SensorCalibration:
    return calibrate_sensors(logs, "elevate")


def test_changed_numbers_are_recovered_within_three_sigma(found: SensorCalibration) -> None:
    slip = 0.004  # of the wheels on asphalt
    for name, true, spread in (
        ("antenna_x_m", ANTENNA_M, 0.0),
        ("antenna_y_m", 0.0, 0.0),
        ("gyro_scale", 1.0 / GYRO - 1.0, 0.0),
        ("wheel_scale", 1.0 / WHEELS - 1.0, slip),
        ("gnss_delay_s", DELAY_S, 0.0),
    ):
        number = found.numbers[name]
        assert number.observed, name
        assert number.sigma < 0.4 * number.sigma_before, name
        assert abs(number.value - true) < 3.0 * np.hypot(number.sigma, spread), (name, number)
    assert "yaw_factor" not in found.numbers
    assert found.unobserved() == ["course_lag_s", "slip_per_grade"]  # slip in turns is larger; no hills
    assert "not observable in these logs: course_lag_s, slip_per_grade" in found.summary()
    seen = {name: dataclasses.replace(n, gained_nats=1.0) for name, n in found.numbers.items()}
    whole = dataclasses.replace(found, numbers=seen, notes=("a", "b"))
    assert "all numbers were observed" in whole.summary()
    assert max(len(repr(one).splitlines()) for one in (found, whole)) <= 12
    assert "  gnss_delay_s 0." in repr(found)


def test_the_second_log_starts_from_the_first(logs: list[Recording], found: SensorCalibration) -> None:
    first = calibrate_sensors(logs[:1], "elevate")
    assert found.logs == ("monday", "tuesday")
    for name in ("antenna_y_m", "gyro_scale", "wheel_scale"):
        assert found.numbers[name].sigma < first.numbers[name].sigma, name
        assert found.numbers[name].sigma_before == first.numbers[name].sigma_before


def test_a_log_that_counts_twice_is_noted(
    logs: list[Recording], found: SensorCalibration, tmp_path: Path
) -> None:
    path = write_robot(tmp_path / "my_robot.yaml", found)
    again = calibrate_sensors([logs[0], dataclasses.replace(logs[1], name="wednesday")], path)
    (note,) = (note for note in again.notes if "counts twice" in note)
    assert note.startswith("monday: ")
    assert not any("counts twice" in note for note in found.notes)


def test_the_file_carries_the_numbers_to_the_next_replay(
    logs: list[Recording], found: SensorCalibration, tmp_path: Path
) -> None:
    path = write_robot(tmp_path / "out" / "my_robot.yaml", found)
    assert len(path.read_text().splitlines()) <= 11
    robot = load_vehicle(path)
    assert robot.robot == found.known()
    assert robot.sensors.gnss.antenna_m[0] == pytest.approx(found.numbers["antenna_x_m"].value, rel=1e-5)
    estimator = Estimator(EstimatorConfig(robot.rig(), robot.name))
    assert estimator.imu.turn_scale == pytest.approx(1.0 / GYRO - 1.0, abs=0.01)
    assert estimator.gnss.delay_s == pytest.approx(DELAY_S, abs=0.12)
    before, after = replay(logs[1], vehicle="elevate"), replay(logs[1], vehicle=path)
    assert before.scores.ate_m is not None
    assert after.scores.ate_m is not None
    assert after.scores.ate_m < 0.5 * before.scores.ate_m
    assert not any(number.name == "antenna_m" for number in after.assumed)

    # What another log does not tell stays as the file has it, with the logs that told it.
    nothing = {name: dataclasses.replace(n, gained_nats=0.0) for name, n in found.numbers.items()}
    later = dataclasses.replace(found, vehicle=robot, extends=str(path), numbers=nothing, logs=("sunday",))
    again = write_robot(tmp_path / "again.yaml", later)
    assert load_vehicle(again).robot == robot.robot
    assert load_vehicle(again).body == robot.body


def test_a_log_gives_no_more_than_changes_between_runs_allow() -> None:
    wide = assumed(1e-3, False, 0.05, 300.0)
    sure = dataclasses.replace(wide, covariance=1e-6 * wide.covariance)
    after = for_the_next_run(sure, wide, "gyro")
    assert after.sigma[ANTENNA_X] == pytest.approx(sure.sigma[ANTENNA_X])
    assert sure.sigma[WHEEL_SCALE] < after.sigma[WHEEL_SCALE] < wide.sigma[WHEEL_SCALE]
    assert (for_the_next_run(wide, wide, "gyro").sigma <= wide.sigma * (1.0 + 1e-9)).all()


@pytest.mark.parametrize(("lag_s", "sigma_s"), [(-1e-6, 0.149), (-0.05, 0.08), (-0.2, 0.05)])
def test_a_course_lag_held_to_zero_is_as_uncertain_as_a_truncated_normal(
    lag_s: float, sigma_s: float
) -> None:
    wide = assumed(1e-3, False, 0.05, 300.0, skids=True)
    mean, covariance = wide.mean.copy(), wide.covariance.copy()
    mean[COURSE_LAG], covariance[COURSE_LAG, COURSE_LAG] = lag_s, sigma_s**2
    held = dataclasses.replace(wide, mean=mean, covariance=covariance).outwards()
    x = np.linspace(0.0, 1.0, 100_001)
    density = np.exp(-0.5 * ((x - lag_s) / sigma_s) ** 2)
    spread_s = np.sqrt((x**2) @ density / density.sum())
    assert held.mean[COURSE_LAG] == 0.0
    assert held.stated_sigma(wide)[COURSE_LAG] == pytest.approx(spread_s, rel=1e-3)
    assert information_gained(wide, held)[COURSE_LAG] == pytest.approx(np.log(0.15 / spread_s), abs=1e-3)
    later = for_the_next_run(held, wide, "gyro")
    assert later.sigma[COURSE_LAG] == pytest.approx(min(np.hypot(spread_s, 0.05), 0.15), rel=1e-3)
    assert later.clipped_lag_s == 0.0


def test_the_prior_follows_how_a_number_is_known() -> None:
    wide = assumed(1e-3, False, 0.05, 300.0)
    for known, sigma, expected in (
        ("measured", None, 0.02),
        ("data_sheet", None, 0.05),
        ("assumed", None, wide.sigma[ANTENNA_X]),
        ("measured", 0.005, 0.005),
        ("calibrated", (0.03, 0.01), 0.03),
    ):
        antenna = KnownNumber((0.4, 0.0, 0.5), known, sigma)
        prior = known_before(SensorNumbers(antenna_m=antenna), wide, "gyro")
        assert prior.mean[ANTENNA_X] == 0.0  # the lever arm itself has it
        assert prior.sigma[ANTENNA_X] == pytest.approx(expected)
    assert prior.sigma[ANTENNA_Y] == pytest.approx(0.01)
    numbers = SensorNumbers(
        gyro_scale=KnownNumber(0.03, "calibrated", 0.002),
        yaw_factor=KnownNumber(0.5, "calibrated", 0.05),
        gnss_delay_s=KnownNumber(0.4, "assumed"),
    )
    prior = known_before(numbers, wide, "gyro")
    assert prior.mean[TURN_SCALE] == 0.03
    assert 0.002 <= prior.sigma[TURN_SCALE] < 0.004
    assert (prior.mean[GNSS_DELAY], prior.sigma[GNSS_DELAY]) == (0.4, wide.sigma[GNSS_DELAY])
    by_wheels = known_before(numbers, assumed(1e-3, True, 0.05, 300.0), "wheels")
    assert by_wheels.mean[TURN_SCALE] == 0.0
    by_steering = known_before(numbers, assumed(1e-3, True, 0.05, 300.0), "steering")
    assert (
        by_steering.sigma[TURN_SCALE] == assumed(1e-3, True, 0.05, 300.0).sigma[TURN_SCALE]
    )  # neither is its own
    assert by_wheels.sigma[TURN_SCALE] == pytest.approx(np.hypot(0.1, 0.05))  # grounds differ


def test_without_any_number_nothing_changes() -> None:
    for name in ("elevate", "husky", "generic"):
        rig = load_vehicle(name).rig()
        if name != "generic":  # its antenna is nobody's
            assert rig.known == SensorNumbers()
        wide = assumed(rig.sensors.imu.gyro_bias_sigma_radps, False, 0.05, 300.0)
        assert np.array_equal(known_before(rig.known, wide, "gyro").covariance, wide.covariance)


def test_logs_that_tell_nothing_or_do_not_fit_are_refused(logs: list[Recording], tmp_path: Path) -> None:
    blind = dataclasses.replace(logs[0], gnss=None)
    with pytest.raises(DataError, match="none of the logs has fixes"):
        calibrate_sensors([blind], "elevate")
    other = dataclasses.replace(logs[1], overrides=Overrides(track_m=0.7))
    with pytest.raises(DataError, match="another geometry"):
        calibrate_sensors([logs[0], other], "elevate")
    with pytest.raises(DataError, match="several vehicles"):
        calibrate_sensors([logs[0], dataclasses.replace(logs[1], vehicle="husky")])
    with pytest.raises(DataError, match="calibrate them apart"):
        calibrate_sensors([logs[0], dataclasses.replace(logs[1], imu=None)], "elevate")


def test_a_complete_file_is_extended_and_never_overwritten(found: SensorCalibration, tmp_path: Path) -> None:
    full = tmp_path / "full.yaml"
    shipped = Path(__file__).parents[3] / "twin/params/vehicles/elevate.yaml"
    full.write_text(shipped.read_text("utf-8").replace("name: elevate", "name: mine"), "utf-8")
    started = dataclasses.replace(found, vehicle=load_vehicle(full), extends=str(full))
    with pytest.raises(ConfigError, match="would overwrite"):
        write_robot(full, started)
    own = load_vehicle(write_robot(tmp_path / "own.yaml", started))
    assert own.name == "mine"
    assert own.robot == found.known()


def test_a_robot_that_steers_its_front_wheels_has_its_antenna_where_its_file_says() -> None:
    """Its path is that of the rear axle, half a wheelbase behind the origin."""
    legs = (DriveSegment(2.0), *3 * (DriveSegment(7.0, 0.9, 0.35), DriveSegment(6.0, 1.2, -0.3)))
    scenario = Scenario("bends", 41.0, route=(RouteLeg("asphalt"),), drive=legs)
    vehicle = with_overrides(load_vehicle("elevate"), Overrides(drive="ackermann"))
    result = replay(simulate(scenario, vehicle=vehicle, seed=3), vehicle=vehicle, mode="fixed")
    antenna = next(number for number in result.learned if number.state == "antenna_x_m")
    assert antenna.sigma < 0.1
    assert abs(antenna.value) < 2.5 * antenna.sigma
