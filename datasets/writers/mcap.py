"""Write a recording, and an estimate beside it, as one ROS 2 MCAP file."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.recording import Recording
from terrafusion.datasets.trajectory import Trajectory
from terrafusion.datasets.writers.ros_messages import Composer, Stamped

if TYPE_CHECKING:
    from terrafusion.datasets.sensors import Rig

NOMINAL_DATUM = (0.0, 0.0, 0.0)
"""ENU origin of a recording that has none: latitude, longitude (deg), height (m)."""

Part = tuple[str, str, Iterator[Stamped]]
"""Topic, message type, stamped messages."""


def write_mcap(
    recording: Recording,
    path: Path | str,
    estimate: Trajectory | None = None,
    *,
    rig: Rig | None = None,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write one `.mcap` file (profile ros2, CDR, definitions inside) with standard messages.

    Topics: `/imu/data` Imu, `/joint_states` JointState (wheels in rad/s) or `/wheel/odom` Odometry
    (in m/s), `/fix` NavSatFix, `/fix_velocity` TwistWithCovarianceStamped (east, north, up),
    `/datum` NavSatFix (the ENU origin, once), `/cmd_vel` TwistStamped, `/terrain` String,
    `/ground_truth/odom` and `/odometry/filtered` (the estimate) Odometry, map -> base_link.
    Log times are the stamps.

    Args:
        recording: the drive.
        path: the file to write.
        estimate: poses to write beside it, with covariance in ROS order where known.
        rig: gives the track that turns side speeds in m/s into a yaw rate; the recording's own
            `overrides.track_m` goes first.
        overwrite: replace a file that exists.

    Returns:
        Sentences on what the message types could not hold and was left out.

    Raises:
        DataError: the file exists, cannot be written, a time before 1970, or no track is known.
    """
    path = Path(path)
    if path.is_dir() or (path.exists() and not overwrite):
        raise DataError("exists already", file=path, remedy="remove it or give another name")
    if recording.start_ns < 0:
        raise DataError(f"start_ns is {recording.start_ns}", file=path, remedy="ROS has no time before 1970")
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    composer = Composer(dict(store.types))
    packed: list[tuple[int, int, bytes]] = []
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mcap-") as scratch:
            bag = Path(scratch) / "bag"
            writer = Writer(bag, version=8, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            with writer:
                connections: list[Any] = []
                for topic, msgtype, messages in _parts(recording, estimate, composer, path, rig):
                    index = len(connections)
                    connections.append(writer.add_connection(topic, msgtype, typestore=store))
                    packed += [(t, index, bytes(store.serialize_cdr(m, msgtype))) for t, m in messages]
                packed.sort(key=lambda item: item[:2])
                for t, index, raw in packed:
                    writer.write(connections[index], t, raw)
            shutil.move(next(bag.glob("*.mcap")), path)
    except OSError as error:
        raise DataError(
            f"cannot be written: {error.strerror or error}",
            file=path,
            remedy="choose a folder you may write to, with room on the disk",
        ) from None
    return tuple(composer.left_out)


def _parts(
    recording: Recording, estimate: Trajectory | None, composer: Composer, path: Path, rig: Rig | None
) -> Iterator[Part]:
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth
    if recording.command is not None:
        yield "/cmd_vel", "geometry_msgs/msg/TwistStamped", composer.command(recording.command)
    if wheels is not None and wheels.unit == "radps":
        yield "/joint_states", "sensor_msgs/msg/JointState", composer.joint_states(wheels)
    elif wheels is not None:
        track = recording.overrides.track_m or (rig.track_m if rig else None)
        if track is None and wheels.has_sides():
            raise DataError(
                "side speeds in m/s need the track to become a yaw rate, and none is known",
                file=path,
                channel="wheels",
                remedy="give the vehicle (--vehicle), or track_m in meta.yaml",
            )
        if wheels.angle_rad is not None:
            composer.left_out.append("wheels: wheel angles (Odometry has none)")
        yield "/wheel/odom", "nav_msgs/msg/Odometry", composer.wheel_odometry(wheels, track or 1.0)
    if recording.imu is not None:
        yield "/imu/data", "sensor_msgs/msg/Imu", composer.imu(recording.imu)
    if gnss is not None and len(gnss):
        datum = recording.datum or NOMINAL_DATUM
        if recording.datum is None:
            composer.left_out.append("gnss: no datum is known; latitude and longitude are about 0, 0, 0 m")
        start = min(int(gnss.t_ns[0]), recording.start_ns)
        origin = composer.fix(start, datum, 0, np.zeros(3), 0)
        yield "/datum", "sensor_msgs/msg/NavSatFix", iter([(start, origin)])
        yield "/fix", "sensor_msgs/msg/NavSatFix", composer.fixes(gnss, datum)
        if gnss.velocity_enu_mps is not None:
            kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
            yield "/fix_velocity", kind, composer.gnss_velocity(gnss)
    if recording.motor is not None:
        composer.left_out.append("motor: currents and voltages (no standard message fits)")
    if recording.terrain is not None:
        yield "/terrain", "std_msgs/msg/String", composer.terrain(recording.terrain)
    if truth is not None:
        child = "base_link" if recording.truth_frame == "base" else "gnss_antenna"
        yield "/ground_truth/odom", "nav_msgs/msg/Odometry", composer.trajectory(truth, child)
    if estimate is not None:
        yield "/odometry/filtered", "nav_msgs/msg/Odometry", composer.trajectory(estimate, "base_link")
