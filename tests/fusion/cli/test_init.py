"""`terrafusion init`: the first log of a robot gives its vehicle file, or one line that says why not."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner, Result

from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import axes_matrix
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros import streams
from terrafusion.datasets.writers import write_log_folder
from terrafusion.fusion.cli import init_page
from terrafusion.fusion.cli.main import app
from terrafusion.twin.model.vehicle import load_vehicle
from tests.datasets.ros_bags import MAKE2, Message, imu_messages, odometry_messages, write_ros2

HUSKY = ("-z", "-x", "+y")
RADIUS_M = 0.175
ROOT = Path(__file__).parents[3]
FIX = "sensor_msgs/msg/NavSatFix"


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["init", *map(str, words)])


def file_of(path: Path) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = YAML(typ="safe", pure=True).load(path)["robot"]
    return found


@pytest.fixture(scope="module")
def drive(chirp: Recording) -> Recording:
    """A drive of the nominal platform with changes of speed, under a name that nobody knows."""
    return dataclasses.replace(chirp, vehicle="rover_9", truth=None)


def sensor_frame(recording: Recording, axes: tuple[str, ...]) -> Recording:
    """The recording as an IMU gives it whose `axes` lie along body x, y, z."""
    imu = recording.imu
    assert imu is not None
    R = axes_matrix(axes)
    turned = dataclasses.replace(imu, gyro_radps=imu.gyro_radps @ R, accel_mps2=imu.accel_mps2 @ R)
    return dataclasses.replace(recording, imu=turned)


def namespaced_bag(path: Path, recording: Recording) -> Path:
    """A bag of a robot `/rover` with two IMUs: one mounted as on the husky, one along the body."""
    turned = sensor_frame(recording, HUSKY).imu
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    assert imu is not None
    assert turned is not None
    assert wheels is not None
    assert gnss is not None
    messages: list[Message] = []
    for topic, one in (("/rover/front/imu", turned), ("/rover/rear/imu", imu)):
        frame = f"{topic.split('/')[2]}_imu"
        for t, gyro, accel in zip(one.t_ns.tolist(), one.gyro_radps, one.accel_mps2, strict=True):
            messages.append((topic, "sensor_msgs/msg/Imu", t, MAKE2.imu(t, gyro, accel, frame)))
    names = [f"{name}_wheel_joint" for name in wheels.names]
    for t, speed in zip(wheels.t_ns.tolist(), wheels.speed, strict=True):
        message = MAKE2.joints(t, names, [], speed.tolist())
        messages.append(("/rover/joint_states", "sensor_msgs/msg/JointState", t, message))
    for t, (east, north, up) in zip(gnss.t_ns.tolist(), gnss.enu_m, strict=True):
        lat, lon = (
            48.0 + np.degrees(north / 6.37e6),
            11.0 + np.degrees(east / 6.37e6 / np.cos(np.radians(48))),
        )
        messages.append(("/rover/fix", FIX, t, MAKE2.fix(t, lat, lon, 500.0 + up)))
    messages.sort(key=lambda message: message[2])
    write_ros2(path, messages)
    return path


@pytest.fixture(scope="module")
def bag(drive: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return namespaced_bag(tmp_path_factory.mktemp("bag") / "first_drive", drive)


def test_two_imus_are_listed_and_one_must_be_chosen(bag: Path, tmp_path: Path) -> None:
    done = run(bag, "--out", tmp_path / "own.yaml")
    assert done.exit_code == 1
    error = str(done.exception)
    assert "2 sensors of one kind: /rover/front/imu (100 Hz), /rover/rear/imu (100 Hz)" in error
    assert "choose with --topic imu=/rover/front/imu or --topic imu=/rover/rear/imu" in error
    assert not (tmp_path / "own.yaml").exists()


def test_mounting_and_radius_of_an_unknown_robot_in_a_bag(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "own.yaml"
    done = run(bag, "--topic", "imu=/rover/front/imu", "--track", "0.51", "--mass", "32", "--out", out)
    assert done.exit_code == 0, done.exception
    robot = file_of(out)
    assert robot["imu_axes"] == list(HUSKY)
    assert robot["imu_frame"] == "front_imu"
    assert robot["topics"] == {"imu": "/rover/front/imu"}
    assert robot["yaw_factor"]["value"] == pytest.approx(0.6, abs=0.1)  # by the gyro as it is mounted
    radius = robot["wheel_radius_m"]
    assert radius["known"] == "calibrated"
    assert radius["value"] == pytest.approx(RADIUS_M, rel=0.03)
    assert robot["track_m"] == {"value": 0.51, "known": "measured"}
    assert all(" # " in line for line in out.read_text().splitlines()[2:])
    schema = json.loads((ROOT / "docs" / "schemas" / "vehicle.schema.json").read_text())
    jsonschema.validate({"robot": robot}, schema)
    vehicle = load_vehicle(out)
    assert (vehicle.name, vehicle.body.mass_kg, vehicle.sensors.imu.axes) == ("own", 32.0, HUSKY)
    again = open_recording(bag, rig=vehicle.rig())  # the file holds the topic, too
    assert again.imu is not None
    np.testing.assert_allclose(again.imu.accel_mps2.mean(axis=0), (0.0, 0.0, 9.8), atol=0.2)
    assert "assumed   drive = skid_steer" in done.output
    assert "verdict: " in done.output
    assert done.output.splitlines()[-1].startswith(f"next: terrafusion replay {bag} --vehicle {out}")


def test_the_effective_track_is_that_of_the_radius_found(drive: Recording, tmp_path: Path) -> None:
    log = write_log_folder(drive, tmp_path / "log")
    factors = []
    for radius in ([], ["--wheel-radius", str(RADIUS_M)]):
        done = run(log, "--out", tmp_path / "own.yaml", "--no-verdict", "--force", *radius)
        assert done.exit_code == 0, done.exception
        factors.append(file_of(tmp_path / "own.yaml")["yaw_factor"]["value"])
    assert factors[0] == pytest.approx(factors[1], rel=0.02)


def test_velocities_of_another_frame_are_repaired_by_a_command(
    drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A warning only, but the estimator would follow them."""
    monkeypatch.setattr("terrafusion.fusion.init.vehicle._calibrated", lambda *args: (None, ()))
    gnss = drive.gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    swapped = dataclasses.replace(gnss, velocity_enu_mps=gnss.velocity_enu_mps[:, [1, 0, 2]])
    log = write_log_folder(dataclasses.replace(drive, gnss=swapped), tmp_path / "log")
    done = run(log, "--out", tmp_path / "own.yaml", "--no-verdict")
    assert done.exit_code == 0, done.exception
    assert "velocities have east and north swapped" in done.output
    assert f"\nnext: terrafusion convert {log} log_fixed --apply-fixes" in done.output


def test_a_wrong_mounting_in_a_log_folder_is_repaired_by_a_command(drive: Recording, tmp_path: Path) -> None:
    log = write_log_folder(sensor_frame(drive, HUSKY), tmp_path / "log")
    out = tmp_path / "own.yaml"
    done = run(log, "--out", out, "--wheel-radius", "0.2", "--no-verdict")
    assert done.exit_code == 0, done.exception
    robot = file_of(out)
    assert "imu_axes" not in robot  # the columns of a log folder are in body axes by contract
    assert robot["wheel_radius_m"] == {"value": 0.2, "known": "measured"}
    assert not [line for line in done.output.splitlines() if line.startswith("note      repaired")]
    assert robot["wheel_scale"]["value"] == pytest.approx(RADIUS_M / 0.2 - 1.0, abs=0.03)
    assert "gravity stands on" in done.output
    lines = done.output.splitlines()
    assert lines[-2].startswith("next: terrafusion convert")
    assert lines[-1].startswith("then: terrafusion replay log_fixed")
    convert = CliRunner().invoke(
        app, ["convert", str(log), str(tmp_path / "fixed"), "--apply-fixes", "--vehicle", str(out)]
    )
    assert convert.exit_code == 0
    assert "imu-axes" in convert.output


def test_what_is_wrong_is_one_line(drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    log = write_log_folder(drive, tmp_path / "log")
    (tmp_path / "there.yaml").write_text("robot: {}\n")
    (tmp_path / "file").write_text("")
    for words, expected in (
        (("nowhere.bag", "--out", "a.yaml"), "no such file or folder"),
        ((log, "--out", "there.yaml"), "--force"),
        ((log, "--out", "a.json"), "no YAML file"),
        ((log, "--out", "file/a.yaml"), "cannot be written"),
    ):
        done = run(*words)
        assert done.exit_code == 1, words
        assert expected in str(done.exception), words
        assert "\n" not in str(done.exception)
    still = write_log_folder(dataclasses.replace(drive, wheels=None), tmp_path / "still")
    done = run(still)
    assert done.exit_code == 1
    assert "no wheel speeds; add wheels.csv" in str(done.exception)
    for flag, text, expected in (
        ("--drive", "skid", "skid_steer"),
        ("--track", "51cm", "0.12:data_sheet"),
        ("--antenna", "0.1,0.2", "0.1,0,0.6"),
        ("--track", "51", "[0.05, 5]"),
    ):
        done = run(log, flag, text)
        assert done.exit_code == 2, flag
        assert expected in done.output
    assert (tmp_path / "there.yaml").read_text() == "robot: {}\n"
    assert not (tmp_path / "my_robot.yaml").exists()


def test_a_field_log_of_a_robot_by_another_name(tmp_path: Path) -> None:
    """The first minutes of a husky on a car park, whose log is read as if nobody had heard of it."""
    data = os.environ.get("TERRAFUSION_DATA")
    if not data:
        pytest.skip("TERRAFUSION_DATA is not set")
    recording = open_recording(Path(data) / "husky_parkinglot" / "test1.bag")
    end_ns = recording.start_ns + 220 * 10**9
    first = {name: one.between(recording.start_ns, end_ns) for name, one in recording.channels().items()}
    unknown = dataclasses.replace(recording, vehicle="rover_9", overrides=Overrides(), **first)
    log = write_log_folder(unknown, tmp_path / "log")
    out = tmp_path / "own.yaml"
    done = run(log, "--out", out, "--antenna", "0.25,0,0.22")
    assert done.exit_code == 0, done.exception
    robot = file_of(out)
    assert robot["antenna_m"]["known"] == "measured"
    assert robot["wheel_scale"]["known"] == "calibrated"
    assert robot["track_m"] == {"value": 0.55, "known": "assumed"}
    assert "verdict: good" in done.output


def test_a_bag_is_decoded_once(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[str] = []

    def counted(container: Any, asked: dict[Any, Any], enough: int | None = None) -> Any:
        decoded.extend(topic for topic, _ in asked)
        return decode(container, asked, enough)

    decode = streams.decode_streams
    monkeypatch.setattr(streams, "decode_streams", counted)
    done = run(bag, "--out", tmp_path / "rover.yaml", "--topic", "imu=/rover/front/imu", "--no-verdict")
    assert done.exit_code == 0, done.output
    assert len(decoded) == len(set(decoded)) >= 4


def test_the_user_is_asked_on_a_terminal(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafusion.fusion.cli.init_page.interactive", lambda: True)
    out = tmp_path / "own.yaml"
    answers = "3\n2\ntracked\n51 cm\n0.51:data_sheet\n\n\n"
    done = CliRunner().invoke(app, ["init", str(bag), "--out", str(out), "--no-verdict"], input=answers)
    assert done.exit_code == 0, done.exception
    robot = file_of(out)
    assert robot["topics"] == {"imu": "/rover/rear/imu"}
    assert "imu_axes" not in robot
    assert (robot["drive"], robot["track_m"]) == ("tracked", {"value": 0.51, "known": "data_sheet"})
    assert robot["mass_kg"] == {"value": 40.0, "known": "assumed"}
    assert "verdict" not in done.output


def test_the_wheels_of_one_robot_choose_its_other_topics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two robots the first has two IMUs, which are no matter of the second."""
    messages = [m for end in ("front", "rear") for m in imu_messages(MAKE2, f"/a/{end}/imu")]
    messages += imu_messages(MAKE2, "/b/imu") + odometry_messages(MAKE2, "/a/odom")
    path = write_ros2(tmp_path / "two", messages + odometry_messages(MAKE2, "/b/odom"))
    monkeypatch.setattr(init_page, "interactive", lambda: True)
    monkeypatch.setattr("typer.prompt", lambda *_, **__: 2)
    assert init_page.choose_sensors(str(path), {}) == {"wheels": "/b/odom"}
