"""`terrafusion.open`: any readable log."""

from collections.abc import Mapping
from pathlib import Path

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle


def open(
    path: str | Path,
    *,
    vehicle: str | Path | VehicleParams | None = None,
    topics: Mapping[str, str] | None = None,
    stamps: str = "header",
    repair_clock: bool = False,
    columns: str | Path | None = None,
) -> Recording:
    """Read the one recording of a log, whatever its format.

    Args:
        path: a log folder, a ROS bag, a table, ..., or the name of a recording in the catalogue
            (`set/recording`). `path#3` is the fourth of several.
        vehicle: name, YAML file or `Vehicle`: mounting of the IMU, usual topics of a bag, accuracy of fixes
            that state none. `replay` with a vehicle turns the IMU of a bag that was opened without one.
        topics: topic of a channel of a bag, such as {"imu": "/imu/data", "wheels": "/odom"}.
        stamps: times of a bag: "header" (when measured) or "receipt" (when recorded).
        repair_clock: remove steps of a clock, which are refused otherwise.
        columns: YAML file that says what the columns of a plain table are.

    Raises:
        TerrafusionError: in one line the file, the channel, the time where known, and the remedy.
    """
    rig = None if vehicle is None else as_vehicle(vehicle).rig()
    return open_recording(
        path, rig=rig, topics=topics, stamps=stamps, repair_clock=repair_clock, columns=columns
    )
