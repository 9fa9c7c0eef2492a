"""Whole runs: the source study's findings, determinism, and the shape of the recording."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import TERRAINS
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle, vehicle_names
from terrafusion.twin.physics.layout import INDEX
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, Interval, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate, simulate_run


def same(a: Recording, b: Recording) -> bool:
    pairs = [(a.channels()[name], b.channels()[name]) for name in a.channels()]
    pairs.append((a.truth, b.truth))
    return all(
        np.array_equal(getattr(x, f.name), getattr(y, f.name))
        for x, y in pairs
        for f in dataclasses.fields(x)
        if isinstance(getattr(x, f.name), np.ndarray)
    )


def test_medium_sand_hardly_slips_on_five_degrees() -> None:
    summary = simulate_run("paper_profile", terrain="medium_sand", slope_deg=5.0).summary
    assert summary.mean_abs_slip == pytest.approx(0.010, abs=0.002)
    assert summary.immobilised_at_s is None


def test_loose_sand_slips_by_a_quarter_on_five_degrees() -> None:
    summary = simulate_run("paper_profile", terrain="loose_sand", slope_deg=5.0).summary
    assert summary.mean_abs_slip == pytest.approx(0.27, abs=0.01)
    assert summary.immobilised_at_s is None


def test_mud_stops_the_robot_for_good_after_about_a_minute() -> None:
    run = simulate_run("paper_profile", terrain="mud")
    assert 55.0 < run.summary.immobilised_at_s < 70.0
    assert run.summary.mean_abs_slip < 0.04
    later = run.t_s > run.summary.immobilised_at_s + 10.0
    assert np.abs(run.states[later, INDEX["u"]]).max() < 0.05
    assert np.abs(run.states[later, INDEX["wheel_speed_front_left"]]).max() * 0.175 < 0.1


def test_energy_a_metre_grows_with_slope_payload_and_slip() -> None:
    def energy(**kw) -> float:
        return simulate_run("straight", **kw).summary.energy_per_m_j

    assert energy() < energy(slope_deg=5.0) < energy(slope_deg=5.0, payload_kg=20.0)
    assert energy(slope_deg=5.0) < energy(slope_deg=5.0, terrain="loose_sand")


@pytest.mark.parametrize("name", known_names("scenarios"))
def test_every_scenario_runs_and_is_not_immobilised(name) -> None:
    run = simulate_run(name)
    assert run.summary.immobilised_at_s is None
    absent = set(Recording.CHANNELS) - set(run.recording.channels())
    assert absent == {"barometer", "magnetometer", "steering"}
    assert len(run.t_s) == len(run.states) == len(run.slip) == len(run.recording.truth)
    assert set(run.recording.terrain.label) <= set(TERRAINS)


@pytest.mark.parametrize("name", vehicle_names())
def test_every_vehicle_drives(name) -> None:
    run = simulate_run("straight", vehicle=name)
    vehicle = load_vehicle(name)
    larger = vehicle.wheel.radius_m / vehicle.odometry.wheel_radius_m  # a robot drives by its own odometry
    assert run.summary.distance_m == pytest.approx(54.0 * larger, rel=0.02)
    assert run.recording.vehicle == name


def test_waypoints_are_reached_on_slippery_ground() -> None:
    scenario = load_scenario("waypoints")
    truth = simulate("waypoints", terrain="loose_sand").truth.position_m[:, :2]
    for point in scenario.waypoints[:4]:
        assert np.linalg.norm(truth - np.array(point), axis=1).min() < 0.6


def test_the_routes_cross_all_their_grounds() -> None:
    for name in ("mixed_terrain", "demo"):
        labels = simulate(name).terrain.label
        assert set(labels) == {leg.terrain for leg in load_scenario(name).route}


def test_same_seed_same_bits_and_the_motion_knows_no_seed() -> None:
    a, b, other = simulate("chirp", seed=3), simulate("chirp", seed=3), simulate("chirp", seed=4)
    assert same(a, b)
    assert np.array_equal(a.truth.position_m, other.truth.position_m)
    assert not np.array_equal(a.imu.gyro_radps, other.imu.gyro_radps)


def test_an_outage_changes_no_other_sensor_and_no_other_fix() -> None:
    """Of a receiver that is back at once; see sensors/test_data_sheets.py for one that has to climb back."""
    elevate = load_vehicle("elevate")
    prompt = dataclasses.replace(elevate.realism.gnss, reacquire_s=0.0, refix_s=0.0)
    elevate = dataclasses.replace(elevate, realism=dataclasses.replace(elevate.realism, gnss=prompt))
    scenario = load_scenario("straight")
    gap = dataclasses.replace(scenario, gnss_outages=(Interval(20.0, 10.0),))
    a, b = simulate(scenario, vehicle=elevate), simulate(gap, vehicle=elevate)
    assert np.array_equal(a.imu.accel_mps2, b.imu.accel_mps2)
    assert len(a.gnss) - len(b.gnss) == 50
    kept = np.isin(a.gnss.t_ns, b.gnss.t_ns)
    assert np.array_equal(a.gnss.enu_m[kept], b.gnss.enu_m)


def test_truth_lies_in_the_inclined_plane_and_agrees_with_its_twist() -> None:
    scenario = dataclasses.replace(load_scenario("circle"), aspect_deg=30.0)
    truth = simulate(scenario, slope_deg=10.0).truth
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])
    height = truth.position_m @ along * np.tan(np.radians(10.0))
    assert np.abs(truth.position_m[:, 2] - height).max() < 1e-9
    R = quaternion_to_matrix(truth.quaternion)
    assert np.allclose(R[:, 2, 2], np.cos(np.radians(10.0)))
    velocity = np.einsum("nij,nj->ni", R, truth.twist_body[:, :3])
    stepped = np.diff(truth.position_m, axis=0) * 100.0
    assert np.abs(stepped - 0.5 * (velocity[1:] + velocity[:-1])).max() < 2e-3


def test_an_offset_centre_of_gravity_turns_the_robot_and_keeps_truth_at_the_origin() -> None:
    elevate = load_vehicle("elevate")
    body = dataclasses.replace(elevate.body, cg_left_m=0.1, cg_forward_m=0.05)
    lopsided = dataclasses.replace(elevate, body=body)
    truth = simulate("straight", vehicle=lopsided, terrain="loose_sand").truth
    assert abs(truth.yaw_rad()[-1]) > 0.01
    R = quaternion_to_matrix(truth.quaternion)
    velocity = np.einsum("nij,nj->ni", R, truth.twist_body[:, :3])
    stepped = np.diff(truth.position_m, axis=0) * 100.0
    assert np.abs(stepped - 0.5 * (velocity[1:] + velocity[:-1])).max() < 2e-3


@pytest.mark.parametrize("effect", ["wheel_radius/scale", "wheel_radius/build_up"])
def test_wheels_of_another_size_do_not_slip_for_it(effect) -> None:
    summary = simulate_run("straight", terrain="asphalt", effects={effect: 0.2}, noiseless=True).summary
    assert summary.mean_slip_ratio < 0.002
    assert summary.mean_abs_slip > 0.1  # the odometry does not know


@pytest.mark.parametrize("drive", ["ackermann", "four_wheel_steer"])
@pytest.mark.parametrize("v_mps", [0.8, -0.8])
def test_steered_wheels_that_roll_around_a_curve_do_not_slip(drive, v_mps) -> None:
    vehicle = load_vehicle("generic")
    vehicle = dataclasses.replace(vehicle, drive=dataclasses.replace(vehicle.drive, type=drive))
    segments = (DriveSegment(1.0), DriveSegment(9.0, v_mps, curvature_per_m=0.8))
    summary = simulate_run(
        Scenario("curve", 10.0, drive=segments, route=(RouteLeg("asphalt"),)), vehicle=vehicle, noiseless=True
    ).summary
    assert summary.mean_slip_ratio < 0.002
    assert summary.mean_abs_slip < 0.005


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scenario": "straigth"}, "unknown scenario 'straigth'; known are .*straight"),
        ({"vehicle": "huskey"}, "unknown vehicle 'huskey'; known are .*husky"),
        ({"terrain": "ice"}, "unknown terrain 'ice'; known are .*mud"),
        ({"slope_deg": 26.0}, "slope 26 deg is out of range; give 0 to 25 deg"),
        ({"slope_deg": float("nan")}, "slope nan deg is out of range"),
        ({"payload_kg": -1.0}, "payload -1 kg is out of range; give 0 to 60 kg"),
        ({"seed": -1}, "seed -1 is negative"),
    ],
)
def test_wrong_requests_are_reported_in_one_line(kwargs, message) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate(**({"scenario": "straight"} | kwargs))


def test_every_soil_and_vehicle_file_bears_its_own_name() -> None:
    assert all(load_soil(name).name == name for name in known_names("soils"))
    assert all(load_vehicle(name).name == name for name in vehicle_names())
    assert set(known_names("soils")) <= set(TERRAINS)
