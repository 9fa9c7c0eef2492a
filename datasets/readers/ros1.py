"""ROS 1 bags (`.bag`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros_bag import read_bag
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.sensors import Rig


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is named like a ROS 1 bag, or begins as one."""
    return path.is_file() and (path.suffix == ".bag" or head.startswith(b"#ROSBAG V2.0"))


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 1 bag."""
    return [read_ros1(request.path, rig=request.rig, topics=request.topics, stamps=request.stamps)]


def read_ros1(
    path: Path, *, rig: Rig | None = None, topics: Mapping[str, str] | None = None, stamps: str = "header"
) -> Recording:
    """Read a ROS 1 bag; arguments and errors as in `open_recording`."""
    remedy = "copy it again, or mend it with `rosbag reindex`"
    return read_bag(path, rig=rig, topics=topics, stamps=stamps, typestore=None, remedy=remedy)
