"""Channels of a recording -> topics of ROS 2 messages of the standard types (REP-103, REP-105, REP-145).

Every function takes rows that a message can hold: the caller leaves the others out.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import (
    Barometer,
    Command,
    Fix,
    Gnss,
    Imu,
    Magnetometer,
    Steering,
    Terrain,
    Wheels,
)
from terrafusion.datasets.core.frames import enu_to_geodetic, rpy_to_quaternion
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.ros.exact import PREFIX, ROW, STAMP
from terrafusion.datasets.readers.ros.streams import UNKNOWN_VARIANCE
from terrafusion.datasets.writers.cdr import CdrTemplate, split
from terrafusion.datasets.writers.mcap_file import TopicMessages

STATUS_OF_FIX = {Fix.NONE: -1, Fix.SINGLE: 0, Fix.DGPS: 1, Fix.FLOAT: 1, Fix.FIXED: 2}
IDENTITY = (0.0, 0.0, 0.0, 1.0)
STEERING_JOINTS = {"angle": "steering_joint", "steering_wheel": "steering_wheel_joint"}
EARTH_M = 1e7
"""ENU coordinates beyond this are nowhere on Earth."""


def _topic(name: str, msgtype: str, layout: CdrTemplate, t_ns: TimesNs, **fields: Array) -> TopicMessages:
    """Messages with a header; `fields` (N, ...) go by the names of the layout."""

    def encode(rows: slice) -> list[bytes]:
        block = layout.stamped(t_ns[rows])
        for key, values in fields.items():
            block[key] = values[rows]
        return split(block)

    return TopicMessages(name, msgtype, t_ns, encode)


def text(name: str, t_ns: int, content: str) -> TopicMessages:
    """One latched std_msgs/String."""
    message = split(CdrTemplate().string(content).rows(1))
    return TopicMessages(
        name, "std_msgs/msg/String", np.array([t_ns]), lambda rows: message[rows], latched=True
    )


def imu(imu: Imu, frame: str) -> TopicMessages:
    """sensor_msgs/Imu; an absent group is zero under a covariance of -1, an absent axis is NaN."""
    layout = CdrTemplate().header(frame).constant("d", *IDENTITY, -1.0, *[0.0] * 8)
    fields = {}
    for name, values in (("gyro", imu.gyro_radps), ("accel", imu.accel_mps2)):
        absent = bool(np.isnan(values).all())
        layout.field(name, count=3).constant("d", -1.0 if absent else 0.0, *[0.0] * 8)
        fields[name] = np.nan_to_num(values) if absent else values
    return _topic("/imu/data", "sensor_msgs/msg/Imu", layout, imu.t_ns, **fields)


def pressure(barometer: Barometer) -> TopicMessages:
    """sensor_msgs/FluidPressure; the variance is not known, which is 0 there."""
    layout = CdrTemplate().header("base_link").field("pressure").constant("d", 0.0)
    kind = "sensor_msgs/msg/FluidPressure"
    return _topic("/pressure", kind, layout, barometer.t_ns, pressure=barometer.pressure_pa)


def magnetic_field(magnetometer: Magnetometer, frame: str) -> TopicMessages:
    """sensor_msgs/MagneticField, tesla; the covariance is not known, which is 0 there (REP-145)."""
    layout = CdrTemplate().header(frame).field("field", count=3).constant("d", *[0.0] * 9)
    kind = "sensor_msgs/msg/MagneticField"
    return _topic("/imu/mag", kind, layout, magnetometer.t_ns, field=magnetometer.field_t)


def joint_states(wheels: Wheels) -> TopicMessages:
    """sensor_msgs/JointState with one joint a wheel, rad/s and rad."""
    names = [f"{name}_wheel_joint" for name in wheels.names]
    angle = wheels.angle_rad if wheels.angle_rad is not None else wheels.speed[:, :0]
    layout = CdrTemplate().header("").strings(names)
    layout.sequence("angle", angle.shape[1]).sequence("speed", len(names)).sequence("effort", 0)
    fields = {"speed": wheels.speed} | ({"angle": angle} if angle.shape[1] else {})
    return _topic("/joint_states", "sensor_msgs/msg/JointState", layout, wheels.t_ns, **fields)


def steering(steering: Steering) -> TopicMessages:
    """sensor_msgs/JointState with the position of one joint an angle, rad."""
    names = [STEERING_JOINTS.get(name, f"{name}_steering_joint") for name in steering.names]
    layout = CdrTemplate().header("").strings(names)
    layout.sequence("angle", len(names)).sequence("speed", 0).sequence("effort", 0)
    angle = steering.angle_rad if len(names) > 1 else steering.angle_rad[:, 0]
    kind = "sensor_msgs/msg/JointState"
    return _topic("/steering/joint_states", kind, layout, steering.t_ns, angle=angle)


def _odometry(
    name: str, frames: tuple[str, str], t_ns: TimesNs, pose: Array, P: Array, twist: Array, Q: Array
) -> TopicMessages:
    """nav_msgs/Odometry of `pose` (N, 7) and `twist` (N, 6); covariances (N, 36) in ROS order."""
    layout = CdrTemplate().header(frames[0]).string(frames[1])
    layout.field("pose", count=7).field("P", count=36).field("twist", count=6).field("Q", count=36)
    return _topic(name, "nav_msgs/msg/Odometry", layout, t_ns, pose=pose, P=P, twist=twist, Q=Q)


def wheel_odometry(wheels: Wheels, track_m: float | None) -> TopicMessages:
    """Wheel speeds in m/s as body twist, and the pose by dead reckoning.

    Where sides or track are not known the yaw rate is zero under a variance of 1e6.
    """
    n = len(wheels)
    with np.errstate(all="ignore"):  # impossible speeds, too, are written
        sides = wheels.side_speeds_mps(1.0)
        v = sides.mean(axis=1)
        rate = (sides[:, 1] - sides[:, 0]) / track_m if track_m is not None else np.zeros(n)
        x, y, yaw = dead_reckoning(wheels.t_ns, v, rate)
        yaw = np.where(np.isfinite(yaw), yaw, 0.0)
    q = rpy_to_quaternion(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))
    pose = np.hstack([np.stack([x, y, np.zeros(n)], axis=1), q])
    twist = np.zeros((n, 6))
    twist[:, 0], twist[:, 5] = v, rate
    unknown = 0.0 if wheels.has_sides() and track_m is not None else UNKNOWN_VARIANCE
    P = np.diag([0.0, 0.0, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, unknown])
    Q = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, unknown])
    P_rows, Q_rows = (np.tile(covariance.ravel(), (n, 1)) for covariance in (P, Q))
    return _odometry("/wheel/odom", ("odom", "base_link"), wheels.t_ns, pose, P_rows, twist, Q_rows)


def trajectory(
    name: str,
    trajectory: Trajectory,
    child: str,
    *,
    frame: str = "map",
    twist_covariance: Array | None = None,
) -> TopicMessages:
    """nav_msgs/Odometry, `frame` -> `child`; what is unknown is 0 under a variance of 1e6.

    The covariance of the pose is about the axes of `frame`, that of the twist (N, 6, 6) about those
    of `child`, as the message asks.
    """
    n = len(trajectory)
    q = _oriented(trajectory)
    P = np.zeros((n, 6, 6)) if trajectory.covariance is None else trajectory.covariance.copy()
    P[np.isnan(trajectory.position_m[:, 2]), 2, 2] = UNKNOWN_VARIANCE
    if trajectory.quaternion is None:
        P[:, [3, 4, 5], [3, 4, 5]] = UNKNOWN_VARIANCE
    twist = trajectory.twist_body if trajectory.twist_body is not None else np.full((n, 6), np.nan)
    Q = np.zeros((n, 6, 6)) if twist_covariance is None else twist_covariance.copy()
    unknown = np.isnan(twist)
    Q[unknown[:, :, None] | unknown[:, None, :]] = 0.0
    Q[:, range(6), range(6)] += np.where(unknown, UNKNOWN_VARIANCE, 0.0)
    pose = np.hstack([_known(trajectory.position_m), q])
    flat = (P.reshape(n, 36), Q.reshape(n, 36))
    return _odometry(name, (frame, child), trajectory.t_ns, pose, flat[0], _known(twist), flat[1])


def _oriented(trajectory: Trajectory) -> Array:
    """Orientations (N, 4), the identity where they are unknown."""
    q = trajectory.quaternion
    return q if q is not None else np.tile(IDENTITY, (len(trajectory), 1))


def _known(values: Array) -> Array:
    """The values with 0 for NaN."""
    return np.where(np.isnan(values), 0.0, values)


def fixes(gnss: Gnss, datum: tuple[float, float, float]) -> TopicMessages:
    """sensor_msgs/NavSatFix of the antenna; an unknown height is NaN, a place not on Earth is no fix."""
    flat = np.asarray(np.isnan(gnss.enu_m[:, 2]))
    enu = np.where(flat[:, None] & [False, False, True], 0.0, gnss.enu_m)
    lost = np.asarray(~(np.abs(enu) < EARTH_M).all(axis=1))
    llh = enu_to_geodetic(np.where(lost[:, None], 0.0, enu), datum)
    llh[lost] = np.nan
    llh[flat, 2] = np.nan
    status = np.array([STATUS_OF_FIX[Fix(code)] for code in range(len(Fix))])[gnss.fix]
    return _fix_topic("/fix", gnss.t_ns, llh, np.where(lost, -1, status), gnss.sigma_enu_m)


def datum(t_ns: int, datum: tuple[float, float, float]) -> TopicMessages:
    """The origin of ENU, once, as sensor_msgs/NavSatFix."""
    times, unknown = np.array([t_ns]), np.full((1, 3), np.nan)
    topic = _fix_topic("/datum", times, np.array([datum]), np.zeros(1), unknown)
    return TopicMessages(topic.name, topic.msgtype, times, topic.encode, latched=True)


def _fix_topic(name: str, t_ns: TimesNs, llh: Array, status: NDArray[Any], sigma: Array) -> TopicMessages:
    layout = CdrTemplate().header("gnss_antenna").field("status", "i1").constant("H", 1)
    layout.field("llh", count=3).field("P", count=9).field("kind", "u1")
    with np.errstate(over="ignore"):
        variance = sigma**2
    known = np.asarray(np.isfinite(variance[:, :2]).all(axis=1))
    P = np.zeros((len(t_ns), 9))
    P[:, ::4] = np.where(known[:, None], np.where(np.isfinite(variance), variance, UNKNOWN_VARIANCE), 0.0)
    kind = np.where(known, 2, 0)
    return _topic(name, "sensor_msgs/msg/NavSatFix", layout, t_ns, status=status, llh=llh, P=P, kind=kind)


def gnss_velocity(gnss: Gnss) -> TopicMessages:
    """geometry_msgs/TwistWithCovarianceStamped: east, north, up velocity of the antenna."""
    assert gnss.velocity_enu_mps is not None
    sigma = gnss.sigma_v_mps if gnss.sigma_v_mps is not None else np.zeros(len(gnss))
    with np.errstate(over="ignore"):
        variance = np.where(np.isnan(gnss.velocity_enu_mps), UNKNOWN_VARIANCE, _known(sigma)[:, None] ** 2)
    Q = np.zeros((len(gnss), 36))
    Q[:, 0:21:7], Q[:, 21::7] = variance, UNKNOWN_VARIANCE
    twist = np.hstack([_known(gnss.velocity_enu_mps), np.zeros((len(gnss), 3))])
    layout = CdrTemplate().header("map").field("twist", count=6).field("Q", count=36)
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    return _topic("/fix_velocity", kind, layout, gnss.t_ns, twist=twist, Q=Q)


def command(command: Command) -> TopicMessages:
    """geometry_msgs/TwistStamped in base_link."""
    twist = np.zeros((len(command), 6))
    twist[:, 0], twist[:, 5] = command.v_mps, command.yaw_rate_radps
    layout = CdrTemplate().header("base_link").field("twist", count=6)
    return _topic("/cmd_vel", "geometry_msgs/msg/TwistStamped", layout, command.t_ns, twist=twist)


def terrain(terrain: Terrain) -> TopicMessages:
    """std_msgs/String with the label, at the time of the label."""
    labels = [str(label) for label in terrain.label.tolist()]
    messages = {label: split(CdrTemplate().string(label).rows(1))[0] for label in set(labels)}
    return TopicMessages(
        "/terrain", "std_msgs/msg/String", terrain.t_ns, lambda rows: [messages[x] for x in labels[rows]]
    )


def static_transforms(t_ns: int, positions_m: Mapping[str, Sequence[float]]) -> TopicMessages:
    """tf2_msgs/TFMessage, latched: base_link -> each frame, at its position and not turned."""
    layout = CdrTemplate().constant("I", len(positions_m))
    for frame, position in positions_m.items():
        stamp = divmod(t_ns, 1_000_000_000)
        layout.constant("I", *stamp).string("base_link").string(frame)
        layout.constant("d", *position, *IDENTITY)
    message = split(layout.rows(1))
    return TopicMessages(
        "/tf_static", "tf2_msgs/msg/TFMessage", np.array([t_ns]), lambda r: message[r], latched=True
    )


def transforms(trajectory: Trajectory, frame: str, child: str) -> TopicMessages:
    """tf2_msgs/TFMessage, `frame` -> `child`, one transform a message; orientations must be known."""
    layout = CdrTemplate().constant("I", 1).header(frame).string(child).field("pose", count=7)
    pose = np.hstack([_known(trajectory.position_m), _oriented(trajectory)])
    return _topic("/tf", "tf2_msgs/msg/TFMessage", layout, trajectory.t_ns, pose=pose)


def table(channel: str, t_ns: TimesNs, columns: dict[str, Array]) -> TopicMessages:
    """std_msgs/Float64MultiArray: stamp (s, ns) and one row of the columns, which the label names."""
    stamps = [part.astype(float) for part in np.divmod(t_ns, 1_000_000_000)]
    values = np.stack([*stamps, *columns.values()], axis=1)
    count = values.shape[1]
    layout = CdrTemplate().constant("I", 1).string(",".join([*STAMP, *columns]))
    layout.constant("I", count, count, 0).sequence("data", count)

    def encode(rows: slice) -> list[bytes]:
        block = layout.rows(len(t_ns[rows]))
        block["data"] = values[rows]
        return split(block)

    return TopicMessages(f"{PREFIX}{channel}", ROW, t_ns, encode)


def dead_reckoning(t_ns: TimesNs, v_mps: Array, rate_radps: Array) -> tuple[Array, Array, Array]:
    """x, y (m) and yaw (rad), each (N,), from the origin, by the trapezoid rule."""
    dt = np.diff(t_ns) * 1e-9

    def integral(rate: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)])[: len(t_ns)]

    yaw = integral(rate_radps)
    return integral(v_mps * np.cos(yaw)), integral(v_mps * np.sin(yaw)), yaw
