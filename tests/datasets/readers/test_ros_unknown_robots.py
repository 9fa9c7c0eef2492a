"""Bags of robots that do things their own way: wrapped angles, other names, other types."""

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording
from tests.datasets.ros_bags import MAKE2, T0, Message, write_ros2

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
