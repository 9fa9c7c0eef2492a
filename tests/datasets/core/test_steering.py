"""The steering channel: table, log folder, bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from terrafusion.datasets.core.channels import Steering, Wheels
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.messages import SteeringSample
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros.joints import steering_joints
from terrafusion.datasets.writers import write_log_folder, write_mcap
from tests.datasets.ros_bags import MAKE1, MAKE2, ROS1, ROS2, T0, imu_messages, write_ros1, write_ros2
from tests.differences import differences

DEFINITION = """float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
"""
STAMPED = "std_msgs/Header header\nAckermannDrive drive\n"
KIND = "ackermann_msgs/msg/AckermannDrive"


def drive(names: tuple[str, ...] = ("angle",)) -> Recording:
    t = 10**18 + np.arange(40) * 50_000_000
    angle = 0.1 * np.sin(np.arange(40) * 0.2)[:, None] * np.arange(1, len(names) + 1)
    wheels = Wheels(t, np.ones((40, 4)), Wheels.LAYOUTS[1], "mps")
    own = Overrides(0.3, 1.5, drive="ackermann", wheelbase_m=2.7, steering_ratio=15.0)
    return Recording("bend", 10**18, wheels=wheels, steering=Steering(t, angle, names), overrides=own)


@pytest.mark.parametrize("names", Steering.LAYOUTS)
def test_log_folder_and_mcap_hold_it(tmp_path: Path, names: tuple[str, ...]) -> None:
    recording = drive(names)
    folder = write_log_folder(recording, tmp_path / "bend")
    header = ",".join(["t_s", *(f"{name}_rad" for name in names)])
    assert (folder / "steering.csv").read_text().startswith(header + "\n")
    assert differences(open_recording(folder), recording) == []
    write_mcap(recording, tmp_path / "bend.mcap")
    assert differences(open_recording(tmp_path / "bend.mcap"), recording) == []
    plain = open_recording(tmp_path / "bend.mcap", topics={"steering": "/steering/joint_states"})
    assert plain.steering is not None
    assert plain.steering.names == names
    np.testing.assert_array_equal(plain.steering.angle_rad, recording.steering.angle_rad)


def test_it_is_shown_and_given_as_messages() -> None:
    recording = drive()
    assert "steering" in repr(recording)
    assert list(recording.to_pandas()["steering"].columns) == ["angle_rad"]
    assert sum(isinstance(message, SteeringSample) for message in recording.messages()) == 40


def test_axle_angles() -> None:
    t = np.array([0], dtype=np.int64)
    four = Steering(t, np.array([[0.2, 0.4, -0.1, -0.3]]), Wheels.LAYOUTS[1])
    np.testing.assert_allclose(four.axle_angles_rad(), [[0.3, -0.2]])
    wheel = Steering(t, np.array([[1.5]]), ("steering_wheel",))
    np.testing.assert_allclose(wheel.axle_angles_rad(15.0), [[0.1, 0.0]])


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("t_s,front_rad\n0,0.1\n", "front_rad, rear_rad"),
        ("t_s,angle_deg\n0,0.1\n", "angle_deg"),
        ("t_s\n0\n", "not a layout"),
    ],
)
def test_a_broken_table_is_refused(tmp_path: Path, text: str, word: str) -> None:
    folder = write_log_folder(drive(), tmp_path / "log")
    (folder / "steering.csv").write_text(text)
    with pytest.raises(DataError, match=word):
        open_recording(folder)


def test_an_unknown_drive_is_refused(tmp_path: Path) -> None:
    folder = write_log_folder(drive(), tmp_path / "log")
    meta = folder / "meta.yaml"
    meta.write_text(meta.read_text().replace("ackermann", "legs"))
    with pytest.raises(ConfigError, match="four_wheel_steer"):
        open_recording(folder)


@pytest.mark.parametrize(
    ("joints", "found"),
    [
        (["left_steering_hinge_joint", "right_steering_hinge_joint"], ("angle",)),
        (["fl_steer", "fr_steer", "rl_steer", "rr_steer"], Wheels.LAYOUTS[1]),
        (["front_steering_joint", "rear_steering_joint", "front_left_wheel_joint"], ("front", "rear")),
        (["front_steer"], ("angle",)),
        (["steering_joint"], ("angle",)),
        (["steering_wheel_joint"], ("steering_wheel",)),
        (["front_left_wheel", "front_right_wheel"], None),
        (["left_steering_joint", "arm"], None),
    ],
)
def test_joint_names(joints: list[str], found: tuple[str, ...] | None) -> None:
    assert next(iter(steering_joints(joints)), None) == found


def test_wheels_and_steering_of_one_joint_state(tmp_path: Path) -> None:
    names = ["rear_left_wheel", "rear_right_wheel", "left_steering_hinge", "right_steering_hinge"]
    kind = "sensor_msgs/msg/JointState"
    messages = [
        ("/joint_states", kind, t, MAKE1.joints(t, names, [0.0, 0.0, 0.2, 0.1], [3.0, 4.0, 0.0, 0.0]))
        for t in (T0, T0 + 10**8)
    ]
    both = {"joint.left": "rear_left_wheel", "joint.right": "rear_right_wheel"}
    recording = open_recording(write_ros1(tmp_path / "a.bag", messages), topics=both)
    assert recording.wheels is not None
    assert recording.wheels.speed[0].tolist() == [3.0, 4.0]
    assert recording.steering is not None
    np.testing.assert_allclose(recording.steering.angle_rad, [[0.15], [0.15]])


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("stamped", [True, False])
def test_ackermann_drive(tmp_path: Path, ros: int, stamped: bool) -> None:
    """A measured AckermannDrive gives angle and speed; one that is a command gives nothing."""
    make, store = (MAKE1, ROS1) if ros == 1 else (MAKE2, ROS2)
    if KIND not in store.types:
        store.register(get_types_from_msg(DEFINITION, KIND))
        store.register(get_types_from_msg(STAMPED, f"{KIND}Stamped"))
    kind = f"{KIND}Stamped" if stamped else KIND
    messages = imu_messages(make, n=5)
    for t in (T0, T0 + 20_000_000):
        message = make.new(KIND, 0.25, 0.0, 1.5, 0.0, 0.0)
        message = make.new(kind, make.header(t, "base_link"), message) if stamped else message
        messages += [("/vehicle/state", kind, t, message), ("/ackermann_cmd", kind, t, message)]
    write = write_ros1 if ros == 1 else write_ros2
    recording = open_recording(write(tmp_path / "a.bag", messages))
    assert recording.steering is not None
    assert recording.steering.angle_rad.tolist() == [[0.25], [0.25]]
    assert recording.wheels is not None
    assert recording.wheels.names == ("speed",)
    assert recording.wheels.speed.tolist() == [[1.5], [1.5]]
    assert "steering /vehicle/state" in recording.source
    commands = [message for message in messages if message[0] != "/vehicle/state"]
    unasked = open_recording(write(tmp_path / "b.bag", commands))
    option = "--topic wheels=/ackermann_cmd --topic steering=/ackermann_cmd uses this"
    assert any(option in note for note in unasked.notes)
