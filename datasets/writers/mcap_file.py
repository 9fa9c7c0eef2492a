"""The MCAP container of the ROS 2 profile: chunked, indexed, with checksums; by the `mcap` library."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from terrafusion.datasets.core.arrays import TimesNs

ENCODED_AT_ONCE = 4096
"""Messages of a topic."""
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


def write_mcap_file(
    path: Path, topics: Sequence[TopicMessages], definitions: Mapping[str, tuple[str, str]]
) -> None:
    """Write all messages in the order of their times; of equal times in the order of the topics.

    Args:
        topics: at least one with messages, at most 65535; empty ones stay as channels.
        definitions: by message type, its text with all it refers to, and its hash after REP-2011.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("wb") as out:
        writer = Writer(out)
        writer.start("ros2", "terrafusion")
        types = {
            name: writer.register_schema(name, "ros2msg", definitions[name][0].encode())
            for name in dict.fromkeys(topic.msgtype for topic in topics)
        }
        channels = []
        for topic in topics:
            qos, (_, digest) = qos_profile(topic.latched), definitions[topic.msgtype]
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
            channels.append(writer.register_channel(topic.name, "cdr", types[topic.msgtype], metadata))
        which = np.repeat(np.arange(len(topics)), [len(topic.t_ns) for topic in topics])
        order = np.argsort(np.concatenate([topic.t_ns for topic in topics]), kind="stable")
        messages = [_messages(topic) for topic in topics]
        for k in which[order].tolist():
            number, t_ns, data = next(messages[k])
            writer.add_message(channels[k], t_ns, data, t_ns, number)
        writer.add_metadata("rosbag2", ROSBAG2)
        writer.finish()


def _messages(topic: TopicMessages) -> Iterator[tuple[int, int, bytes]]:
    """Number, time and bytes of each message."""
    for first in range(0, len(topic.t_ns), ENCODED_AT_ONCE):
        rows = slice(first, first + ENCODED_AT_ONCE)
        times = topic.t_ns[rows].tolist()
        yield from zip(range(first, first + len(times)), times, topic.encode(rows), strict=True)


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
