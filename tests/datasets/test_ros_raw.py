"""Bags read as arrays: bit for bit what a message by message decoding gives, from every container."""

from __future__ import annotations

import bz2
import struct
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.ros1_file import Ros1File
from terrafusion.datasets.readers.ros2 import open_container
from terrafusion.datasets.readers.ros_layout import Decoder
from terrafusion.datasets.readers.ros_messages import Stream
from terrafusion.datasets.readers.ros_raw import BagError, Batch, Container, decompress
from terrafusion.datasets.readers.ros_streams import read_streams

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
T0 = 1_600_000_000_000_000_000
ENCODINGS = ("ros1", "cdr little", "cdr big")
TYPES = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/NavSatFix",
    "sensor_msgs/msg/BatteryState",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "std_msgs/msg/String",
    "std_msgs/msg/Float64MultiArray",
    "nav_msgs/msg/Path",
    "diagnostic_msgs/msg/DiagnosticArray",
)
HARD = [0.0, -0.0, 5e-324, -2.2e-308, 1.7e308, float("inf"), float("-inf"), float("nan")]
PAYLOADS = [0x7FF8000000000001, 0xFFF8DEADBEEF0001, 0x7FF0000000000001]
"""Bits of quiet and signalling NaN that a careless conversion would change."""


def store_of(encoding: str) -> Any:
    return ROS1 if encoding == "ros1" else ROS2


def values_of(draw: st.DrawFn, base: str, count: int) -> np.ndarray:
    if base == "float64":
        hard = np.array([*HARD, *np.array(PAYLOADS, dtype="u8").view("f8")])
        easy = draw(st.lists(st.floats(), min_size=count, max_size=count))
        pick = draw(st.lists(st.integers(0, 2 * len(hard) - 1), min_size=count, max_size=count))
        bits = [
            hard.view("u8")[k] if k < len(hard) else np.float64(v).view("u8")
            for k, v in zip(pick, easy, strict=True)
        ]
        return np.array(bits, dtype="u8").view("f8")
    if base == "float32":
        return np.array(draw(st.lists(st.floats(width=32), min_size=count, max_size=count)), dtype="f4")
    if base == "bool":
        return np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)), dtype=bool)
    info = np.iinfo({"byte": "int8", "char": "uint8"}.get(base, base))
    numbers = st.lists(st.integers(int(info.min), int(info.max)), min_size=count, max_size=count)
    return np.array(draw(numbers), dtype=info.dtype)


@st.composite
def messages(draw: st.DrawFn, store: Any, msgtype: str) -> Any:
    """A message of any type, with numbers of all bits, strings and lists of several lengths."""

    def one(kind: Any, desc: Any) -> Any:
        if kind.name == "NAME":
            return draw(messages(store, desc))
        if desc[0] == "string":
            return draw(st.text(alphabet="ab/é", max_size=6))
        return values_of(draw, desc[0], 1)[0].item()

    fields = []
    for _, (kind, desc) in store.fielddefs[msgtype][1]:
        if kind.name in ("BASE", "NAME"):
            fields.append(one(kind, desc))
            continue
        (inner_kind, inner), count = desc
        count = count if kind.name == "ARRAY" else draw(st.integers(0, 3))
        if inner_kind.name == "BASE" and inner[0] != "string":
            fields.append(values_of(draw, inner[0], count))
        else:
            fields.append([one(inner_kind, inner) for _ in range(count)])
    return store.types[msgtype](*fields)


def serialized(store: Any, message: Any, msgtype: str, encoding: str) -> bytes:
    if encoding == "ros1":
        return bytes(store.serialize_ros1(message, msgtype))
    return bytes(store.serialize_cdr(message, msgtype, little_endian=encoding == "cdr little"))


def decoded(store: Any, raw: bytes, msgtype: str) -> Any:
    ros1 = "seq" in dict(store.fielddefs["std_msgs/msg/Header"][1])
    return store.deserialize_ros1(raw, msgtype) if ros1 else store.deserialize_cdr(raw, msgtype)


def leaves(store: Any, message: Any, msgtype: str, path: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of a deserialised message, as columns name them."""
    for name, (kind, desc) in store.fielddefs[msgtype][1]:
        value, inner = getattr(message, name), f"{path}.{name}".lstrip(".")
        if kind.name == "NAME":
            yield from leaves(store, value, desc, inner)
        elif kind.name != "BASE" and desc[0][0].name == "NAME":
            for i, each in enumerate(value):
                yield from leaves(store, each, desc[0][1], f"{inner}.{i}")
        else:
            yield inner, value


def batch_of(raws: Sequence[bytes]) -> Batch:
    sizes = np.array([len(raw) for raw in raws], dtype=np.int64)
    data = np.frombuffer(b"\7" + b"".join(raws), dtype=np.uint8)  # begins at an odd place
    return Batch(0, data, 1 + np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes, np.arange(len(raws)))


def types_of(store: Any) -> dict[str, Any]:
    return {name: fields for name, (_, fields) in store.fielddefs.items()}


def stream_of(store: Any, msgtype: str, raws: Sequence[bytes], wanted: Sequence[str] = ()) -> Stream:
    decoder = Decoder(msgtype, types_of(store), wanted, store is not ROS1)
    half = len(raws) // 2
    for part in (raws[:half], raws[half:]):
        if part:
            decoder.add(batch_of(part))
    return Stream("/topic", msgtype, *decoder.result())


def same_bits(a: Any, b: Any) -> bool:
    if isinstance(a, (str, list)):
        return a == (b if isinstance(b, str) else list(b))
    a, b = np.asarray(a), np.asarray(b)
    kind = b.dtype if a.dtype.kind in "fiub" else a.dtype
    return a.shape == b.shape and a.astype(kind).tobytes() == b.tobytes()


def assert_same(store: Any, stream: Stream, raws: Sequence[bytes]) -> None:
    """Every leaf of every message, bit for bit."""
    assert len(stream) == len(raws)
    seen = 0
    for block in stream.blocks:
        for i, row in enumerate(block.rows.tolist()):
            expected = dict(leaves(store, decoded(store, raws[row], stream.msgtype), stream.msgtype))
            assert expected.keys() == block.columns.keys()
            for path, value in expected.items():
                assert same_bits(value, block.columns[path][i]), (path, value, block.columns[path][i])
            seen += 1
    assert seen == len(raws)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("msgtype", TYPES)
@settings(max_examples=8, deadline=None)
@given(data=st.data())
def test_every_bit_is_that_of_the_full_decoding(msgtype: str, encoding: str, data: st.DataObject) -> None:
    store = store_of(encoding)
    many = data.draw(st.lists(messages(store, msgtype), min_size=1, max_size=6))
    raws = [serialized(store, message, msgtype, encoding) for message in many]
    assert_same(store, stream_of(store, msgtype, raws * 2), raws * 2)


def test_byte_orders_may_mix(imu_raws: list[bytes]) -> None:
    message = ROS2.deserialize_cdr(imu_raws[0], "sensor_msgs/msg/Imu")
    big = bytes(ROS2.serialize_cdr(message, "sensor_msgs/msg/Imu", little_endian=False))
    raws = [imu_raws[0], big, imu_raws[1]]
    assert_same(ROS2, stream_of(ROS2, "sensor_msgs/msg/Imu", raws), raws)


@pytest.mark.parametrize("encoding", ENCODINGS)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_garbled_message_is_refused_or_read(encoding: str, data: st.DataObject) -> None:
    store = store_of(encoding)
    message = data.draw(messages(store, "sensor_msgs/msg/JointState"))
    raw = bytearray(serialized(store, message, "sensor_msgs/msg/JointState", encoding))
    for at, value in data.draw(st.dictionaries(st.integers(0, len(raw) - 1), st.integers(0, 255))).items():
        raw[at] = value
    raw = raw[: data.draw(st.integers(0, len(raw)))]
    try:
        expected = decoded(store, bytes(raw), "sensor_msgs/msg/JointState")
    except Exception:
        expected = None
    try:
        stream = stream_of(store, "sensor_msgs/msg/JointState", [bytes(raw)])
    except BagError:
        assert expected is None
    else:
        assert expected is not None
        assert_same(store, stream, [bytes(raw)])


@pytest.fixture(scope="module")
def imu_raws() -> list[bytes]:
    """Imu messages in CDR, 200 a second."""
    raw = bytearray(serialized(ROS2, imu(ROS2), "sensor_msgs/msg/Imu", "cdr little"))
    out = []
    for i in range(3000):
        raw[4:12] = struct.pack("<II", *divmod(T0 + i * 5_000_000, 10**9))
        out.append(bytes(raw))
    return out


def imu(store: Any, frame: str = "imu_link") -> Any:
    new = store.types
    stamp = new["builtin_interfaces/msg/Time"](*divmod(T0, 10**9))
    header = new["std_msgs/msg/Header"](*([7] if store is ROS1 else []), stamp, frame)
    vector = new["geometry_msgs/msg/Vector3"]
    return new["sensor_msgs/msg/Imu"](
        header, new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9),
        vector(0.1, -0.0, 5e-324), np.zeros(9), vector(0.0, 0.1, 9.81), np.arange(9.0),
    )  # fmt: skip


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


def write_mcap(path: Path, **options: Any) -> Path:
    """By the official library, which has the options of other recorders."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=10_000, **options)
        writer.start("ros2", "tests")
        ids = {}
        for topic, msgtype, _ in MIX:
            text = ROS2.generate_msgdef(msgtype, ros_version=2)[0].encode()
            schema = writer.register_schema(msgtype, "ros2msg", text)
            ids[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, _, t, raw in mixed(ROS2):
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
        "bare unchunked": bare | {"use_chunking": False},
    }
    return write_mcap(tmp_path / "a.mcap", **options[option])


KINDS = ("bag", "bag BZ2", "bag LZ4", "folder mcap", "folder mcap STORAGE", "folder db3", "folder db3 FILE",
         "folder db3 MESSAGE", "folder mcap FILE", "mcap zstd", "mcap lz4", "mcap none", "mcap unchunked",
         "mcap bare", "mcap bare unchunked")  # fmt: skip


def opened(path: Path) -> Container:
    return Ros1File(path) if path.suffix == ".bag" else open_container(path)


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_every_message(tmp_path: Path, kind: str) -> None:
    store = ROS1 if kind.startswith("bag") else ROS2
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


# --- hostile and large -----------------------------------------------------------------------------------


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
    from backports import zstd
    from lz4 import frame

    pack = {"bz2": bz2.compress, "zstd": zstd.compress, "lz4": frame.compress}[compression]
    bomb = pack(bytes(200_000_000))
    tracemalloc.start()
    with pytest.raises(BagError, match="claims 1000 bytes and holds more"):
        decompress(bomb, compression, 1000)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert decompress(pack(bytes(5000)) + pack(b"end"), compression, 5003) == bytes(5000) + b"end"
    with pytest.raises(BagError, match="claims 6000 bytes and holds 5000"):
        decompress(pack(bytes(5000)), compression, 6000)


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


def test_messages_without_any_order_are_refused_in_time() -> None:
    """Every message with lists of other lengths: no sensor, and no reason to run for hours."""
    rng = np.random.default_rng(0)
    raws = []
    for _ in range(30_000):
        a, b, c = rng.integers(0, 40, 3)
        raws.append(struct.pack("<III", 0, 0, 0) + b"".join(
            [struct.pack("<I", 0), struct.pack("<I", 0)]
            + [struct.pack("<I", n) + bytes(8 * int(n)) for n in (a, b, c)]
        ))  # fmt: skip
    start = time.process_time()
    with pytest.raises(BagError, match="lengths"):
        stream_of(ROS1, "sensor_msgs/msg/JointState", raws)
    assert time.process_time() - start < 10


def test_memory_is_that_of_the_arrays(tmp_path: Path, imu_raws: list[bytes]) -> None:
    """100 000 messages of 328 bytes: what is kept of each is 96 bytes, and little is held beside."""
    wanted = ("header.stamp", "header.frame_id", "angular_velocity", "linear_acceleration")
    decoder = Decoder("sensor_msgs/msg/Imu", types_of(ROS2), wanted, True)
    batch = batch_of(imu_raws[:1000])
    decoder.add(batch)
    tracemalloc.start()
    for _ in range(100):
        decoder.add(batch)
    _, blocks = decoder.result()
    peak = tracemalloc.get_traced_memory()[1] / 100_000
    tracemalloc.stop()
    kept = sum(column.nbytes for column in blocks[0].columns.values()) / len(blocks[0].rows)
    assert kept == 6 * 8 + 2 * 4 + 8
    assert peak < 120


def test_far_faster_than_message_by_message(imu_raws: list[bytes]) -> None:
    """Measured 30 to 60 times; docs tell the figures of `bench_bags.py`."""
    raws = imu_raws * 5
    start = time.process_time()
    for raw in raws:
        ROS2.deserialize_cdr(raw, "sensor_msgs/msg/Imu")
    one_by_one = time.process_time() - start
    batch = batch_of(raws)
    decoder = Decoder("sensor_msgs/msg/Imu", types_of(ROS2), (), True)
    start = time.process_time()
    decoder.add(batch)
    decoder.result()
    assert time.process_time() - start < one_by_one / 4
