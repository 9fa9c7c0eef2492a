"""ROS 2 bags: a folder with `metadata.yaml`, or a lone `.mcap` or `.db3` file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from terrafusion.datasets.readers.ros_bag import read_bag
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.sensors import Rig


def read_ros2(
    path: Path, *, rig: Rig | None = None, topics: Mapping[str, str] | None = None, stamps: str = "header"
) -> Recording:
    """Read a ROS 2 bag; arguments and errors as in `open_recording`.

    Bags that carry no message definitions (SQLite before ROS 2 Iron) are read with those of Humble.
    """
    from rosbags.typesys import Stores, get_typestore

    remedy = "copy it again, or mend it with `ros2 bag reindex` (MCAP: `mcap recover`)"
    typestore = get_typestore(Stores.ROS2_HUMBLE)
    return read_bag(path, rig=rig, topics=topics, stamps=stamps, typestore=typestore, remedy=remedy)
