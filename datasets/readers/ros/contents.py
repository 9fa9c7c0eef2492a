"""Topics of a bag whose robot is not known yet, and between which of them only the user can choose."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.readers.formats import Request, format_of
from terrafusion.datasets.readers.open import find_log
from terrafusion.datasets.readers.ros import ros1, ros2
from terrafusion.datasets.readers.ros.bag import chosen_topics, opened_bag, topics_of
from terrafusion.datasets.readers.ros.static_frames import STATIC
from terrafusion.datasets.readers.ros.streams import read_streams, wanted_fields
from terrafusion.datasets.readers.ros.topics import TYPES, BagTopic


@dataclass(frozen=True)
class BagContents:
    """Topics of a bag, and by channel those sensors with data between which only the user can choose.

    `times_ns` are when the (N,) messages of each topic that is read were received: one clock for all topics.
    `unused` are name and type of the topics that no channel is made of.
    """

    times_ns: dict[str, TimesNs]
    unused: tuple[str, ...]
    candidates: dict[str, tuple[str, ...]]


def _fields_of(topic: BagTopic) -> tuple[str, ...]:
    """The stamp, and all that any channel is made of: so a bag that is `decoded_once` is read once."""
    kinds = [kind for kind, types in TYPES.items() if topic.msgtype in types]
    wanted = [wanted_fields(kind, topic.msgtype) for kind in kinds]
    return ("header.stamp", *dict.fromkeys(f for fields in wanted for f in fields)) if all(wanted) else ()


def bag_contents(log: str, topics: Mapping[str, str] | None = None) -> BagContents | None:
    """Contents of a bag, by path or catalogue name; None for a log of another format.

    `topics` is what the user has chosen, by channel.

    Raises:
        DataError: no such log, a broken bag, or a topic asked for that is not there.
    """
    path, _ = find_log(log)
    form = format_of(path).name
    if form not in ("ros1", "ros2"):
        return None
    candidates: dict[str, tuple[str, ...]] = {}

    def open_to_the_user(kind: str, found: list[BagTopic]) -> BagTopic:
        candidates[kind] = tuple(topic.name for topic in found)
        return found[0]

    openers = {"ros1": (ros1.open_container, ros1.REMEDY), "ros2": (ros2.open_container, ros2.REMEDY)}
    with opened_bag(path, *openers[form]) as container:
        there = topics_of(container)
        usable = [topic for topic in there if any(topic.msgtype in types for types in TYPES.values())]
        streams = read_streams(container, {(t.name, t.msgtype): _fields_of(t) for t in usable})
        chosen_topics(container, Request(path, topics=topics), open_to_the_user)
    times_ns = {topic.name: np.sort(streams[topic.name, topic.msgtype].receipt_ns) for topic in usable}
    held = {name: t_ns for name, t_ns in times_ns.items() if len(t_ns)}  # an index may count too many
    others = [topic for topic in there if topic not in usable and not topic.name.endswith(STATIC[0])]
    unused = tuple(f"{topic.name} ({topic.msgtype})" for topic in others)
    return BagContents(held, unused, candidates)
