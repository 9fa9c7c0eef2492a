"""Messages of one topic as arrays: the same for ROS 1 and ROS 2."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.readers.ros import topics
from terrafusion.datasets.readers.ros.layout import MessageBlock
from terrafusion.datasets.readers.ros.raw import BagError

UNKNOWN_VARIANCE = 1e6
"""By ROS custom, a variance this large marks an unknown quantity."""

TWIST_AT = {
    topics.TWIST: ("", ""),
    topics.TWIST_STAMPED: ("twist.", ""),
    topics.TWIST_COVARIANCE: ("twist.twist.", "twist.covariance."),
    topics.ODOMETRY: ("twist.twist.", "twist.covariance."),
}
"""What stands before a twist's fields, and before the entries of its covariance where it has one."""
POSE_AT = {
    topics.POSE: ("pose.", ""),
    topics.POSE_COVARIANCE: ("pose.pose.", "pose.covariance"),
    topics.ODOMETRY: ("pose.pose.", "pose.covariance"),
}
ACKERMANN_AT = {topics.ACKERMANN: "", topics.ACKERMANN_STAMPED: "drive."}
"""What stands before the fields of an AckermannDrive."""
DIAGONAL = range(0, 36, 7)
_RATE, _FORCE, _SIGMA = "angular_velocity", "linear_acceleration", "position_covariance"
FIELDS = {
    topics.IMU: (_RATE, f"{_RATE}_covariance.0", _FORCE, f"{_FORCE}_covariance.0"),
    topics.FIX: (
        "status.status", "latitude", "longitude", "altitude",
        f"{_SIGMA}_type", f"{_SIGMA}.0", f"{_SIGMA}.4", f"{_SIGMA}.8",
    ),
    topics.PRESSURE: ("fluid_pressure",),
    topics.FIELD: ("magnetic_field",),
    topics.JOINTS: ("name", "position", "velocity"),
}  # fmt: skip
"""Paths of the fields that are read of other types."""


def wanted_fields(kind: str, msgtype: str) -> tuple[str, ...]:
    """Paths of the fields that a channel takes from messages of a type; () for all of them."""
    fields = [*FIELDS.get(msgtype, ())]
    if msgtype in ACKERMANN_AT:
        fields += [f"{ACKERMANN_AT[msgtype]}{name}" for name in ("steering_angle", "speed")]
    if msgtype in TWIST_AT:
        twist, variance = TWIST_AT[msgtype]
        fields += [f"{twist}linear", f"{twist}angular"]
        fields += [f"{variance}{i}" for i in DIAGONAL if variance]
    if msgtype in POSE_AT:
        pose, covariance = POSE_AT[msgtype]
        fields += [f"{pose}position", f"{pose}orientation", "child_frame_id"]
        fields += [covariance] if kind == "truth" and covariance else []
    return ("header.stamp", "header.frame_id", *fields) if fields else ()


@dataclass(frozen=True, eq=False)
class Stream:
    """The messages of one topic.

    Attributes:
        receipt_ns: (N,) when the recorder got them.
        blocks: the messages as columns; one block unless their lists differ in length.
    """

    topic: str
    msgtype: str
    receipt_ns: TimesNs
    blocks: tuple[MessageBlock, ...]

    def __len__(self) -> int:
        return len(self.receipt_ns)

    def has(self, path: str) -> bool:
        """Whether all messages have this field, in one shape."""
        shapes = {b.columns[path].shape[1:] if path in b.columns else None for b in self.blocks}
        return len(shapes) == 1 and None not in shapes

    def column(self, path: str) -> NDArray[Any]:
        """Values (N, ...) of a field.

        Raises:
            BagError: the messages' definition has no such field.
        """
        if not self.has(path):
            raise BagError(f"its messages have no '{path}', as {self.msgtype} should", self.topic)
        if self._in_one_block:
            return self.blocks[0].columns[path]
        first = self.blocks[0].columns[path]
        out = np.empty((len(self), *first.shape[1:]), dtype=first.dtype)
        for block in self.blocks:
            out[block.rows] = block.columns[path]
        return out

    @cached_property
    def _in_one_block(self) -> bool:
        return len(self.blocks) == 1 and bool((np.diff(self.blocks[0].rows) == 1).all())

    def vectors(self, path: str, axes: str = "xyz") -> Array:
        """(N, k) of a field's x, y, z (and w)."""
        return np.stack([self.column(f"{path}.{axis}").astype(float) for axis in axes], axis=1)

    @cached_property
    def header_ns(self) -> TimesNs | None:
        """(N,) header stamps, None for types without a header."""
        if not self.has("header.stamp.sec"):
            return None
        seconds = self.column("header.stamp.sec").astype(np.int64)
        return np.asarray(seconds * 1_000_000_000 + self.column("header.stamp.nanosec").astype(np.int64))

    @cached_property
    def frame_ids(self) -> NDArray[Any]:
        """(N,) names of the header's frame without a leading slash; empty without a header."""
        if not self.has("header.frame_id"):
            return np.empty(0, dtype=object)
        names = self.column("header.frame_id")
        for name in set(names.tolist()):
            if name.startswith("/"):
                names = np.where(names == name, name.lstrip("/"), names)
        return names

    def select(self, rows: NDArray[Any]) -> "Stream":
        """The messages of a boolean mask, or in the order of an index array."""
        index = np.flatnonzero(rows) if rows.dtype == bool else rows
        new = np.full(len(self), -1, dtype=np.int64)
        new[index] = np.arange(len(index))
        blocks = []
        for block in self.blocks:
            order = np.argsort(new[block.rows], kind="stable")
            order = order[new[block.rows][order] >= 0]
            if order.size:
                columns = {path: column[order] for path, column in block.columns.items()}
                blocks.append(MessageBlock(new[block.rows[order]], columns))
        return Stream(self.topic, self.msgtype, self.receipt_ns[index], tuple(blocks))


def twists(stream: Stream) -> tuple[Array, Array]:
    """Body twists (N, 6), linear then angular, and the diagonal of their covariance (N, 6).

    The diagonal is NaN for types that have none.
    """
    at, variance = TWIST_AT[stream.msgtype]
    diagonal = np.full((len(stream), 6), np.nan)
    if variance:
        diagonal = np.stack([stream.column(f"{variance}{i}").astype(float) for i in DIAGONAL], axis=1)
    return np.hstack([stream.vectors(f"{at}linear"), stream.vectors(f"{at}angular")]), diagonal


def poses(stream: Stream) -> tuple[Array, Array, Array | None]:
    """Positions (N, 3), quaternions (N, 4) and covariances (N, 6, 6), None where not read or not there."""
    at, path = POSE_AT[stream.msgtype]
    covariance = None
    if path and stream.has(path):
        covariance = stream.column(path).astype(float).reshape(-1, 6, 6)
    return stream.vectors(f"{at}position"), stream.vectors(f"{at}orientation", "xyzw"), covariance
