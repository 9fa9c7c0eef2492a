"""The MCAP container (https://mcap.dev/spec) of the ROS 2 profile: chunked, indexed, with checksums.

rosbags writes it too, but takes a message at a time: 40 s for an hour of sensors at 100 Hz.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.readers.ros.raw import zstd
from terrafusion.datasets.writers.cdr import split

TimesNs = NDArray[np.int64]

MAGIC = b"\x89MCAP0\r\n"
CHUNK_MESSAGES = 4096
ZSTD_LEVEL = 1
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("size", "<u8"), ("channel", "<u2"), ("number", "<u4"), ("log", "<u8"), ("sent", "<u8")]
)
"""What stands before the payload of a message record."""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0B, 0x10)


@dataclass(frozen=True, eq=False)
class Topic:
    """What is written on one topic.

    Attributes:
        name, msgtype: of the topic.
        t_ns: (N,) times of the messages, never decreasing.
        encode: the messages of a slice of rows, in CDR.
        latched: whether late subscribers are to get the last message (transient local).
    """

    name: str
    msgtype: str
    t_ns: TimesNs
    encode: Callable[[slice], Sequence[bytes]]
    latched: bool = False


@dataclass(frozen=True)
class Definition:
    """Text of a message definition with all it refers to, and its hash after REP-2011."""

    text: str
    digest: str


def write_mcap_file(
    path: Path, topics: Sequence[Topic], definitions: Mapping[str, Definition], library: str
) -> None:
    """Write all messages in the order of their times; of equal times in the order of the topics.

    Args:
        path: the file, which is replaced.
        topics: at least one with messages, at most 65535; empty ones stay as channels.
        definitions: by message type.
        library: name of the writer, for the header.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("wb") as out:
        _File(out, topics, definitions).write(library)


class _File:
    def __init__(self, out: BinaryIO, topics: Sequence[Topic], definitions: Mapping[str, Definition]) -> None:
        self.out = out
        self.topics = topics
        types = list(dict.fromkeys(topic.msgtype for topic in topics))
        self.schemas = b"".join(
            _record(
                SCHEMA, struct.pack("<H", i), _text(name), _text("ros2msg"), _text(definitions[name].text)
            )
            for i, name in enumerate(types, 1)
        )
        self.channels = b"".join(
            _record(
                CHANNEL,
                struct.pack("<HH", i, types.index(topic.msgtype) + 1),
                _text(topic.name),
                _text("cdr"),
                _map(
                    offered_qos_profiles=qos_profile(topic.latched),
                    topic_type_hash=definitions[topic.msgtype].digest,
                ),
            )
            for i, topic in enumerate(topics, 1)
        )
        self.type_count = len(types)
        self.chunk_index: list[bytes] = []

    def write(self, library: str) -> None:
        self.out.write(MAGIC + _record(HEADER, _text("ros2"), _text(library)))
        self.out.write(self.schemas + self.channels)
        which = np.repeat(np.arange(len(self.topics)), [len(topic.t_ns) for topic in self.topics])
        t_ns = np.concatenate([topic.t_ns for topic in self.topics])
        order = np.argsort(t_ns, kind="stable")
        which, t_ns = which[order], t_ns[order]
        done = [0] * len(self.topics)
        for first in range(0, len(which), CHUNK_MESSAGES):
            self._chunk(which[first : first + CHUNK_MESSAGES], done)
        self._close(int(t_ns[0]), int(t_ns[-1]))

    def _chunk(self, which: NDArray[np.int64], done: list[int]) -> None:
        """One chunk of the next messages of the topics `which` (n,), and its index; `done` is moved on."""
        parts = np.empty((len(which), 2), dtype=object)
        times = np.empty(len(which), dtype=np.int64)
        places = {int(k): np.flatnonzero(which == k) for k in np.unique(which)}
        for k, place in places.items():
            rows = slice(done[k], done[k] + len(place))
            done[k] = rows.stop
            messages = self.topics[k].encode(rows)
            times[place] = self.topics[k].t_ns[rows]
            parts[place, 0] = _heads(k + 1, rows.start, times[place], messages)
            parts[place, 1] = messages
        sizes = np.array([len(message) for message in parts[:, 1]]) + MESSAGE_HEAD.itemsize
        offsets = np.cumsum(sizes) - sizes
        plain = b"".join(parts.ravel().tolist())
        packed = zstd().compress(plain, ZSTD_LEVEL)
        span = struct.pack("<QQ", times[0], times[-1])
        start = self.out.tell()
        sums = struct.pack("<QI", len(plain), crc32(plain))
        self.out.write(_record(CHUNK, span, sums, _text("zstd"), struct.pack("<Q", len(packed)), packed))
        end = self.out.tell()
        index_at = b""
        for k, place in places.items():
            index_at += struct.pack("<HQ", k + 1, self.out.tell())
            pairs = np.stack([times[place], offsets[place]], axis=1).astype("<u8").tobytes()
            self.out.write(_record(INDEX, struct.pack("<HI", k + 1, len(pairs)), pairs))
        self.chunk_index.append(
            _record(
                CHUNK_INDEX,
                span,
                struct.pack("<QQI", start, end - start, len(index_at)),
                index_at,
                struct.pack("<Q", self.out.tell() - end),
                _text("zstd"),
                struct.pack("<QQ", len(packed), len(plain)),
            )
        )

    def _close(self, first_ns: int, last_ns: int) -> None:
        start = self.out.tell()
        self.out.write(_record(METADATA, _text("rosbag2"), _map(**ROSBAG2)))
        length = self.out.tell() - start
        self.out.write(_record(DATA_END, struct.pack("<I", 0)))
        counts = {k: len(topic.t_ns) for k, topic in enumerate(self.topics, 1)}
        statistics = struct.pack(
            "<QHIIIIQQI",
            sum(counts.values()),
            self.type_count,
            len(self.topics),
            0,
            1,
            len(self.chunk_index),
            first_ns,
            last_ns,
            10 * len(counts),
        ) + b"".join(struct.pack("<HQ", k, n) for k, n in counts.items())
        groups = {
            SCHEMA: self.schemas,
            CHANNEL: self.channels,
            CHUNK_INDEX: b"".join(self.chunk_index),
            METADATA_INDEX: _record(METADATA_INDEX, struct.pack("<QQ", start, length), _text("rosbag2")),
            STATISTICS: _record(STATISTICS, statistics),
        }
        self._summary(groups)

    def _summary(self, groups: dict[int, bytes]) -> None:
        start = self.out.tell()
        at, offsets = start, b""
        for op, group in groups.items():
            if group:
                offsets += _record(SUMMARY_OFFSET, struct.pack("<BQQ", op, at, len(group)))
            at += len(group)
        summary = b"".join(groups.values()) + offsets + struct.pack("<BQQQ", FOOTER, 20, start, at)
        self.out.write(summary + struct.pack("<I", crc32(summary)) + MAGIC)


ROSBAG2 = {"ROS_DISTRO": "humble", "serialized_metadata": ""}
"""rosbag2 takes the rest from the summary; an empty text tells it that the QoS is in numbers."""


def qos_profile(latched: bool) -> str:
    """Reliable, keep last; volatile or transient local; as rosbag2 stores it up to version 8."""
    endless = "{sec: 9223372036, nsec: 854775807}"
    values = {
        "history": 1,
        "depth": 1 if latched else 10,
        "reliability": 1,
        "durability": 1 if latched else 2,
        "deadline": endless,
        "lifespan": endless,
        "liveliness": 1,
        "liveliness_lease_duration": endless,
        "avoid_ros_namespace_conventions": "false",
    }
    return "- " + "\n  ".join(f"{key}: {value}" for key, value in values.items())


def _heads(channel: int, first: int, t_ns: TimesNs, messages: Sequence[bytes]) -> list[bytes]:
    heads = np.empty(len(messages), dtype=MESSAGE_HEAD)
    heads["op"], heads["channel"] = MESSAGE, channel
    heads["size"] = [len(message) for message in messages]
    heads["size"] += MESSAGE_HEAD.itemsize - 9
    heads["number"] = np.arange(first, first + len(messages)) & 0xFFFFFFFF
    heads["log"] = heads["sent"] = t_ns
    return split(heads)


def _record(op: int, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack("<BQ", op, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _map(**entries: str) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return struct.pack("<I", len(data)) + data
