"""`open_recording`: one door to every format."""

from __future__ import annotations

from pathlib import Path

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.sensors import Rig

STAMPS = ("header", "receipt")
KINDS = "give a log folder (with meta.yaml), a ROS 1 .bag, or a ROS 2 bag (its folder, .mcap, .db3)"


def open_recording(
    path: Path | str,
    *,
    rig: Rig | None = None,
    topics: dict[str, str] | None = None,
    stamps: str = "header",
) -> Recording:
    """Read a recorded drive, whatever its format.

    Args:
        path: a log folder, a ROS 1 `.bag`, a ROS 2 bag folder, or a lone `.mcap` or `.db3` file.
        rig: geometry of the robot: how its IMU is mounted, the track its odometry uses, its usual
            topics. Without it the IMU is taken as mounted along the body axes.
        topics: topic of a channel where the choice by type is not the one wanted, such as
            {"imu": "/imu/data", "wheels": "/odom", "gnss": "/fix"}; ROS bags only.
        stamps: times of a ROS bag: "header" (when measured) or "receipt" (when recorded).

    Returns:
        Recording; its notes tell what was chosen, assumed and left out.

    Raises:
        TerrafusionError: in one line the file, the channel, the time where known, and the remedy.
    """
    path = Path(path)
    if stamps not in STAMPS:
        raise DataError(f"stamps is '{stamps}'", file=path, remedy=f"give one of {', '.join(STAMPS)}")
    try:
        if not path.exists():
            raise DataError("no such file or folder", file=path, remedy="check the path")
        ros = "ros1" if path.suffix == ".bag" and path.is_file() else "ros2"
        if path.is_dir() and ((path / "meta.yaml").is_file() or not (path / "metadata.yaml").is_file()):
            ros = ""
        elif path.is_file() and path.suffix not in (".bag", ".mcap", ".db3"):
            raise DataError(f"unknown kind of file '{path.suffix or path.name}'", file=path, remedy=KINDS)
        if path.is_file() and path.stat().st_size == 0:
            raise DataError("the file is empty", file=path, remedy="record or copy it again")
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", file=path) from None
    if not ros:
        from terrafusion.datasets.readers.log_folder import read_log_folder

        recording = read_log_folder(path)
        unused = [word for word, given in (("topics", topics), ("stamps", stamps != "header")) if given]
        if unused:
            return recording.with_notes(f"{' and '.join(unused)} only matter for ROS bags; not used here")
        return recording
    if ros == "ros1":
        from terrafusion.datasets.readers.ros1 import read_ros1

        return read_ros1(path, rig=rig, topics=topics, stamps=stamps)
    from terrafusion.datasets.readers.ros2 import read_ros2

    return read_ros2(path, rig=rig, topics=topics, stamps=stamps)
