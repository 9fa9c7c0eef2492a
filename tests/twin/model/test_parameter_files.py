"""Vehicle, soil and scenario files: strict, named in errors, and the user's own."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Overrides
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import geometry_notes, load_vehicle, with_overrides
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment
from terrafusion.twin.simulate import simulate_run

PARAMS = resources.files("terrafusion.twin.params")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_users_vehicle_and_soil_load_from_paths(tmp_path) -> None:
    for folder, name, load in (("vehicles", "elevate", load_vehicle), ("soils", "mud", load_soil)):
        text = (PARAMS / folder / f"{name}.yaml").read_text(encoding="utf-8")
        own = write(tmp_path / f"{name}.yaml", text.replace(f"name: {name}", "name: mine", 1))
        assert load(own).name == "mine"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass_kg: {value: 32.0", "mass_kg: {value: -3.0", "body.mass_kg.*out of range"),
        ("mass_kg:", "mass_lb:", "unknown key 'body.mass_lb'.*mass_kg"),
        ('source: "source study, Tab. 1"', "source: ''", "has no source"),
        ("name: elevate", "nme: elevate", "unknown key 'nme'"),
    ],
)
def test_a_wrong_vehicle_file_is_reported_by_key(tmp_path, old, new, message) -> None:
    text = (PARAMS / "vehicles" / "elevate.yaml").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_vehicle(write(tmp_path / "v.yaml", text.replace(old, new, 1)))


def with_lines(path: Path, lines: str) -> Path:
    text = (PARAMS / "vehicles" / "elevate.yaml").read_text(encoding="utf-8")
    return write(path, f"{text}\n{lines}\n")


def with_effect(path: Path, effect: str) -> Path:
    return with_lines(path, f"effects:\n  {effect}")


def test_effects_of_a_vehicles_file_are_in_its_runs_unless_others_are_given(tmp_path) -> None:
    worn = with_effect(tmp_path / "v.yaml", "gyro_bias/constant: {value: 0.02, source: tried}")

    def rate(vehicle: str | Path, **effects: dict[str, float]) -> np.ndarray:
        imu = simulate_run("spin", vehicle=vehicle, noiseless=True, **effects).recording.imu
        assert imu is not None
        return imu.gyro_radps[:, 2]

    plain = rate("elevate")
    np.testing.assert_allclose(rate(worn) - plain, 0.02, atol=1e-9)
    np.testing.assert_allclose(rate(worn, effects={"gyro_bias/constant": 0.05}) - plain, 0.05, atol=1e-9)


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ("slope/uniform: {value: 0.9, source: x}", "effects: effect 'slope/uniform' is 0.9, out of range"),
        ("slop/uniform: {value: 0.1, source: x}", "unknown effect 'slop/uniform'; did you mean"),
        ("slope/uniform: 0.1", "without a source"),
    ],
)
def test_a_wrong_effect_of_a_vehicles_file_is_reported(tmp_path, effect, message) -> None:
    with pytest.raises(ConfigError, match=message):
        load_vehicle(with_effect(tmp_path / "v.yaml", effect))


def test_overrides_replace_the_geometry() -> None:
    rig = with_overrides(load_vehicle("generic"), Overrides(0.2, 0.9, (0.1, 0.0, 1.0), (0.0, 0.2, 0.3))).rig()
    assert (rig.wheel_radius_m, rig.track_m) == (0.2, 0.9)
    assert rig.sensors.gnss.antenna_m == (0.1, 0.0, 1.0)
    assert rig.sensors.imu.position_m == (0.0, 0.2, 0.3)
    assert with_overrides(load_vehicle("husky"), Overrides()) == load_vehicle("husky")


def test_a_log_does_not_replace_what_was_measured() -> None:
    robot = load_vehicle("husky")
    wide = dataclasses.replace(
        robot, body=dataclasses.replace(robot.body, track_m=0.7), measured=("body.track_m",)
    )
    found = with_overrides(wide, Overrides(wheel_radius_m=0.2, track_m=0.9))
    assert (found.body.track_m, found.odometry.track_m) == (0.7, 0.9)
    assert (found.wheel.radius_m, found.odometry.wheel_radius_m) == (0.2, 0.2)
    known = dataclasses.replace(wide, measured=("body.track_m", "wheel.radius_m"))
    assert with_overrides(known, Overrides(0.2, 0.9)).wheel == robot.wheel


def test_the_geometry_that_a_log_reports_is_noted() -> None:
    robot = load_vehicle("husky")
    assert geometry_notes(robot, Overrides()) == ()
    note = "the log's own geometry is used: wheel_radius_m = 0.2, track_m = 0.9"
    assert geometry_notes(robot, Overrides(0.2, 0.9)) == (note,)
    wide = dataclasses.replace(robot, measured=("body.track_m",))
    assert geometry_notes(wide, Overrides(0.2)) == ("the log's own geometry is used: wheel_radius_m = 0.2",)
    kept = "; measured on this robot before, and retained for its body: body.track_m"
    assert geometry_notes(wide, Overrides(0.2, 0.9)) == (note + kept,)


@pytest.mark.parametrize("name", ["body", "body.trak_m", "track_m", "topics.imu", "name"])
def test_a_measured_number_has_to_be_one(tmp_path, name) -> None:
    with pytest.raises(ConfigError, match=f"there is no number '{name}'; give dotted names"):
        load_vehicle(with_lines(tmp_path / "v.yaml", f"measured: [{name}]"))


def test_husky_keeps_its_rotated_imu() -> None:
    matrix = load_vehicle("husky").rig().sensors.imu.base_from_sensor()
    assert np.array_equal(matrix, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]])


def test_a_users_scenario_crosses_grounds(tmp_path) -> None:
    own = write(
        tmp_path / "two_grounds.yaml",
        """
description: two grounds
drive:
  - {duration_s: 4}
  - {duration_s: 26, v_mps: 1.0, yaw_rate_radps: 0.1}
route:
  - {terrain: asphalt, length_m: 10}
  - {terrain: mud}
gnss_fix: single
gnss_outages:
  - {start_s: 10, duration_s: 5}
""",
    )
    run = simulate_run(own)
    assert run.recording.name == "two_grounds"
    assert run.summary.duration_s == 30.0
    assert list(dict.fromkeys(run.recording.terrain.label)) == ["asphalt", "mud"]


def test_a_route_over_time_switches_at_its_time(tmp_path) -> None:
    own = write(
        tmp_path / "t.yaml",
        "drive: [{duration_s: 10, v_mps: 1.0}]\nroute_over: time\n"
        "route: [{terrain: asphalt, length_s: 4}, {terrain: loose_sand}]\n",
    )
    terrain = simulate_run(own).recording.terrain
    first = terrain.t_ns[list(terrain.label).index("loose_sand")] - terrain.t_ns[0]
    assert first == 4_000_000_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("drive: [{duration_s: 5, speed: 1}]", r"unknown key 'drive\[0\].speed'; known here: .*v_mps"),
        ("drive: [{v_mps: 1}]", r"'drive\[0\].duration_s' is missing"),
        ("drive: [{duration_s: 5, v_mps: fast}]", r"'drive\[0\].v_mps' is 'fast'; give a number"),
        ("drive: [{duration_s: 5, v_mps: 99}]", "out of range"),
        ("drive: 5", "'drive' is '5'; give a list"),
        ("description: nothing", "drives nowhere"),
        ("colour: red", "unknown key 'colour'"),
        ("waypoints: [[1, 2]]", "'duration_s' is missing"),
        ("waypoints: [[1, 2, 3]]\nduration_s: 9", r"'waypoints\[0\]'"),
        ("drive: [{duration_s: 5}]\nwaypoints: [[1, 2]]", "exclude each other"),
        ("drive: [{duration_s: 5}]\nroute: []", "'route' is empty"),
        ("drive: [{duration_s: 5}]\nroute: [{length_m: 5}]", r"'route\[0\].terrain' is missing"),
        (
            "drive: [{duration_s: 5}]\nroute: [{terrain: mud}, {terrain: mud}]",
            r"'route\[0\].length_m' is missing",
        ),
        ("drive: [{duration_s: 5}]\nroute: [{terrain: mud, length_m: 0.2}, {terrain: mud}]", "shorter than"),
        ("drive: [{duration_s: 5}]\nslope_deg: 40", "'slope_deg' is 40, out of range"),
        ("drive: [{duration_s: 5}]\ngnss_fix: great", "give one of best, fixed, float, single"),
    ],
)
def test_a_wrong_scenario_file_is_reported_by_key(tmp_path, text, message) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate_run(write(tmp_path / "s.yaml", text))


def test_a_missing_file_is_reported() -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load_scenario("nowhere/own.yaml")


def test_a_chirp_sweeps_from_its_first_to_its_last_frequency() -> None:
    segment = DriveSegment(40.0, v_amplitude_mps=1.0, period_s=10.0, end_period_s=1.0)
    t = np.arange(0.0, 40.0, 1e-3)
    wave = segment.twist(t)[:, 0]
    rises = t[1:][(wave[1:] > 0) & (wave[:-1] <= 0)]
    periods = np.diff(rises)
    assert periods[0] == pytest.approx(6.0, abs=2.0)
    assert periods[-1] == pytest.approx(1.0, abs=0.05)


def test_the_command_lists_every_scenario() -> None:
    from terrafusion.fusion.cli.simulate import simulate as command

    assert all(name in command.__doc__ for name in known_names("scenarios"))
