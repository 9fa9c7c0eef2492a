"""Streams of a bag -> channels of a recording, with a note for everything assumed or left out."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
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
from terrafusion.datasets.core.conventions import BODY_AXES, Conventions, permuted
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import turned_by
from terrafusion.datasets.core.sensors import Rig
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.wrapped_angles import (
    paired_sides,
    speeds_of,
    unwrapped_alone,
    unwrapped_beside_speeds,
)
from terrafusion.datasets.readers.ros import topics
from terrafusion.datasets.readers.ros.joints import (
    holding,
    joint_names,
    joint_values,
    steering_joints,
    wheel_joints,
    wheel_of_joint,
)
from terrafusion.datasets.readers.ros.static_frames import (
    BASE,
    Mounting,
    StaticFrames,
    mounting_note,
    tells_turn,
)
from terrafusion.datasets.readers.ros.streams import (
    ACKERMANN_AT,
    UNKNOWN_VARIANCE,
    UNSET_STATUS,
    Stream,
    fix_sigmas,
    fix_velocities,
    has_fix,
    poses,
    twists,
)
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE, Datum, Fixes, gnss_channel
from terrafusion.datasets.readers.timed_tables import new_times

NOMINAL_TRACK_M = 1.0
NAVSATFIX = ("latitude", "longitude", "altitude")
MOVING_MPS = 0.05
TURNED_RAD = 1.0
"""Wheels that turned so far did not stand."""
LEAST_APART = 3
"""Messages of each wheel between which those of wheels apart are interpolated."""
MOST_WITHOUT_NUMBER = 0.01
"""Share of a topic's messages that glitches of its driver may take; more is a fault of the log."""
SIDEWAYS_SHARE = 0.5
"""Wheels do not move sideways: so much beside the forward speed is a twist in another frame."""


@dataclass
class ChannelBuilder:
    """Turns streams into channels; `notes` collects what was assumed or left out.

    `known` are the conventions of a catalogued bag: its track makes the side speeds where there is
    no rig, and its IMU's axes are left to whoever applies the conventions. A bag of this library is read
    `as_written`, to the bit. `frames` turn sensors whose mounting they tell.
    """

    file: Path
    rig: Rig | None
    known: Conventions
    start_ns: int
    joints: dict[str, str]
    notes: list[str] = field(default_factory=list)
    as_written: bool = False
    frames: StaticFrames = field(default_factory=StaticFrames)
    unturned: dict[str, str] = field(default_factory=dict)
    """Frames of the channels that are left in the axes of their sensor, as no vehicle is given."""

    def command(self, stream: Stream, t_ns: TimesNs) -> Command:
        """Commanded twists."""
        twist, _ = twists(stream)
        held = self._numbered("command", twist[:, [0, 5]], t_ns, stream.topic)
        return Command(t_ns[held], twist[held, 0], twist[held, 5])

    def imu(self, stream: Stream, t_ns: TimesNs) -> Imu:
        """Rates and specific forces in body axes; first messages may lack numbers, and a few later ones."""
        gyro, accel = stream.vectors("angular_velocity"), stream.vectors("linear_acceleration")
        gyro[stream.column("angular_velocity_covariance.0") == -1] = np.nan
        accel[stream.column("linear_acceleration_covariance.0") == -1] = np.nan
        held = np.ones(len(stream), dtype=bool)
        for what, values in (("angular velocity", gyro), ("linear acceleration", accel)):
            known = ~np.isnan(values).all(axis=0)
            if not known.any():
                self.notes.append(f"imu: {stream.topic} has no {what}")
            held &= self._finite(values[:, known], t_ns, stream.topic, what)
        held = self._held("imu", stream.topic, held)
        return Imu(t_ns[held], *(values[held] for values in self._to_body("imu", stream, gyro, accel)))

    def barometer(self, stream: Stream, t_ns: TimesNs) -> Barometer | None:
        """Pressures; messages without a number are left out."""
        pressure = stream.column("fluid_pressure").astype(float)
        held = self._held("barometer", stream.topic, np.asarray(np.isfinite(pressure)))
        return Barometer(t_ns[held], pressure[held]) if held.any() else None

    def magnetometer(self, stream: Stream, t_ns: TimesNs) -> Magnetometer | None:
        """Fields in body axes, as the IMU's; messages without a number are left out."""
        field = stream.vectors("magnetic_field")
        held = self._held("magnetometer", stream.topic, np.asarray(np.isfinite(field).all(axis=1)))
        if not held.any():
            return None
        return Magnetometer(t_ns[held], self._to_body("magnetometer", stream, field)[0][held])

    def mounting(self, frame: str) -> Mounting | None:
        """Where a sensor with a frame of its own is, and how it is turned, by the bag's fixed frames."""
        return None if frame.rpartition("/")[2] in ("", BASE) else self.frames.mounting(BASE, frame)

    def _held(self, name: str, topic: str, held: Mask) -> Mask:
        if not held.all():
            lost = int((~held).sum())
            self.notes.append(f"{name}: {lost} of {len(held)} messages of {topic} hold no number; left out")
        return held

    def _numbered(self, name: str, values: Array, t_ns: TimesNs, topic: str, what: str = "number") -> Mask:
        return self._held(name, topic, self._finite(values, t_ns, topic, what))

    def _to_body(self, name: str, stream: Stream, *vectors: Array) -> tuple[Array, ...]:
        frames = sorted(set(stream.frame_ids.tolist()))
        names = ", ".join(f"'{frame}'" for frame in frames)
        mounting = self.mounting(frames[0]) if len(frames) == 1 else None
        if mounting is not None and tells_turn(mounting, frames[0], self.rig):
            self.notes.append(mounting_note(name, frames[0], mounting))
            R = mounting[1]
            if self.rig is None and np.array_equal(R, np.eye(3)):
                self.unturned[name] = frames[0]
            return vectors if np.array_equal(R, np.eye(3)) else tuple(turned_by(R, v) for v in vectors)
        if self.rig is None:
            if self.known.imu_axes == BODY_AXES:
                if len(frames) == 1:
                    self.unturned[name] = frames[0]
                self.notes.append(
                    f"{name}: no vehicle given: {stream.topic} (frame {names}) taken as x forward, "
                    "y left, z up"
                )
            return vectors
        spec = self.rig.sensors.imu
        wanted = spec.frame_id.lstrip("/")
        turn = np.asarray(stream.frame_ids == wanted, dtype=bool)
        if not turn.any():
            self.notes.append(
                f"{name}: {stream.topic} is in frame {names}, not '{wanted}' of the vehicle: not rotated"
            )
            return vectors
        R = spec.base_from_sensor()
        if not np.array_equal(R, np.eye(3)):
            share = "" if turn.all() else f" ({int(turn.sum())} of {len(turn)} messages)"
            self.notes.append(
                f"{name}: rotated from {wanted} to the body: axes {', '.join(spec.axes)}{share}"
            )
        out = []
        for values in vectors:
            turned = values.copy()
            turned[turn] = permuted(R, values[turn])
            out.append(turned)
        return tuple(out)

    def wheels(self, stream: Stream, t_ns: TimesNs, imu: Imu | None) -> tuple[Wheels | None, float | None]:
        """Wheel speeds, and the nominal track (m) where one had to be assumed."""
        if stream.msgtype == topics.JOINTS:
            return self._wheels_of_joints(stream, t_ns), None
        if stream.msgtype in ACKERMANN_AT:
            self._note_command("wheels", stream)
            speed = stream.column(f"{ACKERMANN_AT[stream.msgtype]}speed").astype(float)[:, None]
            held = self._numbered("wheels", speed, t_ns, stream.topic, "speed")
            return Wheels(t_ns[held], speed[held], ("speed",), "mps"), None
        twist, variance = twists(stream)
        held = self._numbered("wheels", twist[:, :1], t_ns, stream.topic, "speed")
        stream, t_ns, twist, variance = stream.select(held), t_ns[held], twist[held], variance[held]
        v, rate = twist[:, 0], twist[:, 5]
        if stream.msgtype == topics.TWIST:
            self.notes.append(f"wheels: {stream.topic} has no stamps; its times are those of arrival")
        sideways = float(np.nanstd(twist[:, 1])) if len(twist) > 1 else 0.0
        if sideways > SIDEWAYS_SHARE * np.nanstd(v) and sideways > MOVING_MPS:
            self.notes.append(
                f"wheels: {stream.topic} moves sideways as much as forward: its twist seems to be in the "
                "frame of its pose, not in the robot's; its speeds are then wrong"
            )
        if stream.msgtype == topics.ODOMETRY and not twist.any():
            position, _, _ = poses(stream)
            if np.nanmax(np.ptp(position[:, :2], axis=0), initial=0.0) > 1.0:
                self.notes.append(
                    f"wheels: {stream.topic} moves but its twist is zero throughout; left out: record its "
                    "speeds, or name another topic with --topic wheels=TOPIC"
                )
                return None, None
        if self._says_no_yaw(stream, rate, variance[:, 5], v, imu):
            return Wheels(t_ns, v[:, None], ("speed",), "mps"), None
        held = self._numbered("wheels", rate[:, None], t_ns, stream.topic, "yaw rate")
        t_ns, v, rate = t_ns[held], v[held], rate[held]
        track = self.rig.track_m if self.rig else self.known.track_m or NOMINAL_TRACK_M
        assumed = None if self.rig or self.known.track_m else NOMINAL_TRACK_M
        if assumed:
            self.notes.append(
                f"wheels: no vehicle given: side speeds of {stream.topic} are for a nominal track of "
                f"{NOMINAL_TRACK_M:g} m, which keeps its yaw rate"
            )
        half = rate * (track / 2.0)
        return Wheels(t_ns, np.stack([v - half, v + half], axis=1), ("left", "right"), "mps"), assumed

    def _note_command(self, name: str, stream: Stream) -> None:
        kind = stream.msgtype.rpartition("/")[2]
        self.notes.append(f"{name}: {stream.topic} is an {kind}, to ROS a command; it is taken as measured")

    def _says_no_yaw(self, stream: Stream, rate: Array, variance: Array, v: Array, imu: Imu | None) -> bool:
        why = ""
        if np.isnan(rate).all() or (variance >= UNKNOWN_VARIANCE).all() or (variance < 0).all():
            why = "its yaw rate is marked unknown"
        elif not rate.any() and np.abs(v).max(initial=0.0) > MOVING_MPS and imu is not None:
            turning = imu.gyro_radps[:, 2]
            if np.isfinite(turning).any() and np.nanstd(turning) > 0.05:
                why = "its yaw rate is zero throughout while the gyro turns"
        if why:
            self.notes.append(f"wheels: {stream.topic}: {why}; only the speed is used")
        return bool(why)

    def _wheels_of_joints(self, stream: Stream, t_ns: TimesNs) -> Wheels | None:
        names = joint_names(stream)
        joints = wheel_joints(names, self.joints)
        if not joints:
            raise DataError(
                f"joints {', '.join(names) or '(none)'} name no wheels",
                channel=stream.topic,
                remedy="name them with --topic joint.left=NAME --topic joint.right=NAME",
            )
        held = holding(stream, [*joints.values()])
        if not held.any():
            return self._wheels_apart(stream, t_ns, joints)
        stream, t_ns = stream.select(held), t_ns[held]
        speed = joint_values(stream, [*joints.values()], "velocity")
        angle = joint_values(stream, [*joints.values()], "position")
        known = angle if speed is None else speed
        # Drivers publish NaN until the hardware answers.
        begin = 0 if known is None else int(np.argmax(np.isfinite(known).any(axis=1)))
        if begin:
            self.notes.append(f"wheels: {stream.topic}: the first {begin} messages hold no number; left out")
            speed, angle = (None if v is None else v[begin:] for v in (speed, angle))
            t_ns = t_ns[begin:]
        chosen = ", ".join(f"{wheel} = {joint}" for wheel, joint in joints.items())
        others = [name for name in names if wheel_of_joint(name) and name not in joints.values()]
        left = f"; not used: {', '.join(others[: topics.MOST_SHOWN])}" if others else ""
        self.notes.append(f"wheels: joints of {stream.topic}: {chosen}{left}")
        turned = angle is not None and bool((np.ptp(angle, axis=0) > TURNED_RAD).any())
        if speed is not None and turned and not speed.any() and not self.as_written:
            self.notes.append(f"wheels: all velocities of {stream.topic} are zero, though its angles turn")
            speed = None
        angle = self._unwrapped(angle, speed, tuple(joints), stream.topic)
        if speed is None and angle is not None and len(t_ns) > 1:
            keep, speed = speeds_of(t_ns, angle)
            angle, t_ns = angle[keep], t_ns[keep]
            self.notes.append(
                f"wheels: {stream.topic} has no usable velocities; taken from differences of the angles"
            )
        if speed is None:
            raise DataError("joints have neither velocity nor position", channel=stream.topic)
        held = self._numbered("wheels", speed, t_ns, stream.topic, "wheel speed")
        angle = None if angle is None else angle[held]
        return Wheels(t_ns[held], speed[held], tuple(joints), "radps", angle)

    def _unwrapped(
        self, angle: Array | None, speed: Array | None, names: tuple[str, ...], topic: str
    ) -> Array | None:
        """The angles (N, wheels) with whole turns; None where speeds take their place."""
        if angle is None or self.as_written:
            return angle
        if speed is None:
            angle, note = unwrapped_alone(angle, names, topic)
        else:
            angle, note = unwrapped_beside_speeds(angle, names)
        self.notes += [f"wheels: {topic}: {note}"] if note else []
        return angle

    def _wheels_apart(self, stream: Stream, t_ns: TimesNs, joints: dict[str, str]) -> Wheels:
        """Wheels of which each message holds some, at the times of the one that comes most."""
        names, of = tuple(joints), [*joints.values()]
        speed, angle = joint_values(stream, of, "velocity"), joint_values(stream, of, "position")
        known = angle if speed is None else speed
        if known is None or np.isfinite(known).sum(axis=0).min() < LEAST_APART:
            raise DataError(
                f"the messages do not hold speeds or angles of each of the joints {', '.join(of)}",
                channel=stream.topic,
                remedy="name the wheel joints with --topic joint.left=NAME --topic joint.right=NAME",
            )
        chosen = ", ".join(f"{wheel} = {joint}" for wheel, joint in joints.items())
        self.notes.append(
            f"wheels: joints of {stream.topic}, each in messages of its own: {chosen}; interpolated at the "
            "times of the one with the most"
        )
        angle = self._unwrapped(angle, speed, names, stream.topic)
        if speed is not None or angle is None:
            return paired_sides(Wheels(t_ns, known, names, "radps", angle))
        paired = paired_sides(Wheels(t_ns, angle, names, "radps"))  # angles in the place of speeds
        keep, speed = speeds_of(paired.t_ns, paired.speed)
        return Wheels(paired.t_ns[keep], speed, names, "radps", paired.speed[keep])

    def steering(self, stream: Stream, t_ns: TimesNs) -> Steering | None:
        """Steering angles, of joints or of an AckermannDrive."""
        if stream.msgtype in ACKERMANN_AT:
            self._note_command("steering", stream)
            angle = stream.column(f"{ACKERMANN_AT[stream.msgtype]}steering_angle").astype(float)[:, None]
            held = self._numbered("steering", angle, t_ns, stream.topic, "steering angle")
            return Steering(t_ns[held], angle[held], ("angle",))
        for names, joints in steering_joints(joint_names(stream)).items():
            held = holding(stream, joints)
            angles = joint_values(stream.select(held), joints, "position") if held.any() else None
            if angles is None:
                self.notes.append(
                    f"steering: {', '.join(joints)} of {stream.topic} have no position; left out"
                )
                return None
            t_ns = t_ns[held]
            held = self._numbered("steering", angles, t_ns, stream.topic, "steering angle")
            angles = angles[held]
            self.notes.append(f"steering: joints of {stream.topic}: {', '.join(names)} = {', '.join(joints)}")
            if len(joints) > len(names):
                angles = angles.mean(axis=1, keepdims=True)
            return Steering(t_ns[held], angles, names)
        raise DataError(
            f"joints {', '.join(joint_names(stream)) or '(none)'} name no steering axis",
            channel=stream.topic,
            remedy="name another topic with --topic steering=TOPIC",
        )

    def gnss(self, stream: Stream, t_ns: TimesNs, datum: Datum | None) -> tuple[Gnss | None, Datum | None]:
        """Fixes as ENU about `datum`, or about the first valid fix."""
        status = stream.column("status.status")
        llh, unset = self._llh(stream), status == UNSET_STATUS
        fix = np.where(has_fix(status), Fix.SINGLE, Fix.NONE).astype(np.uint8)
        if unset.any():
            fix[unset & (llh[:, :2] == 0.0).all(axis=1)] = Fix.NONE
            count = f"{int(unset.sum())} of {len(unset)} fixes"
            self.notes.append(f"gnss: {stream.topic} leaves the status of {count} unset; taken as single")
        for number, fix_class in FIX_OF_CODE["navsatfix"].items():
            fix[status == number] = fix_class
        velocity, sigma_v = fix_velocities(stream)
        if velocity is not None:
            self.notes.append(f"gnss: velocity of speed and track of {stream.topic}")
        fixes = Fixes(t_ns, llh, fix, fix_sigmas(stream), velocity, sigma_v)
        rows = f"messages of {stream.topic}"
        gnss, datum, notes = gnss_channel(self.rig, fixes, datum, rows=rows, channel=stream.topic)
        self.notes += notes
        return gnss, datum

    def _llh(self, stream: Stream) -> Array:
        """Latitude, longitude (deg) and height (m), (N, 3)."""
        return np.stack([stream.column(name).astype(float) for name in NAVSATFIX], axis=1)

    def gnss_velocity(self, gnss: Gnss, stream: Stream, t_ns: TimesNs) -> Gnss:
        """The fixes with the ENU velocity of another topic, matched within half a fix interval."""
        measured, deviation = fix_velocities(stream)
        if measured is None or not len(t_ns):
            return gnss
        after = np.clip(np.searchsorted(t_ns, gnss.t_ns), 0, len(t_ns) - 1)
        before = np.clip(after - 1, 0, None)
        nearer = np.abs(t_ns[before] - gnss.t_ns) <= np.abs(t_ns[after] - gnss.t_ns)
        nearest = np.where(nearer, before, after)
        interval = np.median(np.diff(gnss.t_ns)) if len(gnss) > 1 else 1e9
        close = np.abs(t_ns[nearest] - gnss.t_ns) <= min(interval / 2, 5e7)
        velocity = np.where(close[:, None], measured[nearest], np.nan)
        without = int(np.isnan(velocity[:, :2]).any(axis=1).sum())
        meant = "of speed and track" if stream.msgtype in topics.TYPES["gnss"] else "taken as east, north, up"
        self.notes.append(f"gnss: velocity of {stream.topic} {meant}; {without} fixes without")
        if np.isnan(velocity).all():
            return gnss
        sigma = None if deviation is None else np.where(close, deviation[nearest], np.nan)
        sigma = None if sigma is None or np.isnan(sigma).all() else sigma
        return dataclasses.replace(gnss, velocity_enu_mps=velocity, sigma_v_mps=sigma)

    def datum(self, stream: Stream) -> Datum:
        """The ENU origin that a bag written by this library carries."""
        self.notes.append(f"gnss: datum from {stream.topic}")
        latitude, longitude, height = self._llh(stream)[0].tolist()
        return latitude, longitude, height

    def terrain(self, stream: Stream, t_ns: TimesNs) -> Terrain:
        """Labels as they were published."""
        return Terrain(t_ns, stream.column("data"), stream.topic)

    def truth(self, stream: Stream, t_ns: TimesNs) -> tuple[Trajectory, str]:
        """Ground truth, and which point it is of: "base" or "antenna"."""
        held = self._numbered("truth", poses(stream)[0][:, :2], t_ns, stream.topic, "position")
        stream, t_ns = stream.select(held), t_ns[held]
        position, quaternion, covariance = poses(stream)
        orientation: Array | None = quaternion
        if not np.abs(np.linalg.norm(quaternion, axis=1) - 1.0).max(initial=0.0) <= 0.01:
            self.notes.append(f"truth: {stream.topic} has no valid quaternions; only the position is used")
            orientation = None
        if covariance is not None:
            position[:, 2][covariance[:, 2, 2] >= UNKNOWN_VARIANCE] = np.nan
            if (covariance[:, 5, 5] >= UNKNOWN_VARIANCE).all():
                orientation = None
            if not covariance.any():
                covariance = None
            elif covariance.diagonal(axis1=1, axis2=2).max() >= UNKNOWN_VARIANCE:
                self.notes.append(f"truth: {stream.topic}: covariance left out, a part of it is unknown")
                covariance = None
        twist = self._truth_twist(stream)
        child = str(stream.column("child_frame_id")[0]) if stream.has("child_frame_id") else ""
        frame = "antenna" if any(word in child.lower() for word in ("antenna", "gps", "gnss")) else "base"
        once = new_times(t_ns)
        if not once.all():
            self.notes.append(f"truth: {int((~once).sum())} poses with a repeated time left out")
        others = (None if column is None else column[once] for column in (orientation, twist, covariance))
        return Trajectory(t_ns[once], position[once], *others), frame

    def _truth_twist(self, stream: Stream) -> Array | None:
        if stream.msgtype != topics.ODOMETRY:
            return None
        twist, variance = twists(stream)
        twist[variance >= UNKNOWN_VARIANCE] = np.nan
        return twist if np.nan_to_num(twist).any() else None

    def _finite(self, values: Array, t_ns: TimesNs, topic: str, what: str = "number") -> Mask:
        """Mask (N,) of the messages with numbers; a DataError if more than the first and a few have none."""
        finite = np.asarray(np.isfinite(values).all(axis=1))
        begin = int(np.argmax(finite)) if len(finite) else 0
        bad = ~finite[begin:]
        if bad.sum() > MOST_WITHOUT_NUMBER * len(bad):
            i = begin + int(np.argmax(bad))
            raise DataError(
                f"{int(bad.sum())} of {len(bad)} messages have no finite {what}",
                channel=topic,
                time_s=float(t_ns[i] - self.start_ns) * 1e-9,
                remedy="correct the driver, or filter these messages out of the bag",
            )
        return finite
