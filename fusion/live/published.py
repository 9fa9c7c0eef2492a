"""What a running estimator publishes, as ROS 2 messages: odometry, transforms, slip, ground, diagnostics.

Frames are those of REP-105: `map` -> `odom` takes the jumps of fixes, `odom` -> `base_link` is continuous.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import matrix_to_quaternion, quaternion_to_matrix
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.writers import ros_messages as ros
from terrafusion.datasets.writers.cdr import CdrTemplate, split
from terrafusion.datasets.writers.mcap_estimate import Level, Status, WrittenEstimate
from terrafusion.datasets.writers.mcap_file import TopicMessages
from terrafusion.fusion.estimate.estimate import STATUS, State
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.history import History
from terrafusion.fusion.outputs.ros_estimate import written_estimate

TYPES = {
    "/odometry": "nav_msgs/msg/Odometry",
    "/odometry/map": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/terrafusion/slip": "std_msgs/msg/Float64",
    "/terrafusion/ground": "std_msgs/msg/String",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Topics that are published, and their types."""


class Frames(NamedTuple):
    """Names of the frames of REP-105."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"


class PublishedMessage(NamedTuple):
    """One message: topic, type and CDR."""

    topic: str
    msgtype: str
    cdr: bytes


def odometry(topic: str, state: State, frame: str, child: str) -> PublishedMessage:
    """The state as nav_msgs/Odometry; a pose covariance that is unknown is 1e6 on the diagonal."""
    path = _path(state)
    if np.isnan(state.covariance).any():
        path = dataclasses.replace(path, covariance=np.diag([ros.UNKNOWN_VARIANCE] * 6)[None])
    found = ros.trajectory(topic, path, child, frame=frame, twist_covariance=state.twist_covariance[None])
    return _first(found, topic)


def transforms(in_map: State, in_odom: State, frames: Frames) -> list[PublishedMessage]:
    """`map` -> `odom` and `odom` -> `base_link` of one robot, known in both frames."""
    R = quaternion_to_matrix(in_map.quaternion) @ quaternion_to_matrix(in_odom.quaternion).T
    correction = dataclasses.replace(
        in_map, position_m=in_map.position_m - R @ in_odom.position_m, quaternion=matrix_to_quaternion(R)
    )
    pairs = (correction, frames.map, frames.odom), (in_odom, frames.odom, frames.base)
    return [_first(ros.transforms(_path(state), parent, child), "/tf") for state, parent, child in pairs]


def ground(state: State) -> list[PublishedMessage]:
    """Slip, and the most probable class of ground."""
    slip = CdrTemplate().field("data").rows(1)
    slip["data"] = state.slip
    out = [PublishedMessage("/terrafusion/slip", TYPES["/terrafusion/slip"], split(slip)[0])]
    if state.terrain:
        best = max(state.terrain, key=state.terrain.__getitem__)
        out.append(_first(ros.text("/terrafusion/ground", state.t_ns, best), "/terrafusion/ground"))
    return out


def diagnostics(
    t_ns: int, estimator: Estimator | None, status_s: float, counts: Mapping[str, int], problem: str
) -> PublishedMessage:
    """Status, ground, noise and states as bags have them, and counts of what was refused.

    Args:
        t_ns: stamp.
        estimator: None before its sensors are known.
        status_s: how long the status has lasted.
        counts: by name, what was received and refused.
        problem: the last thing that went wrong, "" for nothing.
    """
    statuses: list[Status] = []
    state = None if estimator is None else estimator.latest()
    if state is not None and estimator is not None:
        history = History()
        history.add(state, estimator.weights.noise)
        estimate = history.estimate(estimator.weights.detector.classes, [], ())
        for status in written_estimate(estimate).diagnostics[0]:
            if status.name == "terrafusion/localisation":
                values = {**status.values, "status_s": f"{status_s:.1f}"}
                status = dataclasses.replace(status, values=values)
            statuses += [status] if status.name != "terrafusion/gates" else []
        counts = {
            **counts,
            "rejected_gnss": estimator.gnss.rejected,
            "untimely_gnss": estimator.gnss.too_late + estimator.newest.refused.get("gnss", 0),
            "rejected_wheels": estimator.wheels_rejected,
        }
    else:
        name = "waiting" if estimator is None else estimator.status
        values = {"status": name, "status_s": f"{status_s:.1f}"}
        statuses.append(Status("terrafusion/localisation", Level.WARN, STATUS[name], values))
    level = Level.WARN if problem else Level.OK
    texts = {name: str(count) for name, count in counts.items()}
    statuses.append(Status("terrafusion/input", level, problem or "all messages are of use", texts))
    nothing = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    written = WrittenEstimate(nothing, None, "map", np.array([t_ns]), [statuses])
    return _first(list(written.topics(0))[-1], "/diagnostics")


def _path(state: State) -> Trajectory:
    R = quaternion_to_matrix(state.quaternion)
    twist: Array = np.concatenate([R.T @ state.velocity_mps, state.angular_velocity_radps])
    return Trajectory(
        np.array([state.t_ns], dtype=np.int64),
        state.position_m[None],
        state.quaternion[None],
        twist[None],
        state.covariance[None],
    )


def _first(found: TopicMessages, topic: str) -> PublishedMessage:
    return PublishedMessage(topic, found.msgtype, found.encode(slice(0, 1))[0])
