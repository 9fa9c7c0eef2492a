"""A file that its recorder did not close, or that lost its tail, is read up to the cut, and that is said."""

from __future__ import annotations

import gzip
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from tests.datasets.readers.test_ros_containers import write_mcap
from tests.datasets.ros_bags import MAKE1, MAKE2, T0, Make, Message, write_ros2
from tests.datasets.ros_bits import ROS1

COUNT = 600
"""IMU messages, 10 ms apart."""


def drive(make: Make) -> list[Message]:
    """An IMU and an odometry, in the order of their times."""
    out: list[Message] = []
    for i in range(COUNT):
        t = T0 + i * 10_000_000
        out.append(("/imu", "sensor_msgs/msg/Imu", t, make.imu(t, gyro=(0.0, 0.0, i * 1e-3))))
        if i % 5 == 0:
            out.append(("/odom", "nav_msgs/msg/Odometry", t, make.odometry(t, 1.0, 0.1)))
    return out


def ros1_bag(path: Path, compression: str = "") -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = 20_000
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    with writer:
        ids = {}
        for topic, msgtype, t, message in drive(MAKE1):
            if topic not in ids:
                ids[topic] = writer.add_connection(topic, msgtype, typestore=ROS1)
            writer.write(ids[topic], t, ROS1.serialize_ros1(message, msgtype))
    return path


def whole_bag(tmp_path: Path, kind: str) -> Path:
    suffix, _, compression = kind.partition(" ")
    if suffix == ".bag":
        return ros1_bag(tmp_path / "whole.bag", compression)
    if suffix == ".mcap":
        return write_mcap(tmp_path / "whole.mcap", use_chunking=compression != "unchunked")
    return next(write_ros2(tmp_path / "whole", drive(MAKE2), StoragePlugin.SQLITE3).glob("*.db3"))


def assert_begins(part: Recording, whole: Recording, least: float) -> None:
    """`part` holds the first samples of `whole`, at least this share, and says where it ends."""
    assert part.imu is not None
    assert whole.imu is not None
    n = len(part.imu)
    assert n >= least * len(whole.imu)
    np.testing.assert_array_equal(part.imu.t_ns, whole.imu.t_ns[:n])
    np.testing.assert_array_equal(part.imu.gyro_radps, whole.imu.gyro_radps[:n])
    (note,) = [note for note in part.notes if "cut off" in note]
    assert f"its data end at t = {part.duration_s():.3f} s" in note


@pytest.mark.parametrize("kind", [".bag", ".bag BZ2", ".bag LZ4", ".mcap", ".mcap unchunked", ".db3"])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.3, 0.5, 0.9, 0.999])
def test_bag_that_lost_its_tail(tmp_path: Path, kind: str, share: float) -> None:
    path = whole_bag(tmp_path, kind)
    whole = open_recording(path)
    assert not any("cut off" in note for note in whole.notes)
    cut = tmp_path / f"cut{path.suffix}"
    content = path.read_bytes()
    cut.write_bytes(content[: int(len(content) * share)])
    if share < 0.1:
        with pytest.raises(TerrafusionError) as caught:
            open_recording(cut)
        assert str(cut) in str(caught.value)
        assert "\n" not in str(caught.value)
    else:
        assert_begins(open_recording(cut), whole, share - 0.15)


@pytest.mark.parametrize("lost", [0, 100, 7000])
def test_ros1_bag_that_was_not_closed(tmp_path: Path, lost: int) -> None:
    """As rosbag leaves it: no index, no counts, and the last chunk without its size."""
    path = ros1_bag(tmp_path / "whole.bag")
    whole = open_recording(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    index_at = int.from_bytes(content[at : at + 8], "little")
    content[at : at + 8] = bytes(8)
    for name in (b"conn_count=", b"chunk_count="):
        place = content.index(name) + len(name)
        content[place : place + 4] = bytes(4)
    content = content[:index_at]
    size_at = content.rindex(b"size=") + len(b"size=")
    data_at = max(size_at + 4, content.rindex(b"compression=none") + len(b"compression=none"))
    used = int.from_bytes(content[data_at : data_at + 4], "little")
    content[size_at : size_at + 4] = content[data_at : data_at + 4] = bytes(4)
    active = tmp_path / "active.bag"
    active.write_bytes(content[: data_at + 4 + used - lost])
    assert_begins(open_recording(active), whole, 0.9)


def test_database_with_its_changes_beside_it(tmp_path: Path) -> None:
    """As the recorder leaves it when it is killed in SQLite's write-ahead mode."""
    path = whole_bag(tmp_path, ".db3")
    whole = open_recording(path)
    killed = tmp_path / "killed_0.db3"
    database = sqlite3.connect(tmp_path / "live.db3")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    database.executescript("".join(f"{line}\n" for line in sqlite3.connect(path).iterdump()))
    for ending in ("", "-wal"):
        shutil.copyfile(tmp_path / f"live.db3{ending}", f"{killed}{ending}")
    database.close()
    before = {file.name: file.read_bytes() for file in tmp_path.glob("killed*")}
    assert_begins(open_recording(killed), whole, 1.0)
    assert {file.name: file.read_bytes() for file in tmp_path.glob("killed*")} == before


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_folder_of_a_recorder_that_was_killed(tmp_path: Path, plugin: StoragePlugin) -> None:
    """No metadata.yaml, and its last file is cut off."""
    folder = write_ros2(tmp_path / "rosbag2", drive(MAKE2), plugin)
    whole = open_recording(folder)
    (folder / "metadata.yaml").unlink()
    (file,) = folder.iterdir()
    file = file.rename(folder / f"rosbag2_0{file.suffix}")
    assert_begins(open_recording(folder), whole, 1.0)
    if file.suffix == ".db3":
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        assert_begins(open_recording(folder), whole, 0.35)


def log_folder(tmp_path: Path, imu: bytes, name: str = "imu.csv") -> Path:
    (tmp_path / "meta.yaml").write_text("start_ns: 1700000000000000000\n")
    (tmp_path / name).write_bytes(imu)
    return tmp_path


ROWS = "t_s,gyro_x_radps,gyro_y_radps,gyro_z_radps\n" + "".join(
    f"{i * 0.01:.2f},{i * 1e-3:.3f},{i % 7 * 1e-2:.2f},0.25\n" for i in range(2000)
)


@pytest.mark.parametrize("lost", [4, 8, 16])
def test_log_folder_whose_last_row_is_cut(tmp_path: Path, lost: int) -> None:
    recording = open_recording(log_folder(tmp_path, ROWS[:-lost].encode()))
    assert recording.imu is not None
    assert len(recording.imu) == (2000 if lost == 4 else 1999)
    note = "no line end" if lost == 4 else "its data end in line 2000, t = 19.980 s"
    assert any(note in one for one in recording.notes)


@pytest.mark.parametrize("share", [0.3, 0.8, 0.999])
def test_packed_log_folder_that_is_cut(tmp_path: Path, share: float) -> None:
    packed = gzip.compress(ROWS.encode())
    recording = open_recording(log_folder(tmp_path, packed[: int(share * len(packed))], "imu.csv.gz"))
    assert recording.imu is not None
    n = len(recording.imu)
    assert n > (share - 0.2) * 2000
    np.testing.assert_array_equal(recording.imu.gyro_radps[:, 0], np.round(np.arange(n) * 1e-3, 3))
    (note,) = [one for one in recording.notes if "cut off" in one]
    assert f"t = {(n - 1) * 0.01:.3f} s" in note


def test_zeros_for_the_end_of_a_log(tmp_path: Path) -> None:
    """A file system that lost power gives the length of a file and not its last bytes."""
    recording = open_recording(log_folder(tmp_path, ROWS.encode()[:-16] + bytes(3000)))
    assert recording.imu is not None
    assert len(recording.imu) == 1999
    assert any("t = 19.980 s" in note for note in recording.notes)
