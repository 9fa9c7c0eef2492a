"""What to do about a bag without a topic of wheels: which may hold them, and how to name them."""

import re
from collections.abc import Callable, Iterator, Sequence

from terrafusion.datasets.readers.ros.topics import JOINTS, ODOMETRY, TYPES, BagTopic, looks_fused

MOST_SHOWN = 8
_NEVER = re.compile(
    r"^(tf2|rcl_interfaces|rosgraph|diagnostic|visualization|rosbag2)_?\w*/|Image|PointCloud|Log$"
)
_LIKELY = re.compile(r"wheel|vel|speed|motor|enc|tick|rpm|odo|drive", re.IGNORECASE)


def wheel_advice(
    bag: Sequence[BagTopic], taken: Sequence[str], joints_of: Callable[[str], Sequence[str]]
) -> str:
    """A note for a bag without wheels.

    Args:
        bag: topics with messages.
        taken: topics of other sensors.
        joints_of: joints of a JointState topic.
    """
    others = [topic for topic in bag if topic.name not in taken and not _NEVER.search(topic.msgtype)]
    usable = [topic for topic in others if topic.msgtype in TYPES["wheels"]]
    parts = [*_named(usable, joints_of)]
    strange = [topic for topic in others if not any(topic.msgtype in types for types in TYPES.values())]
    strange.sort(key=lambda topic: not _LIKELY.search(f"{topic.name} {topic.msgtype}"))
    if strange:
        shown = [f"{topic.name} ({topic.msgtype})" for topic in strange[:MOST_SHOWN]]
        more = [f"{len(strange) - MOST_SHOWN} more"] if len(strange) > MOST_SHOWN else []
        parts.append(f"not used are {', '.join([*shown, *more])}, of types that are not read")
    if not usable:
        parts.append(f"record the speeds as {JOINTS} or {ODOMETRY}, or give them as a table")
    return f"wheels: no topic was chosen for them, and replay needs them: {'; '.join(parts)}"


def _named(usable: Sequence[BagTopic], joints_of: Callable[[str], Sequence[str]]) -> Iterator[str]:
    """How each topic of a fit type is asked for."""
    for topic in usable:
        if topic.msgtype == JOINTS:
            joints = joints_of(topic.name)
            names = ", ".join(joints[:MOST_SHOWN]) or "none"
            yield (
                f"the joints of {topic.name} ({names}) name no side: give two with --topic joint.left=NAME "
                "--topic joint.right=NAME, or four with joint.front_left, ..."
            )
        elif not looks_fused("wheels", topic):  # which has a note of its own
            yield f"--topic wheels={topic.name} uses this {topic.msgtype} if it is measured, not commanded"
