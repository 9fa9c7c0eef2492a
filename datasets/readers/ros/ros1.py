"""ROS 1 bags (`.bag`)."""

from __future__ import annotations

from pathlib import Path

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.bag import read_bag

REMEDY = "copy it again, or mend it with `rosbag reindex`"


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is named like a ROS 1 bag, or begins as one."""
    return path.is_file() and (path.suffix == ".bag" or head.startswith(b"#ROSBAG V2.0"))


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 1 bag."""
    from terrafusion.datasets.readers.ros.ros1_file import Ros1File

    return [read_bag(request, Ros1File, REMEDY)]
