"""Messages of any type with awkward values, and their comparison bit for bit with rosbags' decoding."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from terrafusion.datasets.readers.ros.layout import MessageDecoder
from terrafusion.datasets.readers.ros.raw import MessageBatch
from terrafusion.datasets.readers.ros.streams import Stream

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
T0 = 1_600_000_000_000_000_000
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


def batch_of(raws: Sequence[bytes]) -> MessageBatch:
    sizes = np.array([len(raw) for raw in raws], dtype=np.int64)
    data = np.frombuffer(b"\7" + b"".join(raws), dtype=np.uint8)  # begins at an odd place
    return MessageBatch(
        0, data, 1 + np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes, np.arange(len(raws))
    )


def types_of(store: Any) -> dict[str, Any]:
    return {name: fields for name, (_, fields) in store.fielddefs.items()}


def stream_of(store: Any, msgtype: str, raws: Sequence[bytes], wanted: Sequence[str] = ()) -> Stream:
    decoder = MessageDecoder(msgtype, types_of(store), wanted, store is not ROS1)
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


def imu(store: Any, frame: str = "imu_link") -> Any:
    new = store.types
    stamp = new["builtin_interfaces/msg/Time"](*divmod(T0, 10**9))
    header = new["std_msgs/msg/Header"](*([7] if store is ROS1 else []), stamp, frame)
    vector = new["geometry_msgs/msg/Vector3"]
    return new["sensor_msgs/msg/Imu"](
        header, new["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9),
        vector(0.1, -0.0, 5e-324), np.zeros(9), vector(0.0, 0.1, 9.81), np.arange(9.0),
    )  # fmt: skip
