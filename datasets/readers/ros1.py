"""ROS 1 bags (`.bag`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from terrafusion.datasets.readers.ros_bag import read_bag
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.sensors import Rig


def read_ros1(
    path: Path, *, rig: Rig | None = None, topics: Mapping[str, str] | None = None, stamps: str = "header"
) -> Recording:
    """Read a ROS 1 bag; arguments and errors as in `open_recording`."""
    remedy = "copy it again, or mend it with `rosbag reindex`"
    return read_bag(path, rig=rig, topics=topics, stamps=stamps, typestore=None, remedy=remedy)
