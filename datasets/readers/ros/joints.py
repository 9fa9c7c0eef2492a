"""Wheels and steering axes among the joints of a JointState: which joint is which, and its values."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.channels import Steering, Wheels
from terrafusion.datasets.readers.ros.layout import MessageBlock
from terrafusion.datasets.readers.ros.streams import Stream
from terrafusion.datasets.readers.ros.topics import JOINTS, BagTopic, looks_commanded

_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_ENDS = {"front": "front", "f": "front", "rear": "rear", "back": "rear", "b": "rear", "hind": "rear"}
_SHORT = {
    f"{e}{s}": (end, side)
    for e, end in (("f", "front"), ("r", "rear"), ("b", "rear"))
    for s, side in (("l", "left"), ("r", "right"))
}
_SHORT |= {f"l{e}": (end, "left") for e, end in (("f", "front"), ("r", "rear"), ("b", "rear"), ("h", "rear"))}
_SHORT |= {"rf": ("front", "right"), "rb": ("rear", "right"), "rh": ("rear", "right")}
_STEERING = re.compile(r"steer", re.IGNORECASE)
_NOT_WHEELS = re.compile(
    r"steer|(?<![a-z])(arm|pan|tilt)s?(?![a-z])|flipper|gripper|caster|suspension|rocker|bogie", re.IGNORECASE
)


def wheel_of_joint(joint: str) -> str | None:
    """Name of the wheel (left, front_right, ...) by the name of its joint, or None."""
    return None if _NOT_WHEELS.search(_spaced(joint)) else _place_of_joint(joint)


def _place_of_joint(joint: str) -> str | None:
    """Where a joint is, by its name: left, front_right, ..., or None."""
    words = [word for word in re.split(r"[^a-z]+", _spaced(joint).lower()) if word]
    for word in words:
        if word in _SHORT:
            return "_".join(_SHORT[word])
    side = next((_SIDES[w] for w in words if w in _SIDES), None)
    if side is None:
        return None
    end = next((_ENDS[w] for w in words if w in _ENDS), None)
    if end is None and any(w in ("middle", "mid", "center", "centre") for w in words):
        return None
    return f"{end}_{side}" if end else side


def _spaced(joint: str) -> str:
    return re.sub(r"([a-z])([A-Z])", r"\1_\2", joint)


def wheel_joints(names: Sequence[str], named: dict[str, str]) -> dict[str, str]:
    """Wheel -> joint name for the best layout the joints fill; empty when none is filled."""
    found = dict(named)
    candidates = [n for n in names if "wheel" in n.lower()] or list(names)
    for joint in candidates:
        wheel = wheel_of_joint(joint)
        if wheel is not None:
            found.setdefault(wheel, joint)
    for layout in (Wheels.LAYOUTS[1], Wheels.LAYOUTS[0]):
        if all(wheel in found for wheel in layout):
            return {wheel: found[wheel] for wheel in layout}
    for end in ("rear", "front"):  # one driven axle
        if f"{end}_left" in found and f"{end}_right" in found:
            return {side: found[f"{end}_{side}"] for side in ("left", "right")}
    return {}


def steering_joints(names: Sequence[str]) -> dict[tuple[str, ...], tuple[str, ...]]:
    """The best layout of `Steering` that joints fill: names -> joints; empty where they fill none.

    Joints of the front wheels without the rear ones give the mean of the front wheels.
    """
    found: dict[str, str] = {}
    for joint in names:
        if not _STEERING.search(joint):
            continue
        words = re.split(r"[^a-z]+", joint.lower())
        end = next((_ENDS[word] for word in words if word in _ENDS and len(word) > 1), None)
        wheel = (
            "steering_wheel" if "wheel" in words and not {"left", "right"} & {*words} and not end else None
        )
        found.setdefault(wheel or _place_of_joint(joint) or end or "angle", joint)
    for left, right in (("front_left", "front_right"), ("left", "right")):
        if left in found and right in found:
            both = tuple(found.get(name, "") for name in Steering.LAYOUTS[2])
            return {Steering.LAYOUTS[2]: both} if all(both) else {("angle",): (found[left], found[right])}
    if "front" in found:
        both = (found["front"], found.get("rear", ""))
        return {("front", "rear"): both} if both[1] else {("angle",): both[:1]}
    return next(({(name,): (found[name],)} for name in ("angle", "steering_wheel") if name in found), {})


def joint_names(stream: Stream) -> list[str]:
    """All joints that a JointState topic names, in the order of their appearance."""
    firsts = sorted((int(rows[0]), names) for rows, names, _ in _by_names(stream))
    return list(dict.fromkeys(name for _, names in firsts for name in names))


def joints_beside(topic: str, names: Sequence[str]) -> list[str]:
    """The joints of a topic among those of others: behind its name where none of them has a place."""
    placed = any(_place_of_joint(name) for name in names)
    return list(names) if placed else [f"{topic}/{name}" for name in names]


def wheels_apart(
    bag: Sequence[BagTopic], joints_of: Callable[[str], Sequence[str]], named: dict[str, str]
) -> BagTopic | None:
    """JointStates that hold the wheels together, each some of them; None where they do not.

    Args:
        bag: topics with messages.
        joints_of: names of the joints of a topic.
        named: wheel -> joint, as the user says.
    """
    states = [topic for topic in bag if topic.msgtype == JOINTS and not looks_commanded(topic.name)]
    joints = {topic.name: joints_beside(topic.name, joints_of(topic.name)) for topic in states}
    wheels = wheel_joints([name for names in joints.values() for name in names], named).values()
    holding = [topic for topic in states if not set(wheels).isdisjoint(joints[topic.name])]
    if len(holding) < 2:
        return None
    first, *others = holding
    return BagTopic(
        first.name, JOINTS, sum(topic.count for topic in holding), tuple(topic.name for topic in others)
    )


def joined(streams: Sequence[Stream]) -> Stream:
    """JointStates of several topics as those of one, in the order of their stamps."""
    blocks, count = [], 0
    for stream in streams:
        for block in stream.blocks:
            names = [joints_beside(stream.topic, row) for row in block.columns["name"].tolist()]
            columns = block.columns | {"name": np.array(names, dtype=object)}
            blocks.append(MessageBlock(block.rows + count, columns))
        count += len(stream)
    topic = " + ".join(stream.topic for stream in streams)
    receipt_ns = np.concatenate([stream.receipt_ns for stream in streams])
    whole = Stream(topic, streams[0].msgtype, receipt_ns, tuple(blocks))
    times = receipt_ns if whole.header_ns is None else whole.header_ns
    return whole.select(np.argsort(times, kind="stable"))


def holding(stream: Stream, joints: Sequence[str]) -> Mask:
    """Mask (N,) of the messages that name all these joints."""
    held = np.zeros(len(stream), dtype=bool)
    for rows, names, _ in _by_names(stream):
        held[rows] = all(joint in names for joint in joints)
    return held


def joint_values(stream: Stream, joints: Sequence[str], path: str) -> Array | None:
    """Values (N, k) of these joints, "velocity" or "position"; NaN where a message does not name one.

    None where a message holds another number of values than of names, or no value is known at all.
    """
    out = np.full((len(stream), len(joints)), np.nan)
    for rows, names, columns in _by_names(stream):
        values = columns.get(path)
        if values is not None and values.ndim == 2 and not values.shape[1]:
            continue  # drivers leave them out until the hardware answers
        if values is None or values.ndim != 2 or values.shape[1] != len(names):
            return None
        for k, joint in enumerate(joints):
            if joint in names:
                out[rows, k] = values[:, names.index(joint)]
    return None if np.isnan(out).all() else out


def _by_names(stream: Stream) -> Iterator[tuple[NDArray[np.int64], tuple[str, ...], dict[str, NDArray[Any]]]]:
    """Rows, names and columns of the messages that have the same list of names."""
    for block in stream.blocks:
        names = block.columns["name"]
        if not names.shape[1] or (names == names[0]).all():
            yield block.rows, tuple(names[0]), block.columns
            continue
        groups: dict[tuple[str, ...], list[int]] = {}
        for row, each in enumerate(map(tuple, names.tolist())):
            groups.setdefault(each, []).append(row)
        for each, rows in groups.items():
            yield block.rows[rows], each, {path: column[rows] for path, column in block.columns.items()}
