"""Messages read as arrays: bit for bit what a message by message decoding gives, far faster."""

from __future__ import annotations

import struct
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.ros.layout import MessageDecoder
from terrafusion.datasets.readers.ros.raw import BagError
from tests.datasets.ros_bits import (
    ROS1,
    ROS2,
    T0,
    assert_same,
    batch_of,
    decoded,
    imu,
    messages,
    serialized,
    store_of,
    stream_of,
    types_of,
)

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


@pytest.fixture(scope="module")
def imu_raws() -> list[bytes]:
    """Imu messages in CDR, 200 a second."""
    raw = bytearray(serialized(ROS2, imu(ROS2), "sensor_msgs/msg/Imu", "cdr little"))
    out = []
    for i in range(3000):
        raw[4:12] = struct.pack("<II", *divmod(T0 + i * 5_000_000, 10**9))
        out.append(bytes(raw))
    return out


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
    with pytest.raises(DataError, match=r"more than 100 .* combinations of lengths"):
        stream_of(ROS1, "sensor_msgs/msg/JointState", raws)
    assert time.process_time() - start < 10


def test_memory_is_that_of_the_arrays(imu_raws: list[bytes]) -> None:
    """100 000 messages of 328 bytes: what is kept of each is 64 bytes, and little is held beside."""
    wanted = ("header.stamp", "header.frame_id", "angular_velocity", "linear_acceleration")
    decoder = MessageDecoder("sensor_msgs/msg/Imu", types_of(ROS2), wanted, True)
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
    """Far below what is measured, for busy machines; `bench_bags.py` measures whole bags."""
    raws = imu_raws * 5
    start = time.process_time()
    for raw in raws:
        ROS2.deserialize_cdr(raw, "sensor_msgs/msg/Imu")
    one_by_one = time.process_time() - start
    batch = batch_of(raws)
    decoder = MessageDecoder("sensor_msgs/msg/Imu", types_of(ROS2), (), True)
    start = time.process_time()
    decoder.add(batch)
    decoder.result()
    assert time.process_time() - start < one_by_one / 4
