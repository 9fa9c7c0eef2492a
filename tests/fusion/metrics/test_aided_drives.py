"""Barometer and magnetometer in whole drives of the twin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import BarometerSpec, MagnetometerSpec
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.replay import ReplayResult, replay
from terrafusion.twin.model.sensor_realism import BarometerRealism, MagnetometerRealism
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.sensors.environment import DECLINATION_RAD
from terrafusion.twin.simulate import simulate

ASPHALT = (RouteLeg("asphalt"),)
WEST_OF_NORTH_DEG = 110.0
GIVEN = {"declination_rad": DECLINATION_RAD}
WRONG = {"declination_rad": DECLINATION_RAD + math.radians(20.0)}


def aided(name: str) -> VehicleParams:
    """With the figures of docs/explanation/barometer-magnetometer.md."""
    car = load_vehicle(name)
    field = MagnetometerSpec(30.0, 5e-8, 1e-6)
    return dataclasses.replace(
        car,
        sensors=dataclasses.replace(
            car.sensors, barometer=BarometerSpec(10.0, 3.6, 0.2, (0.0, 0.0, 0.2)), magnetometer=field
        ),
        realism=dataclasses.replace(
            car.realism,
            barometer=BarometerRealism(500.0, 0.03),
            magnetometer=MagnetometerRealism(0.01, 5e-7, 5.0),
        ),
    )


@pytest.fixture(scope="module")
def turning() -> Recording:
    """A stop, a straight and a turn, by a robot with RTK."""
    legs = (DriveSegment(4.0), DriveSegment(12.0, 1.0, 0.0), DriveSegment(24.0, 1.0, 0.5))
    scenario = Scenario("turning", 40.0, drive=legs, route=ASPHALT, heading_deg=WEST_OF_NORTH_DEG)
    return simulate(scenario, vehicle=aided("elevate"), seed=2)


@pytest.fixture(scope="module")
def parked() -> Recording:
    scenario = Scenario(
        "parked", 5.0, drive=(DriveSegment(5.0),), route=ASPHALT, heading_deg=WEST_OF_NORTH_DEG
    )
    return simulate(scenario, vehicle=aided("elevate"), seed=2)


def yaw_errors(run: ReplayResult) -> np.ndarray:
    """Heading errors of all keyframes, deg."""
    truth, got = run.recording.truth, run.estimate.trajectory
    rows = np.searchsorted(truth.t_ns, got.t_ns).clip(0, len(truth) - 1)
    both = [quaternion_to_matrix(q) for q in (got.quaternion, truth.quaternion[rows])]
    estimated, true = (np.arctan2(R[:, 1, 0], R[:, 0, 0]) for R in both)
    return np.degrees((estimated - true + np.pi) % (2.0 * np.pi) - np.pi)


def with_field(recording: Recording, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Recording:
    own = recording.magnetometer
    t_s = (own.t_ns - recording.start_ns) * 1e-9
    return dataclasses.replace(
        recording, magnetometer=dataclasses.replace(own, field_t=change(own.field_t.copy(), t_s))
    )


def notes_of(run: ReplayResult) -> str:
    return "\n".join(run.estimate.notes)


def test_a_robot_at_rest_starts_with_the_heading_of_the_field(parked: Recording) -> None:
    run = replay(parked, magnetometer=True, settings=GIVEN)
    start = run.estimate.trajectory
    assert (start.t_ns[0] - parked.start_ns) * 1e-9 < 2.0
    sigma = np.degrees(np.sqrt(start.covariance[0, 5, 5]))
    assert abs(yaw_errors(run)[0]) < 3.0 * sigma
    assert sigma < 12.0
    assert np.linalg.norm(start.position_m[0] - parked.truth.position_m[0]) < 0.2


def test_without_a_field_or_a_declination_it_waits_for_motion(parked: Recording) -> None:
    for more in ({}, {"settings": GIVEN}, {"magnetometer": True}):
        with pytest.raises(DataError, match="never moved far enough"):
            replay(parked, **more)  # type: ignore[arg-type]


def test_the_start_from_the_field_is_left_for_the_truth(turning: Recording) -> None:
    run = replay(turning, magnetometer=True, settings=GIVEN)
    assert np.abs(yaw_errors(run)[-100:]).max() < 1.5
    assert "off by" not in notes_of(run)


def test_a_wrong_declination_is_told_and_not_trusted(turning: Recording) -> None:
    run = replay(turning, magnetometer=True, settings=WRONG)
    errors = yaw_errors(run)
    assert abs(errors[0]) > 8.0, "at rest nothing speaks against it"
    assert np.abs(errors[-100:]).max() < 1.5
    assert "disagree with the drive: a wrong declination" in notes_of(run)


def test_hard_iron_is_told_and_not_trusted(turning: Recording) -> None:
    """12 uT where the horizontal field has 19: headings off by up to 39 deg."""
    spoilt = with_field(turning, lambda field, _: field + np.array([10e-6, -7e-6, 0.0]))
    run = replay(spoilt, magnetometer=True)
    assert np.abs(yaw_errors(run)[-100:]).max() < 2.0
    assert "iron" in notes_of(run)


def test_a_disturbance_on_the_way_is_refused(turning: Recording) -> None:
    """20 uT for 10 s, as beside a car: size and dip of the field change."""

    def beside_a_car(field: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        field[(t_s > 20.0) & (t_s < 30.0)] += [0.0, 20e-6, 0.0]
        return field

    run = replay(with_field(turning, beside_a_car), magnetometer=True)
    plain = replay(turning)
    assert np.abs(yaw_errors(run)[-150:]).max() < np.abs(yaw_errors(plain)[-150:]).max() + 0.5
    refused = int(notes_of(run).split("headings, one a second, were used, ")[1].split(" refused")[0])
    assert 5 <= refused <= 14


def test_they_change_nothing_when_they_are_off(turning: Recording) -> None:
    """The same bits with the channels left out and with a magnetometer that is not asked for."""
    bare = replay(dataclasses.replace(turning, barometer=None, magnetometer=None))
    off = replay(dataclasses.replace(turning, barometer=None))
    np.testing.assert_array_equal(
        bare.estimate.trajectory.position_m, off.estimate.trajectory.position_m, strict=True
    )
    np.testing.assert_array_equal(bare.estimate.trajectory.covariance, off.estimate.trajectory.covariance)
    assert "not used unless asked for" in notes_of(off)
    assert "barometer" not in notes_of(off)
    assert "barometer: height differences of" in notes_of(replay(turning))


def height_drift_m(run: ReplayResult, begin_s: float, end_s: float) -> float:
    """Root mean square of the height error between two times, less that of the second before."""
    truth, got = run.recording.truth, run.estimate.trajectory
    rows = np.searchsorted(truth.t_ns, got.t_ns).clip(0, len(truth) - 1)
    error = got.position_m[:, 2] - truth.position_m[rows, 2]
    t_s = (got.t_ns - run.recording.start_ns) * 1e-9
    before = error[(t_s > begin_s - 1.0) & (t_s <= begin_s)].mean()
    return float(np.sqrt(np.mean((error[(t_s > begin_s) & (t_s < end_s)] - before) ** 2)))


def test_a_barometer_holds_the_height_in_an_outage() -> None:
    """A Husky up and down a slope, 60 s without GNSS; two drives, so that one of luck does not count."""
    legs = (DriveSegment(40.0, 1.0, 0.0), DriveSegment(50.0, 1.0, 0.1))
    scenario = Scenario("slope", 90.0, drive=legs, route=ASPHALT, slope_deg=6.0)
    drifts = []
    for seed in (0, 1):
        drive = simulate(scenario, vehicle=aided("husky"), seed=seed)
        for recording in (drive, dataclasses.replace(drive, barometer=None)):
            run = replay(recording, vehicle="husky", outages=[Outage(28.0, 60.0)])
            drifts.append(height_drift_m(run, 28.0, 88.0))
    held, free = np.hypot(drifts[0], drifts[2]), np.hypot(drifts[1], drifts[3])
    assert held < 0.7 * free


def feed(estimator: Estimator, recording: Recording, begin_s: float, end_s: float) -> None:
    """All samples of a stretch, in time order."""
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    sides = wheels.side_speeds_mps(estimator.config.rig.wheel_radius_m)
    events: list[tuple[int, int, Any]] = []
    for i, t in enumerate(wheels.t_ns.tolist()):
        events.append((t, 0, lambda t=t, i=i: estimator.add_wheels(t, *sides[i])))
    for i, t in enumerate(gnss.t_ns.tolist()):
        events.append((t, 1, lambda t=t, i=i: estimator.add_gnss(t, gnss.enu_m[i], gnss.sigma_enu_m[i])))
    for t, p in zip(recording.barometer.t_ns.tolist(), recording.barometer.pressure_pa.tolist(), strict=True):
        events.append((t, 2, lambda t=t, p=p: estimator.add_pressure(t, p)))
    for t, b in zip(recording.magnetometer.t_ns.tolist(), recording.magnetometer.field_t, strict=True):
        events.append((t, 3, lambda t=t, b=b: estimator.add_magnetic_field(t, b)))
    for i, t in enumerate(imu.t_ns.tolist()):
        events.append((t, 4, lambda t=t, i=i: estimator.add_imu(t, imu.gyro_radps[i], imu.accel_mps2[i])))
    for t, _, give in sorted(events, key=lambda event: event[:2]):
        if begin_s <= (t - recording.start_ns) * 1e-9 < end_s:
            give()


def test_dump_and_restore_goes_on_with_the_same_bits(turning: Recording) -> None:
    config = EstimatorConfig(aided("elevate").rig(), "elevate", declination_rad=DECLINATION_RAD)
    whole = Estimator(config)
    feed(whole, turning, 0.0, 8.0)
    second = Estimator.restore(config, whole.dump())
    assert second.aids.height.used == whole.aids.height.used > 3
    assert second.aids.heading.used == whole.aids.heading.used > 3
    for estimator in (whole, second):
        feed(estimator, turning, 8.0, 14.0)
    np.testing.assert_array_equal(whole.latest().position_m, second.latest().position_m)
    np.testing.assert_array_equal(whole.latest().covariance, second.latest().covariance)


def test_a_batch_takes_them_too(turning: Recording) -> None:
    run = replay(turning, magnetometer=True, settings=GIVEN, batch=True)
    assert np.abs(yaw_errors(run)).max() < 3.0
