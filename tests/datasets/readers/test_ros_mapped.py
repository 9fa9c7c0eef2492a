"""Fields of a bag's messages, of any type, by a column map."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.readers import open_recording
from tests.datasets.ros_bags import MAKE2, ROS2, T0, imu_messages, write_ros2

N, TICKS = 40, 16_384
OWN = get_typestore(Stores.ROS2_HUMBLE)
OWN.register(get_types_from_msg("std_msgs/Header header\nfloat32[4] rpm\nstring mode\n", "my/msg/Wheels"))
JOINED = "channels: {wheels: {left_rad: /left_ticks.data, right_rad: /right_ticks.data}}\n"


def ticks(apart_ns: int = 0, lost: int = 0) -> list[Any]:
    """Counters of 16 bits of two sides that turn 0.05 and 0.1 turns a message, as messages of their own."""
    found = list[Any]()
    for k in range(N):
        for name, turns, late_ns in (("left", 0.05, 0), ("right", 0.1, apart_ns)):
            count = (30_000 + round(turns * k * TICKS)) % 65_536 - 32_768
            message = MAKE2.new("std_msgs/msg/Int32", count)
            if not (name == "right" and k < lost):
                found.append((f"/{name}_ticks", "std_msgs/msg/Int32", T0 + k * 50_000_000 + late_ns, message))
    return found


def mapped(tmp_path: Path, text: str) -> Path:
    (path := tmp_path / "map.yaml").write_text(text)
    return path


@pytest.mark.parametrize(("apart_ns", "lost"), [(0, 0), (3_000_000, 2)])
def test_counters_in_messages_of_their_own_are_wheels(tmp_path: Path, apart_ns: int, lost: int) -> None:
    messages = [*imu_messages(MAKE2, n=200), *ticks(apart_ns, lost)]
    bag = write_ros2(tmp_path / "bag", sorted(messages, key=lambda message: message[2]))
    noted = " ".join(open_recording(bag).notes)
    proposed = noted.partition("by --columns FILE: {")[2].partition("}}}} (there are /left_ticks.data")[0]
    text = f"{proposed}}}}}}}\nwheel_radius_m: 0.2\n".replace("1/1024", f"1/{TICKS}")
    recording = open_recording(bag, columns=mapped(tmp_path, text))
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.overrides.wheel_radius_m == 0.2
    assert len(recording.wheels) == N - lost - 1
    rates = [2.0 * np.pi * turns / 0.05 for turns in (0.05, 0.1)]
    np.testing.assert_allclose(recording.wheels.speed[1:], np.tile(rates, (N - lost - 2, 1)), atol=0.02)
    apart = f"/right_ticks beside those of /left_ticks, {apart_ns * 1e-6:.3g} ms apart (median)"
    left = f", {lost} without one left out" * bool(lost)
    assert f"wheels: messages of {apart}{left}" in recording.notes


def own_bag(tmp_path: Path) -> Path:
    path = tmp_path / "own"
    with Writer2(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        wheels = writer.add_connection("/base/wheels", "my/msg/Wheels", typestore=OWN)
        imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=ROS2)
        for k in range(N):
            t_ns = T0 + k * 50_000_000
            rpm = np.array([60.0, 30.0, 60.0, -30.0], dtype=np.float32)
            message = OWN.types["my/msg/Wheels"](MAKE2.header(t_ns, "base"), rpm, "auto")
            writer.write(wheels, t_ns + 7_000_000, OWN.serialize_cdr(message, "my/msg/Wheels"))
            writer.write(imu, t_ns, ROS2.serialize_cdr(MAKE2.imu(t_ns), "sensor_msgs/msg/Imu"))
    return path


def test_an_array_in_a_message_of_ones_own_is_read_at_its_header_stamps(tmp_path: Path) -> None:
    column = "{unit: rpm, column: '/base/wheels.rpm[%d]'%s}"
    sides = ("front_left", "front_right", "rear_left", "rear_right")
    entries = [column % (k, ", sign: '-'" * (k == 3)) for k in range(4)]
    fields = ", ".join(f"{side}_radps: {entry}" for side, entry in zip(sides, entries, strict=True))
    text = f"channels: {{wheels: {{{fields}}}}}\n"
    recording = open_recording(own_bag(tmp_path), columns=mapped(tmp_path, text))
    assert recording.wheels is not None
    assert recording.wheels.t_ns[0] == T0
    np.testing.assert_allclose(recording.wheels.speed, np.tile(np.pi * np.array([2, 1, 2, 1]), (N, 1)))
    assert not any(note.startswith("wheels: no topic") for note in recording.notes)


@pytest.mark.parametrize(
    ("column", "match"),
    [
        ("/base/wheels.speed", r"have no '/base/wheels.speed'; they have /base/wheels.rpm\[0\], "),
        ("/base/wheels.rpm[7]", r"have no '/base/wheels.rpm\[7\]'"),
        ("/wheels.rpm[0]", r"names no topic with messages; .*topics here: /base/wheels \(my/msg/Wheels\)"),
        ("/base/wheels.rpm", r"holds 4 numbers a message; give one number, such as /base/wheels.rpm\[0\]"),
        ("/base/wheels.mode", "holds texts"),
    ],
)
def test_columns_that_are_no_number_of_a_message_are_refused(tmp_path: Path, column: str, match: str) -> None:
    text = f"channels: {{wheels: {{speed_mps: '{column}'}}}}\n"
    with pytest.raises(DataError, match=match):
        open_recording(own_bag(tmp_path), columns=mapped(tmp_path, text))


def test_a_map_of_a_table_is_refused_for_a_bag(tmp_path: Path) -> None:
    bag = write_ros2(tmp_path / "bag", ticks())
    with pytest.raises(ConfigError, match=re.escape("'time' is of tables, not of bags; remove it")):
        open_recording(bag, columns=mapped(tmp_path, f"time: t\n{JOINED}"))
