"""Channels of a recording -> ROS 2 messages of the standard types (REP-103, REP-105 frames)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.frames import enu_to_geodetic, rpy_to_quaternion
from terrafusion.datasets.recording import Command, Fix, Gnss, Imu, Terrain, Wheels
from terrafusion.datasets.trajectory import Trajectory

Array = NDArray[np.float64]
Stamped = tuple[int, Any]
"""Time in ns and the message."""

UNKNOWN_VARIANCE = 1e6
"""By ROS custom: a variance this large marks a quantity that is not known."""

STATUS_OF_FIX = {Fix.NONE: -1, Fix.SINGLE: 0, Fix.DGPS: 1, Fix.FLOAT: 1, Fix.FIXED: 2}
IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass
class Composer:
    """Makes messages of one type store; `left_out` gathers what the types cannot hold."""

    types: dict[str, Any]
    left_out: list[str] = field(default_factory=list)

    def _new(self, name: str, *values: Any) -> Any:
        return self.types[name](*values)

    def header(self, t_ns: int, frame: str) -> Any:
        """std_msgs/Header with the stamp in whole nanoseconds."""
        stamp = self._new("builtin_interfaces/msg/Time", *divmod(t_ns, 1_000_000_000))
        return self._new("std_msgs/msg/Header", stamp, frame)

    def vector(self, xyz: Any) -> Any:
        """geometry_msgs/Vector3."""
        return self._new("geometry_msgs/msg/Vector3", *(float(v) for v in xyz))

    def quaternion(self, xyzw: Any) -> Any:
        """geometry_msgs/Quaternion."""
        return self._new("geometry_msgs/msg/Quaternion", *(float(v) for v in xyzw))

    def twist(self, six: Any) -> Any:
        """geometry_msgs/Twist of linear then angular velocity."""
        return self._new("geometry_msgs/msg/Twist", self.vector(six[:3]), self.vector(six[3:]))

    def imu(self, imu: Imu) -> Iterator[Stamped]:
        """sensor_msgs/Imu in base_link; an absent group is marked by covariance -1, an absent axis is NaN."""
        present = ~np.isnan(np.hstack([imu.gyro_radps, imu.accel_mps2]))
        full = present[:, present.any(axis=0)].all(axis=1)
        if not full.all():
            self.left_out.append(f"imu: {int((~full).sum())} samples with missing values")
            imu = imu.select(full)
        groups = []
        for values in (imu.gyro_radps, imu.accel_mps2):
            absent = bool(np.isnan(values).all())
            covariance = np.zeros(9)
            covariance[0] = -1.0 if absent else 0.0
            groups.append((np.nan_to_num(values) if absent else values, covariance))
        unknown = np.array([-1.0, *np.zeros(8)])
        (gyro, gyro_covariance), (accel, accel_covariance) = groups
        for t, w, f in zip(imu.t_ns.tolist(), gyro, accel, strict=True):
            yield (
                t,
                self._new(
                    "sensor_msgs/msg/Imu",
                    self.header(t, "base_link"),
                    self.quaternion(IDENTITY),
                    unknown,
                    self.vector(w),
                    gyro_covariance,
                    self.vector(f),
                    accel_covariance,
                ),
            )

    def joint_states(self, wheels: Wheels) -> Iterator[Stamped]:
        """sensor_msgs/JointState with one joint a wheel, rad/s and rad."""
        names = [f"{name}_wheel_joint" for name in wheels.names]
        full = np.isfinite(wheels.speed).all(axis=1)
        if wheels.angle_rad is not None:
            full &= np.isfinite(wheels.angle_rad).all(axis=1)
        if not full.all():
            self.left_out.append(f"wheels: {int((~full).sum())} samples with missing values")
            wheels = wheels.select(full)
        none = np.zeros(0)
        for i, t in enumerate(wheels.t_ns.tolist()):
            angle = none if wheels.angle_rad is None else wheels.angle_rad[i]
            header = self.header(t, "")
            yield t, self._new("sensor_msgs/msg/JointState", header, names, angle, wheels.speed[i], none)

    def wheel_odometry(self, wheels: Wheels, track_m: float) -> Iterator[Stamped]:
        """nav_msgs/Odometry of wheel speeds in m/s: body twist, and the pose by dead reckoning."""
        full = np.isfinite(wheels.speed).all(axis=1)
        if not full.all():
            self.left_out.append(f"wheels: {int((~full).sum())} samples with missing values")
            wheels = wheels.select(full)
        sides = wheels.side_speeds_mps(1.0)
        v, rate = sides.mean(axis=1), (sides[:, 1] - sides[:, 0]) / track_m
        x, y, yaw = dead_reckoning(wheels.t_ns, v, rate)
        q = rpy_to_quaternion(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))
        pose_covariance = np.diag([0.0, 0.0, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, 0.0])
        twist_covariance = np.zeros((6, 6))
        if not wheels.has_sides():
            twist_covariance[5, 5] = UNKNOWN_VARIANCE
        for i, t in enumerate(wheels.t_ns.tolist()):
            yield (
                t,
                self.odometry(
                    t,
                    ("odom", "base_link"),
                    (x[i], y[i], 0.0),
                    q[i],
                    pose_covariance,
                    (v[i], 0.0, 0.0, 0.0, 0.0, rate[i]),
                    twist_covariance,
                ),
            )

    def odometry(
        self,
        t_ns: int,
        frames: tuple[str, str],
        position: Any,
        quaternion: Any,
        pose_covariance: Array,
        twist: Any,
        twist_covariance: Array,
    ) -> Any:
        """One nav_msgs/Odometry; covariances (6, 6) in ROS order."""
        point = self._new("geometry_msgs/msg/Point", *(float(v) for v in position))
        pose = self._new("geometry_msgs/msg/Pose", point, self.quaternion(quaternion))
        return self._new(
            "nav_msgs/msg/Odometry",
            self.header(t_ns, frames[0]),
            frames[1],
            self._new("geometry_msgs/msg/PoseWithCovariance", pose, pose_covariance.ravel()),
            self._new("geometry_msgs/msg/TwistWithCovariance", self.twist(twist), twist_covariance.ravel()),
        )

    def trajectory(self, trajectory: Trajectory, child: str) -> Iterator[Stamped]:
        """nav_msgs/Odometry, map -> `child`; what is unknown is 0 under a variance of 1e6."""
        n = len(trajectory)
        twist = trajectory.twist_body if trajectory.twist_body is not None else np.full((n, 6), np.nan)
        q = trajectory.quaternion if trajectory.quaternion is not None else np.tile(IDENTITY, (n, 1))
        covariance = np.zeros((n, 6, 6)) if trajectory.covariance is None else trajectory.covariance
        flat = np.isnan(trajectory.position_m[:, 2])
        for i, t in enumerate(trajectory.t_ns.tolist()):
            pose_covariance = covariance[i].copy()
            if flat[i]:
                pose_covariance[2, 2] = UNKNOWN_VARIANCE
            if trajectory.quaternion is None:
                pose_covariance[[3, 4, 5], [3, 4, 5]] = UNKNOWN_VARIANCE
            yield (
                t,
                self.odometry(
                    t,
                    ("map", child),
                    np.nan_to_num(trajectory.position_m[i]),
                    q[i],
                    pose_covariance,
                    np.nan_to_num(twist[i]),
                    np.diag(np.where(np.isnan(twist[i]), UNKNOWN_VARIANCE, 0.0)),
                ),
            )

    def fixes(self, gnss: Gnss, datum: tuple[float, float, float]) -> Iterator[Stamped]:
        """sensor_msgs/NavSatFix of the antenna."""
        if (gnss.fix == Fix.FLOAT).any():
            self.left_out.append("gnss: NavSatFix has no 'float' fix; written as augmented (SBAS)")
        enu = np.where(np.isnan(gnss.enu_m) & [False, False, True], 0.0, gnss.enu_m)
        llh = enu_to_geodetic(enu, datum)
        llh[np.isnan(gnss.enu_m[:, 2]), 2] = np.nan
        for i, t in enumerate(gnss.t_ns.tolist()):
            variance = gnss.sigma_enu_m[i] ** 2
            known = bool(np.isfinite(variance[:2]).all())
            yield t, self.fix(t, llh[i], STATUS_OF_FIX[Fix(gnss.fix[i])], variance, 2 if known else 0)

    def fix(self, t_ns: int, llh: Any, status: int, variance: Array, kind: int) -> Any:
        """One sensor_msgs/NavSatFix; `kind` is its position_covariance_type."""
        return self._new(
            "sensor_msgs/msg/NavSatFix",
            self.header(t_ns, "gnss_antenna"),
            self._new("sensor_msgs/msg/NavSatStatus", status, 1),
            *(float(v) for v in llh),
            np.diag(variance).ravel(),
            kind,
        )

    def gnss_velocity(self, gnss: Gnss) -> Iterator[Stamped]:
        """geometry_msgs/TwistWithCovarianceStamped: east, north, up velocity of the antenna."""
        assert gnss.velocity_enu_mps is not None
        sigma = gnss.sigma_v_mps if gnss.sigma_v_mps is not None else np.zeros(len(gnss))
        for i in np.flatnonzero(np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1)).tolist():
            t = int(gnss.t_ns[i])
            velocity = gnss.velocity_enu_mps[i]
            variance = np.where(np.isnan(velocity), UNKNOWN_VARIANCE, np.nan_to_num(sigma[i]) ** 2)
            twist = self.twist([*np.nan_to_num(velocity), 0.0, 0.0, 0.0])
            covariance = np.diag([*variance, *np.full(3, UNKNOWN_VARIANCE)]).ravel()
            body = self._new("geometry_msgs/msg/TwistWithCovariance", twist, covariance)
            yield t, self._new("geometry_msgs/msg/TwistWithCovarianceStamped", self.header(t, "map"), body)

    def command(self, command: Command) -> Iterator[Stamped]:
        """geometry_msgs/TwistStamped in base_link."""
        full = np.isfinite(command.v_mps) & np.isfinite(command.yaw_rate_radps)
        if not full.all():
            self.left_out.append(f"command: {int((~full).sum())} samples with missing values")
            command = command.select(full)
        rows = zip(command.t_ns.tolist(), command.v_mps, command.yaw_rate_radps, strict=True)
        for t, v, rate in rows:
            twist = self.twist((v, 0.0, 0.0, 0.0, 0.0, rate))
            yield t, self._new("geometry_msgs/msg/TwistStamped", self.header(t, "base_link"), twist)

    def terrain(self, terrain: Terrain) -> Iterator[Stamped]:
        """std_msgs/String with the label, at the time of the label."""
        if terrain.probabilities is not None:
            self.left_out.append("terrain: class probabilities (the label is kept)")
        for t, label in zip(terrain.t_ns.tolist(), terrain.label.tolist(), strict=True):
            yield t, self._new("std_msgs/msg/String", str(label))


def dead_reckoning(t_ns: NDArray[np.int64], v_mps: Array, rate_radps: Array) -> tuple[Array, Array, Array]:
    """x, y (m) and yaw (rad), each (N,), from the origin, by the trapezoid rule."""
    dt = np.diff(t_ns) * 1e-9

    def integral(rate: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)])[: len(t_ns)]

    yaw = integral(rate_radps)
    return integral(v_mps * np.cos(yaw)), integral(v_mps * np.sin(yaw)), yaw
