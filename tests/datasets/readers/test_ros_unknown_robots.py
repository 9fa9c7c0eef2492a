"""Bags of robots that do things their own way: wrapped angles, other names, other types."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.main import app
from tests.datasets.ros_bags import MAKE2, T0, Message, imu_messages, write_ros2

JOINTS = "sensor_msgs/msg/JointState"
TURN = 2.0 * np.pi


def joint_bag(path: Path, angle: np.ndarray, speed: np.ndarray | None = None) -> Path:
    """JointState at 10 Hz: angles (N, 2) of left and right, and speeds where they are given."""
    messages: list[Message] = []
    for k, each in enumerate(angle):
        t = T0 + k * 10**8
        rates = [] if speed is None else speed[k].tolist()
        messages.append(("/base/joints", JOINTS, t, MAKE2.joints(t, ["left", "right"], each.tolist(), rates)))
    return write_ros2(path, messages)


@pytest.mark.parametrize("least", [0.0, -np.pi])
def test_angles_of_joints_that_start_again_count_turns(tmp_path: Path, least: float) -> None:
    true = np.outer(np.arange(100), [0.5, 0.7])
    wrapped = (true - least) % TURN + least
    wheels = open_recording(joint_bag(tmp_path / "bag", wrapped)).wheels
    assert wheels is not None
    np.testing.assert_allclose(wheels.speed, np.tile([5.0, 7.0], (99, 1)), atol=1e-6)
    assert wheels.angle_rad is not None
    np.testing.assert_allclose(np.diff(wheels.angle_rad, axis=0), np.tile([0.5, 0.7], (98, 1)), atol=1e-9)


def test_angles_that_do_not_tell_give_way_to_speeds(tmp_path: Path) -> None:
    true = np.outer(np.arange(100), [2.7, 2.9])
    recording = open_recording(joint_bag(tmp_path / "bag", true % TURN, np.full((100, 2), 28.0)))
    assert recording.wheels is not None
    assert recording.wheels.angle_rad is None
    assert any(note.endswith("only the speeds are used") for note in recording.notes)
    with pytest.raises(
        DataError, match=r"/base/joints: the angles of left lie in one turn.*log wheel speeds"
    ):
        open_recording(joint_bag(tmp_path / "alone", true % TURN))


def bag_beside_imu(path: Path, topic: str, msgtype: str, *messages: Any) -> Path:
    """An IMU and another topic, at 20 Hz."""
    found = [(topic, msgtype, T0 + k * 50_000_000, message) for k, message in enumerate(messages)]
    return write_ros2(path, sorted([*imu_messages(MAKE2, n=100), *found], key=lambda one: one[2]))


def wheel_note(recording: Recording) -> str:
    """What the reader says of wheels."""
    return next(note for note in recording.notes if note.startswith("wheels: "))


def test_joints_that_name_no_side_are_listed_with_the_option_that_names_them(tmp_path: Path) -> None:
    messages = [MAKE2.joints(T0, ["j1", "j2"], [], [1.0, 2.0]) for _ in range(20)]
    bag = bag_beside_imu(tmp_path / "bag", "/base/joints", JOINTS, *messages)
    unnamed = open_recording(bag)
    assert unnamed.wheels is None
    assert "the joints of /base/joints (j1, j2) name no side" in wheel_note(unnamed)
    assert "--topic joint.left=NAME --topic joint.right=NAME" in wheel_note(unnamed)
    named = open_recording(bag, topics={"joint.left": "j1", "joint.right": "j2"})
    assert named.wheels is not None
    assert named.wheels.speed[0].tolist() == [1.0, 2.0]


def test_topics_of_other_types_are_named_as_not_used(tmp_path: Path) -> None:
    speeds = [MAKE2.new("std_msgs/msg/Float64", 1.0)] * 20
    note = wheel_note(
        open_recording(bag_beside_imu(tmp_path / "bag", "/left/vel", "std_msgs/msg/Float64", *speeds))
    )
    assert "not used are /left/vel (std_msgs/msg/Float64), of types that are not read" in note
    assert "record the speeds as sensor_msgs/msg/JointState" in note


def test_a_plain_twist_is_used_where_it_is_asked_for(tmp_path: Path) -> None:
    """It has no stamps and is a command mostly: the note names the option, and its times are of arrival."""
    twist = MAKE2.new("geometry_msgs/msg/Twist", MAKE2.vector(1.0, 0, 0), MAKE2.vector(0, 0, 0.5))
    bag = bag_beside_imu(tmp_path / "bag", "/speed", "geometry_msgs/msg/Twist", *[twist] * 20)
    unasked = open_recording(bag)
    assert unasked.wheels is None
    assert "--topic wheels=/speed uses this geometry_msgs/msg/Twist" in wheel_note(unasked)
    asked = open_recording(bag, topics={"wheels": "/speed"})
    assert asked.wheels is not None
    assert asked.wheels.speed[0].tolist() == [0.75, 1.25]
    assert asked.wheels.t_ns[0] == T0
    assert "wheels: /speed has no stamps; its times are those of arrival" in asked.notes


def test_inspect_and_init_say_what_a_bag_lacks(tmp_path: Path) -> None:
    messages = [MAKE2.joints(T0, ["j1", "j2"], [], [1.0, 2.0]) for _ in range(20)]
    bag = bag_beside_imu(tmp_path / "bag", "/base/joints", JOINTS, *messages)
    page = CliRunner().invoke(app, ["inspect", str(bag)])
    assert page.exit_code == 0
    assert "missing   wheels, which replay and init need" in page.output
    for command in ("init", "replay"):
        vehicle = [] if command == "init" else ["--vehicle", "husky"]
        done = CliRunner().invoke(app, [command, str(bag), *vehicle, "--out", str(tmp_path / "out.yaml")])
        assert done.exit_code == 1
        assert "no wheel speeds; " in str(done.exception)
        assert "--topic joint.left=NAME" in str(done.exception)
