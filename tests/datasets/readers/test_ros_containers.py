"""Every container a bag can be in gives every message; broken and hostile ones are told."""

from __future__ import annotations

import bz2
import struct
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros.raw import BagContainer, BagError, decompress, zstd
from terrafusion.datasets.readers.ros.ros1 import Ros1File
from terrafusion.datasets.readers.ros.ros2 import open_container
from terrafusion.datasets.readers.ros.streams import read_streams
from tests.datasets.ros_bags import MAKE1, imu_messages, write_ros1
from tests.datasets.ros_bits import ROS1, ROS2, T0, assert_same, imu, serialized

MIX = (("/imu", "sensor_msgs/msg/Imu", 5), ("/js", "sensor_msgs/msg/JointState", 20),
       ("/say", "std_msgs/msg/String", 50))  # fmt: skip


def mixed(store: Any, n: int = 400) -> list[tuple[str, str, int, bytes]]:
    """Messages of three topics in the order of receipt, some of changing length."""
    new = store.types
    out = []
    for topic, msgtype, period_ms in MIX:
        for i in range(n * 5 // period_ms):
            t = T0 + i * period_ms * 1_000_000
            message = imu(store, ("imu_link", "base_link", "é")[i % 3])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(t, 10**9)
            if msgtype == "sensor_msgs/msg/JointState":
                names = ["left_wheel", "right_wheel", "arm"][: 2 + i % 2]
                speed = np.arange(len(names)) + float(i)
                message = new[msgtype](message.header, names, speed, -speed, np.zeros(0))
            elif msgtype == "std_msgs/msg/String":
                message = new[msgtype]("x" * (i % 7))
            encoding = "ros1" if store is ROS1 else "cdr little"
            out.append((topic, msgtype, t + 200_000, serialized(store, message, msgtype, encoding)))
    return sorted(out, key=lambda item: item[2])


def write_bag(path: Path, compression: str) -> Path:
    writer = Writer1(path)
    writer.chunk_threshold = 4096
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression))
    with writer:
        ids = {topic: writer.add_connection(topic, msgtype, typestore=ROS1) for topic, msgtype, _ in MIX}
        for topic, _, t, raw in mixed(ROS1):
            writer.write(ids[topic], t, raw)
    return path


def write_folder(path: Path, plugin: StoragePlugin, mode: CompressionMode | None) -> Path:
    writer = Writer2(path, version=8, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        ids = {topic: writer.add_connection(topic, msgtype, typestore=ROS2) for topic, msgtype, _ in MIX}
        for topic, _, t, raw in mixed(ROS2):
            writer.write(ids[topic], t, raw)
    return path


def write_mcap(path: Path, ros: int = 2, **options: Any) -> Path:
    """By the official library, which has the options of other recorders."""
    from mcap.writer import Writer

    store = ROS1 if ros == 1 else ROS2
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=10_000, **options)
        writer.start(f"ros{ros}", "tests")
        ids = {}
        for topic, msgtype, _ in MIX:
            text = store.generate_msgdef(msgtype, ros_version=ros)[0].encode()
            name = msgtype if ros == 2 else msgtype.replace("/msg/", "/")
            schema = writer.register_schema(name, f"ros{ros}msg", text)
            ids[topic] = writer.register_channel(topic, "cdr" if ros == 2 else "ros1", schema)
        for topic, _, t, raw in mixed(store):
            writer.add_message(ids[topic], t, raw, t)
        writer.finish()
    return path


def make(tmp_path: Path, kind: str) -> Path:
    from mcap.writer import CompressionType, IndexType

    name, _, option = kind.partition(" ")
    if name == "bag":
        return write_bag(tmp_path / "a.bag", option)
    if name == "folder":
        storage, _, mode = option.partition(" ")
        plugin = StoragePlugin.SQLITE3 if storage == "db3" else StoragePlugin.MCAP
        return write_folder(tmp_path / "a", plugin, CompressionMode[mode] if mode else None)
    bare: dict[str, Any] = {
        "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False,
        "repeat_channels": False, "repeat_schemas": False,
    }  # fmt: skip
    options: dict[str, dict[str, Any]] = {
        "zstd": {"compression": CompressionType.ZSTD},
        "lz4": {"compression": CompressionType.LZ4},
        "none": {"compression": CompressionType.NONE},
        "unchunked": {"use_chunking": False},
        "bare": bare,
        "ros1": {"ros": 1},
        "unchecked": {"enable_crcs": False},
        "bare unchunked": bare | {"use_chunking": False},
    }
    return write_mcap(tmp_path / "a.mcap", **options[option])


KINDS = ("bag", "bag BZ2", "bag LZ4", "folder mcap", "folder mcap STORAGE", "folder db3", "folder db3 FILE",
         "folder db3 MESSAGE", "folder mcap FILE", "mcap zstd", "mcap lz4", "mcap none", "mcap unchunked",
         "mcap bare", "mcap bare unchunked", "mcap ros1")  # fmt: skip


def opened(path: Path) -> BagContainer:
    return Ros1File(path) if path.suffix == ".bag" else open_container(path)


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_every_message(tmp_path: Path, kind: str) -> None:
    store = ROS1 if kind.startswith("bag") or kind.endswith("ros1") else ROS2
    container = opened(make(tmp_path, kind))
    asked = {(topic, msgtype): () for topic, msgtype, _ in MIX}
    streams = read_streams(container, asked)
    counts = {(source.topic, source.msgtype): source.count for source in container.sources}
    container.close()
    for key in asked:
        written = [(t, raw) for topic, _, t, raw in mixed(store) if topic == key[0]]
        assert counts[key] == len(written)
        assert streams[key].receipt_ns.tolist() == [t for t, _ in written]
        assert_same(store, streams[key], [raw for _, raw in written])


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_a_recording(tmp_path: Path, kind: str) -> None:
    recording = open_recording(make(tmp_path, kind))
    assert recording.imu is not None
    assert recording.wheels is not None
    assert (len(recording.imu), len(recording.wheels)) == (400, 100)
    assert recording.imu.gyro_radps[0].tobytes() == np.array([0.1, -0.0, 5e-324]).tobytes()
    assert recording.wheels.speed[7].tolist() == [-7.0, -8.0]


def test_two_publishers_of_a_topic_keep_the_order_of_the_file(tmp_path: Path) -> None:
    """A joystick and a planner both send commands, without a header."""
    twist, vector = "geometry_msgs/msg/Twist", ROS1.types["geometry_msgs/msg/Vector3"]
    with Writer1(tmp_path / "a.bag") as writer:
        ids = [
            writer.add_connection("/cmd_vel", twist, typestore=ROS1, callerid=name)
            for name in ("/joy", "/plan")
        ]
        for i in range(500):
            message = ROS1.types[twist](vector(float(i), 0.0, 0.0), vector(0.0, 0.0, 0.0))
            writer.write(ids[i % 2], T0 + i * 10**7, ROS1.serialize_ros1(message, twist))
    command = open_recording(tmp_path / "a.bag").command
    assert command is not None
    np.testing.assert_array_equal(command.v_mps, np.arange(500.0))


@pytest.mark.parametrize("name", ["test1.bag", "test2.bag"])
def test_public_bags_bit_for_bit(field_logs: Path, name: str) -> None:
    path = field_logs / name
    container = Ros1File(path)
    asked = {(s.topic, s.msgtype): () for s in container.sources if s.count}
    streams = read_streams(container, asked)
    container.close()
    with AnyReader([path]) as reader:
        raws: dict[tuple[str, str], list[bytes]] = {key: [] for key in asked}
        for connection, _, raw in reader.messages():
            raws[connection.topic, connection.msgtype].append(bytes(raw))
        for key, stream in streams.items():
            ordered = stream.select(np.argsort(stream.receipt_ns, kind="stable"))
            rows = range(0, len(raws[key]), 37)
            assert len(ordered) == len(raws[key])
            assert_same(reader.typestore, ordered.select(np.array(rows)), [raws[key][i] for i in rows])


def test_a_chunk_that_claims_gigabytes_is_refused_at_once(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", "BZ2")
    content = path.read_bytes()
    at = content.index(b"size=") + 5
    path.write_bytes(content[:at] + struct.pack("<I", 2**31) + content[at + 4 :])
    tracemalloc.start()
    with pytest.raises(TerrafusionError, match="claims to hold 2147483648 bytes"):
        open_recording(path)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


@pytest.mark.parametrize("compression", ["bz2", "zstd", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_claims(compression: str) -> None:
    from lz4 import frame

    pack = {"bz2": bz2.compress, "zstd": zstd().compress, "lz4": frame.compress}[compression]
    bomb = pack(bytes(200_000_000))
    tracemalloc.start()
    with pytest.raises(BagError, match="claims 1000 bytes and holds more"):
        decompress(bomb, compression, 1000)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert decompress(pack(bytes(5000)) + pack(b"end"), compression, 5003) == bytes(5000) + b"end"
    with pytest.raises(BagError, match="claims 6000 bytes and holds 5000"):
        decompress(pack(bytes(5000)), compression, 6000)


@pytest.mark.parametrize("kind", ["bag BZ2", "mcap zstd"])
def test_a_small_bag_that_unpacks_to_gigabytes(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each chunk is as it claims; together they are more than a recording could be."""
    monkeypatch.setattr("terrafusion.datasets.core.limits.FREE_BYTES", 20_000)
    monkeypatch.setattr("terrafusion.datasets.core.limits.EXPANSION", 1)
    with pytest.raises(TerrafusionError, match="more than 1 times its size"):
        open_recording(make(tmp_path, kind))


@pytest.mark.parametrize(("kind", "word"), [("bag BZ2", "broken"), ("mcap unchecked", "neither")])
def test_a_chunk_of_nothing_is_refused_in_time(
    tmp_path: Path, kind: str, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zeros are records without content, as many as there are: not one of them is gone through."""
    path = make(tmp_path, kind)
    module = "ros1" if kind.startswith("bag") else "mcap_file"
    monkeypatch.setattr("terrafusion.datasets.core.limits.FREE_BYTES", 2**28)
    monkeypatch.setattr(
        f"terrafusion.datasets.readers.ros.{module}.decompress", lambda *_: bytes(200_000_000)
    )
    start = time.process_time()
    with pytest.raises(TerrafusionError, match=word):
        open_recording(path)
    assert time.process_time() - start < 2


def test_unknown_types_elsewhere_do_no_harm(tmp_path: Path) -> None:
    """A topic that is not used may have any definition, or none."""
    path = write_bag(tmp_path / "a.bag", "")
    content = (
        path.read_bytes().replace(b"std_msgs/String", b"std_msgs/Strong").replace(b"string data", b"?" * 11)
    )
    path.write_bytes(content)
    imu = open_recording(path).imu
    assert imu is not None
    assert len(imu) == 400


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_file_of_messages_packed_one_by_one_asks_for_its_folder(tmp_path: Path, kind: str) -> None:
    folder = make(tmp_path, f"folder {kind} MESSAGE")
    with pytest.raises(DataError, match="packed one by one; give the folder of the bag"):
        open_recording(folder / f"a.{kind}")


def test_messages_of_other_encodings_are_named(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.LocationFix", "jsonschema", b"{}")
        channel = writer.register_channel("/gps", "json", schema)
        writer.add_message(channel, T0, b'{"latitude": 48.0}', T0)
        writer.finish()
    with pytest.raises(DataError, match="messages in json are not read: export them as tables"):
        open_recording(tmp_path / "a.mcap")


def test_a_definition_that_does_not_fit_is_told(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", "")
    path.write_bytes(path.read_bytes().replace(b"float64 x", b"float32 x"))
    with pytest.raises(TerrafusionError, match=r"a\.bag, /imu: .*definition"):
        open_recording(path)


def test_a_definition_without_a_needed_field_is_told(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", "")
    path.write_bytes(path.read_bytes().replace(b"Vector3 angular_velocity", b"Vector3 angular_velozity"))
    with pytest.raises(TerrafusionError, match=r"a\.bag, /imu: .*no 'angular_velocity"):
        open_recording(path)


def test_a_damaged_definition_is_not_quoted_whole(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", "")
    path.write_bytes(path.read_bytes().replace(b"float64[9] angular", b"float64[9] angul`r"))
    with pytest.raises(TerrafusionError, match="cannot be read as a ROS bag") as refused:
        open_recording(path)
    assert len(str(refused.value)) < 600
    assert "\n" not in str(refused.value)


def test_messages_that_are_all_laid_out_differently(tmp_path: Path) -> None:
    """A cache of layouts is bounded: names of two joints, together of one length, but each time another."""
    pairs = [["a" * k, "b" * (120 - k)] for k in range(1, 120)]
    messages = [
        ("/joints", "sensor_msgs/msg/JointState", T0 + k, MAKE1.joints(T0 + k, pair, [0.0] * 2, [1.0] * 2))
        for k, pair in enumerate(pairs)
    ]
    path = write_ros1(tmp_path / "a.bag", messages)
    with pytest.raises(DataError, match=r"a\.bag, /joints: .*more than 100 \(in.*; leave the topic out"):
        open_recording(path)


def parts_of_a_bag(folder: Path, begins: list[int], names: list[str]) -> Path:
    """Bags of 20 IMU messages, 10 ms apart, that begin at these messages."""
    folder.mkdir()
    for begin, name in zip(begins, names, strict=True):
        messages = [(topic, kind, t + begin * 10**7, m) for topic, kind, t, m in imu_messages(MAKE1)]
        for _, _, t, message in messages:
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(t, 10**9)
        write_ros1(folder / name, messages)
    return folder


def test_the_parts_of_a_split_ros1_bag_are_one(tmp_path: Path) -> None:
    """`rosbag record --split` numbers them; a prefix is followed by the time of each."""
    names = [f"run_2024-05-01-12-0{i // 5}-00_{i}.bag" for i in range(8, 12)]
    recording = open_recording(parts_of_a_bag(tmp_path / "run", [0, 20, 40, 60], names))
    assert recording.imu is not None
    assert (recording.imu.t_ns - recording.start_ns).tolist() == [i * 10**7 for i in range(80)]
    assert f"read as one: {', '.join(names)}" in recording.notes


@pytest.mark.parametrize("begin", [0, 10_000])
def test_numbered_bags_of_other_drives_are_not_joined(tmp_path: Path, begin: int) -> None:
    folder = parts_of_a_bag(tmp_path / "runs", [200, begin], ["run_1.bag", "run_2.bag"])
    with pytest.raises(DataError, match=r"run_2.bag: begins .* s after run_1.bag ends: .* give one of them"):
        open_recording(folder)
