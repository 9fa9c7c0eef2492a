"""Cross-slope, payload, canopy and zones: what a scenario may ask for, and how wrong requests are refused."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import GRAVITY_MPS2, quaternion_to_matrix
from terrafusion.twin.model.dynamics import wheel_loads
from terrafusion.twin.model.motion import wheel_shares
from terrafusion.twin.model.vectors import vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle, with_payload
from terrafusion.twin.physics.layout import VEHICLE_PARAMETERS
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import (
    CanopyInterval,
    CanopyStretch,
    DriveSegment,
    Interval,
    RouteLeg,
    Scenario,
    Stretch,
    inside,
)
from terrafusion.twin.simulate import simulate, simulate_run

ELEVATE = load_vehicle("elevate")
PARKED = Scenario("parked", 20.0, drive=(DriveSegment(20.0),), route=(RouteLeg("asphalt"),))
QUICK = settings(max_examples=40, deadline=None, derandomize=True)


@pytest.mark.parametrize(("slope", "cross"), [(0.0, 10.0), (12.0, 0.0), (12.0, -7.0), (15.0, 15.0)])
def test_slope_and_cross_slope_make_one_plane(slope, cross) -> None:
    """Heading uphill, gravity along and across the robot over gravity into the ground are the tangents."""
    accel = simulate(PARKED, slope_deg=slope, cross_slope_deg=cross, noiseless=True).imu.accel_mps2[-1]
    assert np.linalg.norm(accel) == pytest.approx(GRAVITY_MPS2, rel=1e-4)
    assert accel[0] / accel[2] == pytest.approx(math.tan(math.radians(slope)), abs=1e-4)
    assert accel[1] / accel[2] == pytest.approx(math.tan(math.radians(cross)), abs=1e-4)


@QUICK
@given(heading=st.floats(-180, 180), aspect=st.floats(-180, 180), cross=st.floats(-25, 25))
def test_the_cross_slope_rises_to_the_left_of_the_start_heading(heading, aspect, cross) -> None:
    tilted = dataclasses.replace(PARKED, heading_deg=heading, aspect_deg=aspect, cross_slope_deg=cross)
    slope, uphill = tilted.plane()
    left = math.radians(heading + 90.0)
    assert math.tan(slope) * math.cos(uphill - left) == pytest.approx(math.tan(math.radians(cross)), abs=1e-9)


def test_across_a_slope_the_robot_slides_down_and_mirrors() -> None:
    down, mirrored = (
        simulate("straight", terrain="asphalt", cross_slope_deg=c, noiseless=True).truth.position_m
        for c in (10.0, -10.0)
    )
    assert down[-1, 1] < -0.1
    np.testing.assert_allclose(down[:, 1], -mirrored[:, 1], atol=1e-6)
    np.testing.assert_allclose(down[:, 0], mirrored[:, 0], atol=1e-6)


@QUICK
@given(
    payload=st.floats(0.0, 60.0),
    at=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.0, 1.0)),
)
def test_a_payload_moves_centre_of_gravity_and_inertia(payload, at) -> None:
    """Against two bodies summed about the common centre of gravity."""
    base = dataclasses.replace(
        ELEVATE, body=dataclasses.replace(ELEVATE.body, cg_forward_m=0.02, cg_left_m=-0.03)
    )
    body, loaded = base.body, with_payload(base, payload, at).body
    own = np.array([body.cg_forward_m, body.cg_left_m, body.cg_height_m])
    common = (body.mass_kg * own + payload * np.array(at)) / (body.mass_kg + payload)
    found = loaded.cg_forward_m, loaded.cg_left_m, loaded.cg_height_m
    np.testing.assert_allclose(found, common, atol=1e-12)
    gyration = body.yaw_inertia_kgm2 / body.mass_kg
    inertia = sum(
        mass * (gyration + float(np.sum((np.array(place) - common)[:2] ** 2)))
        for mass, place in ((body.mass_kg, own), (payload, at))
    )
    assert loaded.yaw_inertia_kgm2 == pytest.approx(inertia, rel=1e-12)
    assert loaded.mass_kg == body.mass_kg + payload


def test_a_payload_without_a_place_rides_at_the_centre_of_gravity() -> None:
    body = with_payload(ELEVATE, 16.0).body
    assert (body.cg_forward_m, body.cg_left_m, body.cg_height_m) == (0.0, 0.0, 0.20)
    assert body.yaw_inertia_kgm2 == pytest.approx(1.5 * ELEVATE.body.yaw_inertia_kgm2)
    placed = simulate_run("straight", payload_kg=16.0, payload_at_m=(0.0, 0.0, 0.20), noiseless=True)
    assert np.array_equal(placed.states, simulate_run("straight", payload_kg=16.0, noiseless=True).states)


def test_a_payload_on_the_left_turns_the_robot_left() -> None:
    """The loaded side sinks deeper and resists more."""
    at = (0.0, 0.15, 0.30)
    left, right = (
        simulate("straight", terrain="loose_sand", payload_kg=30.0, payload_at_m=(0.0, s * at[1], at[2]))
        for s in (1.0, -1.0)
    )
    assert left.truth.yaw_rad()[-1] > 0.02
    np.testing.assert_allclose(left.truth.yaw_rad(), -right.truth.yaw_rad(), atol=1e-6)


def test_truth_stays_at_the_body_origin_under_an_offset_payload() -> None:
    truth = simulate("circle", payload_kg=30.0, payload_at_m=(0.1, -0.1, 0.3)).truth
    R = quaternion_to_matrix(truth.quaternion)
    velocity = np.einsum("nij,nj->ni", R, truth.twist_body[:, :3])
    stepped = np.diff(truth.position_m, axis=0) * 100.0
    assert np.abs(stepped - 0.5 * (velocity[1:] + velocity[:-1])).max() < 2e-3


@QUICK
@given(yaw=st.floats(-3, 3), slope=st.floats(0.0, 0.4), aspect=st.floats(-3, 3))
def test_shares_of_the_weight_are_the_models_loads(yaw, slope, aspect) -> None:
    lopsided = with_payload(ELEVATE, 20.0, (0.05, 0.05, 0.3))
    p = dict(
        zip(VEHICLE_PARAMETERS, vehicle_vector(lopsided, slope_rad=slope, aspect_rad=aspect), strict=True)
    )
    gx, gy = p["gravity_x_mps2"], p["gravity_y_mps2"]
    along, across = math.cos(yaw) * gx + math.sin(yaw) * gy, -math.sin(yaw) * gx + math.cos(yaw) * gy
    loads = np.array([float(load) for load in wheel_loads(p, along, across)])
    shares = wheel_shares(yaw, lopsided, slope, aspect)[0]
    assert shares.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(loads / (p["mass_kg"] * p["gravity_normal_mps2"]), shares, atol=0.01)


def test_a_robot_that_would_tip_over_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"tips over where it starts: its centre of gravity at 0\.7"):
        simulate("straight", payload_kg=60.0, payload_at_m=(0.0, 0.0, 1.0), cross_slope_deg=20.0)
    turning = dataclasses.replace(load_scenario("circle"), payload_kg=60.0, payload_at_m=(-0.1, 0.0, 0.6))
    notes = simulate(turning, slope_deg=10.0, terrain="asphalt").notes
    assert not any("tip over" in note for note in notes)
    notes = simulate(turning, slope_deg=20.0, terrain="asphalt", payload_at_m=(0.15, 0.0, 0.9)).notes
    assert any("would tip over: a wheel carries no load" in note for note in notes)


def test_patches_and_varying_strength_are_reported(tmp_path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(
        "drive: [{duration_s: 2}]\nvariation: {strength_sigma: 0.2, length_m: 2}\n"
        "patches: {terrain: mud, share: 0.3, length_m: 1}\n"
    )
    log = simulate(own)
    assert "asphalt, mud, strength varies by 0.2 over 2 m; slope" in log.description
    assert "of terrain 'mud'" in next(n for n in log.notes if n.startswith("assumed"))


def test_what_is_assumed_is_noted() -> None:
    (note,) = simulate("straight", terrain="mud").notes
    assert note.startswith("assumed numbers, marked in their files: ")
    assert "of vehicle 'elevate'" in note
    assert "of terrain 'mud'" in note
    assert not any("vehicle" in note for note in simulate("straight", vehicle=ELEVATE).notes)


def test_a_short_file_of_a_steered_robot_tells_what_it_assumes_and_cannot_drive(tmp_path) -> None:
    own = tmp_path / "car.yaml"
    own.write_text("robot: {extends: generic, name: car, drive: ackermann}\n")
    turns, numbers = simulate("spin", vehicle=own, terrain="asphalt").notes
    assert turns == "turns on the spot, 50.0 s of the commands, are not driven: 'car' steers its wheels"
    assert "of vehicle" in numbers
    assert len(simulate("circle", vehicle=own, terrain="asphalt").notes) == 1


def test_zones_count_by_time_or_by_travel() -> None:
    t, travel = np.array([0.0, 5.0, 10.0]), np.array([0.0, 1.0, 2.0])
    assert inside(Interval(5.0, 5.0), t, travel).tolist() == [False, True, False]
    assert inside(Stretch(0.5, 10.0), t, travel).tolist() == [False, True, True]


def test_a_scenario_file_takes_every_option(tmp_path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(
        "drive: [{duration_s: 20, v_mps: 1.0}]\n"
        "slope_deg: 5\ncross_slope_deg: -3\npayload_kg: 20\npayload_at_m: [0.1, 0, 0.3]\n"
        "gnss_outages: [{start_s: 4, duration_s: 2}, {start_m: 10, length_m: 2}]\n"
        "canopy: [{start_m: 2, length_m: 3, density: 0.5}, {start_s: 15, duration_s: 2, density: 1}]\n"
    )
    scenario = load_scenario(own)
    assert (scenario.cross_slope_deg, scenario.payload_kg, scenario.payload_at_m) == (
        -3.0,
        20.0,
        (0.1, 0.0, 0.3),
    )
    assert scenario.gnss_outages == (Interval(4.0, 2.0), Stretch(10.0, 2.0))
    assert scenario.canopy == (CanopyStretch(2.0, 3.0, 0.5), CanopyInterval(15.0, 2.0, 1.0))
    setup = set_up(scenario)
    assert setup.vehicle.body.mass_kg == 52.0
    assert set_up(scenario, payload_kg=0.0).vehicle.body.mass_kg == 32.0
    gnss = simulate(scenario, noiseless=True).gnss
    seconds = (gnss.t_ns - gnss.t_ns[0]) * 1e-9
    assert not ((seconds >= 4.0) & (seconds < 6.0)).any()
    description = simulate(scenario).description
    assert "slope 5 deg, across -3 deg; payload 20 kg at 0.1, 0, 0.3 m" in description


def test_the_example_of_the_documents_drives(tmp_path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "sensors.md").read_text(encoding="utf-8")
    own = tmp_path / "wood.yaml"
    own.write_text(text.split("```yaml\n")[1].split("```")[0])
    gnss = simulate(own).gnss
    assert {int(Fix.FIXED), int(Fix.SINGLE)} <= set(gnss.fix)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cross_slope_deg: 30", r"'cross_slope_deg' is 30, out of range; give a number in \[-25, 25\] deg"),
        ("payload_kg: -2", r"'payload_kg' is -2, out of range; give a number in \[0, 5000\] kg"),
        ("payload_kg: 61", "payload 61 kg is out of range; give 0 to 60 kg"),
        ("payload_at_m: [0, 0]", r"'payload_at_m' is '\[0, 0\]'; give 3 numbers in \[-5, 5\] m"),
        (
            "payload_at_m: [0, 0, 9]",
            r"'payload_at_m' is \[0, 0, 9\], out of range; give 3 numbers in \[-5, 5\] m",
        ),
        ("canopy: [{start_s: 0, duration_s: 5}]", r"'canopy\[0\].density' is missing"),
        ("canopy: [{start_m: 0, length_m: 5, density: 2}]", r"'canopy\[0\].density' is 2, out of range"),
        ("canopy: [{start_m: 0, duration_s: 5, density: 1}]", r"unknown key 'canopy\[0\].duration_s'"),
        ("gnss_outages: [{start_m: 0}]", r"'gnss_outages\[0\].length_m' is missing"),
        ("canopy: [[[[x]]]]", r"'canopy\[0\]' is '\[\[\[...\]\]\]', not a section; give keys from"),
        ("gnss_fix: [[[[x]]]]", r"'gnss_fix' is '\[\[\[...\]\]\]'; give one of"),
        ("stops: [{start_s: 5, duration_s: 2}]", r"'stops\[0\].start_s' is 5, after the drive's 5 s"),
        ("gnss_outages: [{start_s: 9, duration_s: 2}]", r"'gnss_outages\[0\].start_s' is 9, after the drive"),
        ("canopy: [{start_s: 9, duration_s: 2, density: 1}]", r"'canopy\[0\].start_s' is 9, after the drive"),
        ("waypoint_speed_mps: 2", "'waypoint_speed_mps' has no effect without 'waypoints'; leave it out"),
        ("name: [1, 2]", r"'name' is '\[1, 2\]'; give a text"),
        ("description: {a: 1}", r"'description' is .*; give a text"),
        (
            "payload_kg: 5\npayload_at_m: [0, 0, -0.2]",
            "the payload is 0.2 m below the ground; give its height",
        ),
        ("gnss_outages: [5]", r"'gnss_outages\[0\]' is '5', not a section; give keys from"),
    ],
)
def test_a_wrong_option_in_a_file_is_reported_by_key(tmp_path, text, message) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(f"drive: [{{duration_s: 5}}]\n{text}\n")
    with pytest.raises(ConfigError, match=message):
        simulate(own)


def test_stops_of_a_robot_that_follows_waypoints_are_refused(tmp_path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("waypoints: [[5, 0]]\nduration_s: 9\nstops: [{start_s: 2, duration_s: 3}]\n")
    with pytest.raises(ConfigError, match="'stops' has no effect without 'drive'"):
        simulate(own)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cross_slope_deg": -26.0}, "cross-slope -26 deg is out of range; give -25 to 25 deg"),
        ({"cross_slope_deg": float("nan")}, "cross-slope nan deg is out of range"),
        ({"payload_at_m": (0.0, float("nan"), 0.0)}, "'payload_at_m' is .*nan.*, out of range"),
        ({"payload_at_m": (0.0, 0.0, 0.3)}, "the payload has a place but no mass; give its mass"),
        ({"payload_kg": float("nan")}, "payload nan kg is out of range"),
    ],
)
def test_wrong_options_of_a_run_are_reported_in_one_line(options, message) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate("straight", **options)


@pytest.mark.parametrize("fix", [Fix.FIXED, Fix.NONE])
def test_a_class_of_fix_the_receiver_does_not_reach_is_reported(fix) -> None:
    asked = dataclasses.replace(load_scenario("straight"), gnss_fix=fix)
    with pytest.raises(
        ConfigError, match=r"'gnss_fix' is .*, not a class .* 'husky' .*; give single to single"
    ):
        simulate(asked, vehicle="husky")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duration_s": math.nan}, "'duration_s' is nan; give a finite number"),
        ({"duration_s": -1.0}, "'duration_s' is -1; give a number above zero"),
        ({"waypoints": ((math.nan, 1.0),)}, r"'waypoints\[0\]\[0\]' is nan"),
        ({"drive": (DriveSegment(9.0, v_mps=math.inf),)}, r"'drive\[0\].v_mps' is inf"),
        ({"drive": (DriveSegment(9.0, v_amplitude_mps=1.0, period_s=0.0),)}, r"'drive\[0\].period_s' is 0"),
        ({"route": ()}, "'route' is empty"),
    ],
)
def test_a_wrong_scenario_made_in_python_is_reported(changes, message) -> None:
    good = Scenario("made", 9.0, drive=(DriveSegment(9.0, v_mps=1.0),))
    with pytest.raises(ConfigError, match=message):
        simulate(dataclasses.replace(good, **changes))
