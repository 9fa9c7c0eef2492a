"""Small bags of either ROS, written by rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
T0 = 1_600_000_000_000_000_000
Message = tuple[str, str, int, Any]
"""BagTopic, type, receipt time ns, message."""


class Make:
    """Messages of one type store."""

    def __init__(self, store: Any) -> None:
        self.store, self.ros1 = store, store is ROS1

    def new(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self.new("builtin_interfaces/msg/Time", *divmod(t_ns, 10**9))
        return self.new("std_msgs/msg/Header", *([0] if self.ros1 else []), stamp, frame)

    def vector(self, x: float, y: float, z: float) -> Any:
        return self.new("geometry_msgs/msg/Vector3", x, y, z)

    def imu(
        self, t_ns: int, gyro: Any = (0.0, 0.0, 0.0), accel: Any = (0.0, 0.0, 9.81), frame: str = "base_link",
        gyro_known: bool = True,
    ) -> Any:  # fmt: skip
        q = self.new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        covariance = np.zeros(9)
        gyro_covariance = np.array([0.0 if gyro_known else -1.0, *np.zeros(8)])
        return self.new(
            "sensor_msgs/msg/Imu", self.header(t_ns, frame), q, covariance, self.vector(*gyro),
            gyro_covariance, self.vector(*accel), covariance,
        )  # fmt: skip

    def odometry(
        self, t_ns: int, v: float, rate: float, x: float = 0.0, q: Any = (0.0, 0.0, 0.0, 1.0)
    ) -> Any:
        pose = self.new(
            "geometry_msgs/msg/Pose", self.new("geometry_msgs/msg/Point", x, 0.0, 0.0),
            self.new("geometry_msgs/msg/Quaternion", *q),
        )  # fmt: skip
        twist = self.new("geometry_msgs/msg/Twist", self.vector(v, 0.0, 0.0), self.vector(0.0, 0.0, rate))
        return self.new(
            "nav_msgs/msg/Odometry", self.header(t_ns, "odom"), "base_link",
            self.new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            self.new("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )  # fmt: skip

    def fix(
        self, t_ns: int, lat: float, lon: float, alt: float = 100.0, status: int = 0, kind: int = 2
    ) -> Any:
        return self.new(
            "sensor_msgs/msg/NavSatFix", self.header(t_ns, "gps"),
            self.new("sensor_msgs/msg/NavSatStatus", status, 1), lat, lon, alt,
            np.diag([0.25, 0.36, 4.0]).ravel(), kind,
        )  # fmt: skip

    def joints(self, t_ns: int, names: list[str], angle: list[float], speed: list[float]) -> Any:
        return self.new(
            "sensor_msgs/msg/JointState", self.header(t_ns, ""), names, np.array(angle), np.array(speed),
            np.zeros(0),
        )  # fmt: skip


def write_ros1(path: Path, messages: list[Message]) -> Path:
    with Writer1(path) as writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, t_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=ROS1)
            writer.write(connections[topic], t_ns, ROS1.serialize_ros1(message, msgtype))
    return path


def write_ros2(path: Path, messages: list[Message], plugin: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer2(path, version=8, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, t_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=ROS2)
            writer.write(connections[topic], t_ns, ROS2.serialize_cdr(message, msgtype))
    return path


def imu_messages(make: Make, topic: str = "/imu/data", n: int = 20, **fields: Any) -> list[Message]:
    times = [T0 + i * 10_000_000 for i in range(n)]
    return [(topic, "sensor_msgs/msg/Imu", t, make.imu(t, **fields)) for t in times]


def odometry_messages(
    make: Make, topic: str = "/odom", n: int = 20, v: float = 1.0, rate: float = 0.5
) -> list[Message]:
    times = [T0 + i * 50_000_000 for i in range(n)]
    return [(topic, "nav_msgs/msg/Odometry", t, make.odometry(t, v, rate)) for t in times]


MAKE1, MAKE2 = Make(ROS1), Make(ROS2)
