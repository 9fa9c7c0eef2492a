"""ROS 2 bags: a folder with `metadata.yaml`, or a lone `.mcap` or `.db3` file."""

from __future__ import annotations

from pathlib import Path

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.ros_bag import read_bag
from terrafusion.datasets.recording import Recording

REMEDY = "copy it again, or mend it with `ros2 bag reindex` (MCAP: `mcap recover`)"


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a ROS 2 bag: a folder with `metadata.yaml`, or a file named `.mcap` or `.db3`."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix in (".mcap", ".db3")


def read(request: Request) -> list[Recording]:
    """The one recording of a ROS 2 bag.

    Bags that carry no message definitions (SQLite before ROS 2 Iron) are read with those of Humble.
    """
    from rosbags.typesys import Stores, get_typestore

    path = request.path
    for part in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        if part.suffix == ".db3":
            _refuse_cut_database(part)
    return [read_bag(request, typestore=get_typestore(Stores.ROS2_HUMBLE), remedy=REMEDY)]


def _refuse_cut_database(path: Path) -> None:
    """SQLite reads a file that lost its tail without a word: compare its size with its header.

    Page size at byte 16 (1 means 65536) and page count at byte 28, which holds when the counters
    at bytes 24 and 92 agree: SQLite file format, sec. 1.3.
    """
    try:
        with path.open("rb") as file:
            header = file.read(100)
        size = path.stat().st_size
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", file=path) from None
    page = int.from_bytes(header[16:18], "big")
    wanted = (65536 if page == 1 else page) * int.from_bytes(header[28:32], "big")
    if len(header) < 100 or (header[24:28] == header[92:96] and size < wanted):
        raise DataError(f"the database is cut off: {size} of {wanted} bytes", file=path, remedy=REMEDY)
