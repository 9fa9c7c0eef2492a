"""The short form of a vehicle file: ten lines that stand for a complete one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.core.sensors import assumed_sigma
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.twin.model.vehicle import geometry_notes, load_vehicle, with_overrides
from terrafusion.twin.model.vehicle_file import read_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, Scenario
from terrafusion.twin.simulate import simulate

SHORT = """\
robot:
  extends: husky
  name: my_robot
  drive: differential
  wheel_radius_m: {value: 0.12, known: measured}
  track_m: {value: 0.4, known: data_sheet}
  antenna_m: {value: [0.1, 0.02, 0.6], known: measured}
  gyro_scale: {value: 0.01, known: calibrated, sigma: 0.002, logs: [monday], gained_nats: 2.0}
  topics: {gnss: /ublox/fix}
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_short_file_replaces_only_what_it_gives(tmp_path: Path) -> None:
    own, husky = load_vehicle(written(tmp_path / "own.yaml", SHORT)), load_vehicle("husky")
    assert (own.name, own.drive.type) == ("my_robot", "differential")
    assert own.description == "as 'husky' but for what its own file says"
    assert own.wheel.radius_m == own.odometry.wheel_radius_m == 0.12
    assert own.body.track_m == own.odometry.track_m == 0.4
    assert own.measured == ("wheel.radius_m",)  # a data sheet is no measurement
    assert own.sensors.gnss.antenna_m == (0.1, 0.02, 0.6)
    assert own.sensors.imu == husky.sensors.imu
    assert own.body.mass_kg == husky.body.mass_kg
    assert own.topics == {**husky.topics, "gnss": "/ublox/fix"}
    scale = own.rig().known.gyro_scale
    assert scale is not None
    assert (scale.value, scale.sigma, scale.logs) == (0.01, 0.002, ("monday",))


def test_a_file_extends_one_beside_it_and_keeps_what_that_one_knows(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    written(tmp_path / "base" / "own.yaml", SHORT)
    text = "robot:\n  extends: base/own.yaml\n  gnss_delay_s: {value: 0.3, known: calibrated, sigma: 0.01}\n"
    second = load_vehicle(written(tmp_path / "second.yaml", text))
    assert second.wheel.radius_m == 0.12
    assert second.robot.gyro_scale is not None
    assert second.robot.gnss_delay_s is not None


def test_a_short_file_tells_the_sigma_of_a_receiver_that_reports_none(tmp_path: Path) -> None:
    text = "robot:\n  gnss_sigma_m: {value: 0.02, known: data_sheet}\n"
    own = load_vehicle(written(tmp_path / "own.yaml", text))
    assert (own.sensors.gnss.sigma_horizontal_m, own.sensors.gnss.sigma_vertical_m) == (0.02, 0.04)
    assert own.measured == ()
    sigma, origin = assumed_sigma(own.rig(), np.array([Fix.SINGLE, Fix.SINGLE]))
    assert sigma.tolist() == [[0.02, 0.02, 0.04]] * 2
    assert "0.02 m" in origin


def test_a_file_of_one_line_is_the_generic_vehicle(tmp_path: Path) -> None:
    own = load_vehicle(written(tmp_path / "own.yaml", "robot: {drive: tracked}\n"))
    generic = load_vehicle("generic")
    assert own.drive.type == "tracked"
    assert (own.body, own.sensors, own.name) == (generic.body, generic.sensors, generic.name)


def test_the_twin_drives_a_short_file(tmp_path: Path) -> None:
    log = simulate("straight", vehicle=written(tmp_path / "own.yaml", SHORT), seed=1)
    assert log.duration_s() > 5.0


@pytest.mark.parametrize("wrong", [f"name: mine\n{SHORT}", "drive: tracked\ntrack_m: 0.5\n"])
def test_keys_beside_the_robot_are_no_reason_to_ask_for_a_whole_twin(tmp_path: Path, wrong: str) -> None:
    with pytest.raises(ConfigError, match="known here: robot") as raised:
        load_vehicle(written(tmp_path / "own.yaml", wrong))
    assert "realism" not in str(raised.value)


def test_all_errors_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    wrong = """\
robot:
  colour: red
  wheel_radius_m: 0.2
  track_m: {value: 12.0, known: measured}
  antenna_m: {value: [0.1, 0.0], known: measured}
  gyro_scale: {value: 0.01, known: calibrated}
  wheel_scale: {value: 0.01, known: guessed}
  gnss_delay: {value: 0.2, known: assumed}
"""
    with pytest.raises(ConfigError) as raised:
        load_vehicle(written(tmp_path / "own.yaml", wrong))
    lines = str(raised.value).splitlines()
    assert len(lines) == 7
    for key, words in (
        ("robot.colour", "unknown key"),
        ("robot.wheel_radius_m", "how is it known"),
        ("robot.track_m.value", "out of range"),
        ("robot.antenna_m.value", "3 numbers"),
        ("robot.gyro_scale", "has no sigma; add sigma, the standard deviation of the value"),
        ("robot.wheel_scale.known", "measured, data_sheet, calibrated, assumed"),
        ("robot.gnss_delay", "write 'gnss_delay_s'"),
    ):
        assert any(key in line and words in line for line in lines), (key, lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("robot: {extends: own.yaml}\n", "comes back to this file"),
        ("robot: {extends: nobody}\n", "neither a known vehicle nor a file"),
        ("robot: {drive: tracked}\ncolour: red\n", "unknown key 'colour'"),
        ("robot: 5\n", "not a section"),
    ],
)
def test_a_file_that_leads_nowhere_is_refused_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as raised:
        load_vehicle(written(tmp_path / "own.yaml", text))
    assert "\n" not in str(raised.value)
    assert "own.yaml" in str(raised.value)


def test_what_a_log_assumes_replaces_a_measured_antenna_but_no_calibrated_one(tmp_path: Path) -> None:
    log = Overrides(antenna_m=(0.5, 0.0, 1.0))
    measured = load_vehicle(written(tmp_path / "own.yaml", SHORT))
    changed = with_overrides(measured, log)
    assert changed.sensors.gnss.antenna_m == (0.5, 0.0, 1.0)
    assert changed.robot.antenna_m is None
    text = SHORT.replace("0.6], known: measured", "0.6], known: calibrated, sigma: [0.01, 0.02]")
    calibrated = load_vehicle(written(tmp_path / "own.yaml", text))
    assert with_overrides(calibrated, log).sensors.gnss.antenna_m == (0.1, 0.02, 0.6)
    assert "where calibration found it" in geometry_notes(calibrated, log)[0]


def test_a_complete_file_says_in_its_source_that_the_antenna_is_measured(tmp_path: Path) -> None:
    for name, source, known in (
        ("warthog", "measured with a tape", "measured"),
        ("warthog", "assumed: on the top plate", None),
    ):
        raw, _ = read_vehicle(name)
        text = (Path(__file__).parents[3] / "twin/params/vehicles" / f"{name}.yaml").read_text("utf-8")
        assert raw["sensors"]["gnss"]["antenna_m"]["source"] in text
        own = text.replace("assumed: on the top plate", source)
        number = load_vehicle(written(tmp_path / "own.yaml", own)).robot.antenna_m
        assert (number and number.known) == known
    # A shipped file is for any robot of its make, wherever that has its antenna.
    assert load_vehicle("husky").robot.antenna_m is None


def test_what_a_short_file_leaves_out_is_in_proportion_to_the_robot(tmp_path: Path) -> None:
    generic, husky = load_vehicle("generic"), load_vehicle("husky")
    text = (
        "robot:\n  mass_kg: {value: 120.0, known: measured, sigma: 1.0}\n"
        "  wheel_radius_m: {value: 0.33, known: measured}\n"
    )
    large = load_vehicle(
        written(tmp_path / "large.yaml", f"{text}  track_m: {{value: 1.1, known: measured}}\n")
    )
    assert large.body.yaw_inertia_kgm2 == pytest.approx(3.0 * 4.0 * generic.body.yaw_inertia_kgm2)
    assert large.drive.torque_limit_nm == pytest.approx(6.0 * generic.drive.torque_limit_nm)
    assert large.wheel.inertia_kgm2 == pytest.approx(12.0 * generic.wheel.inertia_kgm2)
    assert large.drive.gear_ratio == generic.drive.gear_ratio
    # As quick to follow commands: the loop's gain over the inertia it moves, m R^2, is the same.
    assert large.drive.speed_loop_p_nms == pytest.approx(12.0 * generic.drive.speed_loop_p_nms)
    assert large.drive.speed_loop_i_nm == pytest.approx(12.0 * generic.drive.speed_loop_i_nm)
    top_mps = [v.drive.no_load_speed_radps * v.wheel.radius_m for v in (large, generic)]
    assert top_mps[0] == pytest.approx(top_mps[1])
    loaded = load_vehicle(
        written(tmp_path / "husky.yaml", text.replace("robot:", "robot:\n  extends: husky"))
    )
    assert loaded.drive == husky.drive  # a known robot keeps its own motors
    assert loaded.body.yaw_inertia_kgm2 == pytest.approx(2.4 * husky.body.yaw_inertia_kgm2)


@pytest.mark.parametrize("mass_kg", [0.1, 50_000.0])
@pytest.mark.parametrize(("radius_m", "track_m"), [(0.02, 0.05), (2.0, 0.05), (0.02, 5.0), (2.0, 5.0)])
def test_a_short_file_of_any_size_makes_a_whole_one(mass_kg, radius_m, track_m, tmp_path: Path) -> None:
    numbers = {"mass_kg": mass_kg, "wheel_radius_m": radius_m, "track_m": track_m}
    given = {name: {"value": value, "known": "assumed"} for name, value in numbers.items()}
    own = load_vehicle(dump_yaml(tmp_path / "own.yaml", {"robot": given}))
    assert (own.body.mass_kg, own.body.payload_max_kg) == (mass_kg, pytest.approx(mass_kg))


def test_a_file_tells_how_the_imu_is_mounted_and_what_the_robot_weighs(tmp_path: Path) -> None:
    text = (
        "robot:\n  imu_axes: ['-z', '-x', '+y']\n  imu_frame: front_imu\n"
        "  mass_kg: {value: 80.0, known: measured, sigma: 1.0}\n"
    )
    own = load_vehicle(written(tmp_path / "own.yaml", text))
    assert (own.sensors.imu.axes, own.sensors.imu.frame_id) == (("-z", "-x", "+y"), "front_imu")
    assert own.body.mass_kg == 80.0
    with pytest.raises(ConfigError, match="not a rotation"):
        load_vehicle(written(tmp_path / "bad.yaml", "robot: {imu_axes: ['+x', '+y', '-z']}\n"))


def test_the_twin_has_the_errors_that_are_known_of_a_robots_sensors(tmp_path: Path) -> None:
    text = (
        "robot:\n  extends: elevate\n  gnss_delay_s: {value: -0.3, known: calibrated, sigma: 0.01}\n"
        "  gyro_scale: {value: 0.25, known: calibrated, sigma: 0.01}\n"
        "  gyro_bias_radps: {value: 0.01, known: %s, sigma: 0.01}\n"
        "  wheel_scale: {value: 0.02, known: calibrated, sigma: 0.01}\n"
    )
    file = written(tmp_path / "own.yaml", text % "calibrated")
    short = Scenario("short", 10.0, drive=(DriveSegment(10.0, v_mps=1.0, yaw_rate_radps=0.2),))
    run, exact = (simulate(short, vehicle=vehicle, seed=2) for vehicle in (file, "elevate"))
    assert run.gnss.t_ns - exact.gnss.t_ns == pytest.approx(-0.3e9)
    read, true = (float(log.imu.gyro_radps[:, 2].mean()) for log in (run, exact))
    assert read == pytest.approx(0.8 * true + 0.01, abs=5e-4)  # the bias drawn is not scaled
    assert any("do not have wheel_scale of the vehicle's file" in note for note in run.notes)
    assumed = load_vehicle(written(tmp_path / "own.yaml", text % "assumed"))
    assert assumed.effects.keys() == {"gyro_scale/scale"}
    # An effect that the file has itself stays, as `gap` writes it.
    raw = dict(read_vehicle(file)[0])
    raw["effects"] = {"gyro_scale": {"value": 0.1, "source": "as a gap analysis finds"}}
    raw["robot"] = {**raw["robot"], "gyro_bias_radps": {"value": 0.02, "known": "measured", "sigma": 0.1}}
    again = load_vehicle(dump_yaml(tmp_path / "again.yaml", raw))
    assert again.effects == pytest.approx({"gyro_scale/scale": 0.1, "gyro_bias/constant": 0.025})
