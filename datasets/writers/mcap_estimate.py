"""An estimate beside a recording in a bag: odometry, transform and diagnostics, as ROS 2 messages."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.writers import ros_messages as ros
from terrafusion.datasets.writers.cdr import CdrTemplate, split
from terrafusion.datasets.writers.mcap_file import TopicMessages


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK, WARN, ERROR, STALE = range(4)


@dataclass(frozen=True)
class Status:
    """One diagnostic_msgs/DiagnosticStatus; `name` is a path such as "terrafusion/ground"."""

    name: str
    level: Level
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class WrittenEstimate:
    """What is written of an estimate; none of it is part of the recording, and none is read back.

    Attributes:
        trajectory: poses of base_link, body twist, and covariance of the pose in ROS order.
        twist_covariance: (N, 6, 6) of the body twist, linear then angular; None where it is unknown.
        frame: "map" for a path that GNSS ties to the ground, and that may jump; "odom" for one whose
            start and heading are arbitrary, and that drifts but never jumps (REP-105).
        diagnostics_ns, diagnostics: times (M,) and the statuses of each.
    """

    trajectory: Trajectory
    twist_covariance: Array | None = None
    frame: str = "map"
    diagnostics_ns: TimesNs = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    diagnostics: Sequence[Sequence[Status]] = ()

    def topics(self, shift_ns: int) -> Iterator[TopicMessages]:
        """`/odometry/filtered`, and `/tf` and `/diagnostics` where there is something; stamps are shifted."""
        path = dataclasses.replace(self.trajectory, t_ns=self.trajectory.t_ns + shift_ns)
        yield ros.trajectory(
            "/odometry/filtered", path, "base_link", frame=self.frame, twist_covariance=self.twist_covariance
        )
        if path.quaternion is not None and len(path):
            yield ros.transforms(path, self.frame, "base_link")
        if len(self.diagnostics):
            yield _diagnostics(self.diagnostics_ns + shift_ns, self.diagnostics)


def _diagnostics(t_ns: TimesNs, statuses: Sequence[Sequence[Status]]) -> TopicMessages:
    """diagnostic_msgs/DiagnosticArray; texts differ in length, so each message has its own layout."""

    def encode(rows: slice) -> list[bytes]:
        return [_array(t, found) for t, found in zip(t_ns[rows].tolist(), statuses[rows], strict=True)]

    return TopicMessages("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", t_ns, encode)


def _array(t_ns: int, statuses: Sequence[Status]) -> bytes:
    layout = CdrTemplate().header("").constant("I", len(statuses))
    for status in statuses:
        layout.constant("B", int(status.level))
        layout.string(status.name).string(status.message).string("")
        layout.constant("I", len(status.values))
        for key, value in status.values.items():
            layout.string(key).string(value)
    return split(layout.stamped(np.array([t_ns], dtype=np.int64)))[0]
