"""ROS 2 bags: a folder with `metadata.yaml`, or a lone `.mcap` or `.db3` file."""

from __future__ import annotations

from pathlib import Path

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros.bag import read_bag
from terrafusion.datasets.readers.ros.raw import Container

REMEDY = "copy it again, or mend it with `ros2 bag reindex` (MCAP: `mcap recover`)"


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a ROS 2 bag: a folder with `metadata.yaml`, or a file named `.mcap` or `.db3`."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in (".mcap", ".db3")


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 2 bag.

    Bags that carry no message definitions (SQLite before ROS 2 Iron) are read with those of Humble.
    """
    return [read_bag(request, open_container, REMEDY)]


def open_container(path: Path) -> Container:
    """The container of a ROS 2 bag.

    Raises:
        BagError: it is broken.
    """
    from terrafusion.datasets.readers.ros.db3_file import Db3File
    from terrafusion.datasets.readers.ros.mcap_file import McapFile
    from terrafusion.datasets.readers.ros.ros2_folder import Ros2Folder

    if path.is_dir():
        return Ros2Folder(path)
    return McapFile(path) if path.suffix == ".mcap" else Db3File(path)
