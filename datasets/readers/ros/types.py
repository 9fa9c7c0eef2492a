"""Definitions of message types: those a bag carries, else those of the ROS release."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from terrafusion.datasets.readers.ros.layout import Fields
from terrafusion.datasets.readers.ros.raw import Source

_RULE = "=" * 80 + "\n"


def types_of(source: Source) -> Mapping[str, Fields]:
    """Fields of a source's type and of those it is made of.

    What the bag does not define is taken from ROS 1 Noetic or ROS 2 Humble: SQLite bags before
    ROS 2 Iron carry no definitions.
    """
    return _released(source.encoding) | (_parsed(source) if source.definition else {})


@cache
def _released(encoding: str) -> dict[str, Fields]:
    from rosbags.typesys import Stores, get_typestore

    release = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    return {name: fields for name, (_, fields) in release.fielddefs.items()}


def _parsed(source: Source) -> dict[str, Fields]:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if source.language == "msg":
        found = dict(get_types_from_msg(source.definition, source.msgtype))
    elif source.definition.startswith(f"{_RULE}IDL: "):
        found = {}
        for part in source.definition.split(_RULE)[1:]:
            found |= get_types_from_idl(part.split("\n", 1)[1])
    else:
        found = dict(get_types_from_idl(source.definition))
    return {name: fields for name, (_, fields) in found.items()}
