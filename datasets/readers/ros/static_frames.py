"""Fixed transforms of a robot (`/tf_static`): where its sensors are, and how they are turned."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.conventions import BODY_AXES
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.readers.ros.streams import Stream

BASE = "base_link"
"""Frame of the body in a bag, by REP-105."""
Mounting = tuple[tuple[float, float, float], Array]
"""Position (m) of a sensor in the axes of the body, and rotation (3, 3) from its axes to those."""
STATIC = ("/tf_static", "tf2_msgs/msg/TFMessage")
RIGHT_ANGLE = 0.01
"""A rotation this near to one by right angles is taken for it (0.6 degrees)."""


class StaticFrames:
    """The tree of frames that a robot publishes once."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array, Array]] = {}

    def add(self, stream: Stream) -> None:
        """Take the transforms of messages tf2_msgs/TFMessage."""
        for block in stream.blocks:
            for row in range(len(block.rows)):
                self._add({path: column[row] for path, column in block.columns.items()})

    def _add(self, message: dict[str, Any]) -> None:
        i = 0
        while (at := f"transforms.{i}.child_frame_id") in message:
            start = f"transforms.{i}.transform"
            translation = np.array([message[f"{start}.translation.{axis}"] for axis in "xyz"])
            quaternion = np.array([message[f"{start}.rotation.{axis}"] for axis in "xyzw"])
            length = np.linalg.norm(quaternion)
            if np.isfinite(translation).all() and 0.9 < length < 1.1:
                parent = str(message[f"transforms.{i}.header.frame_id"])
                R = quaternion_to_matrix(quaternion / length)
                self._parents[_plain(str(message[at]))] = (_plain(parent), translation, R)
            i += 1

    def mounting(self, base: str, frame: str) -> Mounting | None:
        """Position (m) of a frame in the base's axes, and rotation (3, 3) from its axes to the base's.

        The base may have the frame's prefix: r1/base_link for r1/imu. None where no transforms connect them.
        """
        base, frame = _plain(base), _plain(frame)
        known = {frame, *self._parents, *(parent for parent, _, _ in self._parents.values())}
        if base not in known:
            base = f"{frame.rpartition('/')[0]}/{base}"
        from_base, from_frame = self._up_from(base), self._up_from(frame)
        common = next((name for name in from_frame if name in from_base), None)
        if common is None:
            return None
        (at, R), (base_at, base_R) = from_frame[common], from_base[common]
        position, R = base_R.T @ (at - base_at), base_R.T @ R
        exact = np.rint(R)
        x, y, z = position.tolist()
        return (x, y, z), exact if np.abs(R - exact).max() < RIGHT_ANGLE else R

    def _up_from(self, frame: str) -> dict[str, tuple[Array, Array]]:
        """Position and rotation of a frame in its own axes and those of all frames above it."""
        position, R = np.zeros(3), np.eye(3)
        found = {frame: (position, R)}
        while frame in self._parents:
            frame, translation, turn = self._parents[frame]
            if frame in found:  # a circle
                break
            position, R = translation + turn @ position, turn @ R
            found[frame] = position, R
        return found


def tells_turn(mounting: Mounting, frame: str, rig: Rig | None) -> bool:
    """Whether the transforms give how a sensor is turned. Where they have no turn it may be unknown to them:
    then axes that the vehicle file has for this frame hold."""
    if not np.array_equal(mounting[1], np.eye(3)) or rig is None:
        return True
    imu = rig.sensors.imu
    return _plain(imu.frame_id) != _plain(frame) or tuple(imu.axes) == BODY_AXES


def mounting_note(kind: str, frame: str, mounting: Mounting) -> str:
    """What `/tf_static` says of a sensor."""
    position, R = mounting
    turned = "" if np.array_equal(R, np.eye(3)) else " and turned"
    return f"{kind}: {frame} is at {np.round(position, 3).tolist()} m{turned}, by /tf_static"


def with_mountings(overrides: Overrides, mounted: Mapping[str, Mounting], rig: Rig | None) -> Overrides:
    """The geometry with the positions of IMU and antenna, unless the vehicle file has measured the latter."""
    if "imu" in mounted:
        overrides = dataclasses.replace(overrides, imu_m=mounted["imu"][0])
    if "gnss" in mounted and not antenna_is_known(rig):
        overrides = dataclasses.replace(overrides, antenna_m=mounted["gnss"][0])
    return overrides


def antenna_is_known(rig: Rig | None) -> bool:
    """Whether the vehicle file has measured or calibrated the place of the antenna."""
    antenna = rig.known.antenna_m if rig is not None else None
    return antenna is not None and antenna.known in ("measured", "calibrated")


def _plain(frame: str) -> str:
    return frame.lstrip("/")
