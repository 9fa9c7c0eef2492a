"""The MCAP container of the ROS 2 profile: chunked, indexed, with checksums.

Records are those of the `mcap` library; chunks are filled here, thousands of messages at a time, because
its writer takes one message at a time: 4 times as long.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from zlib import crc32

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.readers.ros.raw import zstd
from terrafusion.datasets.writers.cdr import split

CHUNK_MESSAGES = 4096
ZSTD_LEVEL = 1
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("size", "<u8"), ("channel", "<u2"), ("number", "<u4"), ("log", "<u8"), ("sent", "<u8")]
)
"""What stands before the payload of a message record."""
ROSBAG2 = {"ROS_DISTRO": "humble", "serialized_metadata": ""}
"""rosbag2 takes the rest from the summary; an empty text says that the QoS is in numbers."""


@dataclass(frozen=True, eq=False)
class TopicMessages:
    """The messages of one topic.

    Attributes:
        t_ns: (N,) times of the messages, never decreasing.
        encode: the messages of a slice of rows, in CDR.
        latched: whether late subscribers get the last message (transient local).
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
    path: Path, topics: Sequence[TopicMessages], definitions: Mapping[str, Definition], library: str
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
    types = {name: k for k, name in enumerate(dict.fromkeys(topic.msgtype for topic in topics), 1)}
    schemas = [Schema(k, definitions[name].text.encode(), "ros2msg", name) for name, k in types.items()]
    channels = []
    for k, topic in enumerate(topics, 1):
        qos, digest = qos_profile(topic.latched), definitions[topic.msgtype].digest
        metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
        channels.append(Channel(k, topic.name, "cdr", metadata, types[topic.msgtype]))
    which = np.repeat(np.arange(len(topics)), [len(topic.t_ns) for topic in topics])
    t_ns = np.concatenate([topic.t_ns for topic in topics])
    order = np.argsort(t_ns, kind="stable")
    which, t_ns = which[order], t_ns[order]
    written = [0] * len(topics)
    with path.open("wb") as out:
        out.write(MCAP0_MAGIC + _packed(Header("ros2", library), *schemas, *channels))
        chunks = [
            _write_chunk(out, topics, which[first : first + CHUNK_MESSAGES], written)
            for first in range(0, len(which), CHUNK_MESSAGES)
        ]
        metadata_at, metadata_record = out.tell(), _packed(Metadata("rosbag2", ROSBAG2))
        out.write(metadata_record + _packed(DataEnd(0)))
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(channels),
            channel_message_counts=dict(enumerate(written, 1)),
            chunk_count=len(chunks),
            message_count=len(t_ns),
            message_end_time=int(t_ns[-1]),
            message_start_time=int(t_ns[0]),
            metadata_count=1,
            schema_count=len(schemas),
        )
        index = MetadataIndex(metadata_at, len(metadata_record), "rosbag2")
        _write_summary(out, [schemas, channels, chunks, [index], [statistics]])


def _write_chunk(
    out: BinaryIO, topics: Sequence[TopicMessages], which: NDArray[np.int64], written: list[int]
) -> ChunkIndex:
    """A chunk of the next messages of the topics `which` (n,), and its indexes; counts them in `written`."""
    parts = np.empty((len(which), 2), dtype=object)
    times = np.empty(len(which), dtype=np.int64)
    places = {int(k): np.flatnonzero(which == k) for k in np.unique(which)}
    for k, place in places.items():
        rows = slice(written[k], written[k] + len(place))
        written[k] = rows.stop
        messages = topics[k].encode(rows)
        times[place] = topics[k].t_ns[rows]
        parts[place, 0] = _message_heads(k + 1, rows.start, times[place], messages)
        parts[place, 1] = messages
    sizes = np.array([len(message) for message in parts[:, 1]]) + MESSAGE_HEAD.itemsize
    offsets = np.cumsum(sizes) - sizes
    plain = b"".join(parts.ravel().tolist())
    packed, first, last = zstd().compress(plain, ZSTD_LEVEL), int(times[0]), int(times[-1])
    start = out.tell()
    out.write(_packed(Chunk("zstd", packed, last, first, crc32(plain), len(plain))))
    end, index_at = out.tell(), {}
    for k, place in places.items():
        index_at[k + 1] = out.tell()
        entries = np.stack([times[place], offsets[place]], axis=1).astype("<u8").tobytes()
        head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), k + 1, len(entries))
        out.write(head + entries)
    index_size, sizes_of = out.tell() - end, (len(packed), len(plain))
    return ChunkIndex(end - start, start, "zstd", sizes_of[0], last, index_size, index_at, first, sizes_of[1])


def _write_summary(out: BinaryIO, groups: Sequence[Sequence[McapRecord]]) -> None:
    """The records of the summary section, where each group of them is, footer and magic."""
    start = at = out.tell()
    summary, offsets = b"", []
    for group in groups:
        data = _packed(*group)
        offsets.append(SummaryOffset(data[0], at, len(data)))
        summary, at = summary + data, at + len(data)
    summary += _packed(*offsets)
    footer = _packed(Footer(start, at, 0))[:-4]
    out.write(summary + footer + struct.pack("<I", crc32(summary + footer)) + MCAP0_MAGIC)


def _message_heads(channel: int, first: int, t_ns: TimesNs, messages: Sequence[bytes]) -> list[bytes]:
    heads = np.empty(len(messages), dtype=MESSAGE_HEAD)
    heads["op"], heads["channel"] = Opcode.MESSAGE, channel
    heads["size"] = [len(message) for message in messages]
    heads["size"] += MESSAGE_HEAD.itemsize - 9
    heads["number"] = np.arange(first, first + len(messages)) & 0xFFFFFFFF
    heads["log"] = heads["sent"] = t_ns
    return split(heads)


def _packed(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


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
