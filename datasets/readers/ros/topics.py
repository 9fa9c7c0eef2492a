"""Which topic of a bag becomes which channel: by type, by name, or on request."""

import difflib
import functools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers.text.proposed_map import wheels_of

IMU = "sensor_msgs/msg/Imu"
JOINTS = "sensor_msgs/msg/JointState"
FIX = "sensor_msgs/msg/NavSatFix"
GPS_FIX, GPS_FIX_1 = "gps_msgs/msg/GPSFix", "gps_common/msg/GPSFix"
"""A fix with its velocity; the second is that of ROS 1."""
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
TWIST_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PRESSURE = "sensor_msgs/msg/FluidPressure"
FIELD = "sensor_msgs/msg/MagneticField"
ACKERMANN = "ackermann_msgs/msg/AckermannDrive"
ACKERMANN_STAMPED = "ackermann_msgs/msg/AckermannDriveStamped"
STRING = "std_msgs/msg/String"

TYPES: dict[str, tuple[str, ...]] = {
    "imu": (IMU,),
    "wheels": (JOINTS, ODOMETRY, TWIST_COVARIANCE, TWIST_STAMPED, ACKERMANN_STAMPED, ACKERMANN, TWIST),
    "gnss": (FIX, GPS_FIX, GPS_FIX_1),
    "gnss_velocity": (TWIST_COVARIANCE, TWIST_STAMPED, GPS_FIX, GPS_FIX_1),
    "command": (TWIST_STAMPED, TWIST),
    "truth": (ODOMETRY, POSE_COVARIANCE, POSE),
    "terrain": (STRING,),
    "barometer": (PRESSURE,),
    "magnetometer": (FIELD,),
    "steering": (JOINTS, ACKERMANN_STAMPED, ACKERMANN),
    "datum": (FIX,),
}
"""Message types of each channel, preferred ones first."""

ALIASES = {
    "odom": "wheels",
    "odometry": "wheels",
    "joint_states": "wheels",
    "fix": "gnss",
    "gps": "gnss",
    "navsat": "gnss",
    "cmd_vel": "command",
    "ground_truth": "truth",
    "mag": "magnetometer",
    "ackermann": "steering",
    "pressure": "barometer",
}
SENSORS = ("imu", "wheels", "gnss")
"""Channels of which a robot may have two sensors, which only the user can tell apart."""
JOINT_PREFIX = "joint."
"""`joint.front_left` names the joint of that wheel inside a JointState."""

_TRUTH = re.compile(r"(^|[/_])(ground_?truth|truth|gt)([/_]|$)", re.IGNORECASE)
_FUSED = re.compile(
    r"filter|fused|combined|slam|visual|camera|lidar|laser|estimat|locali[sz]|mapp(ing|ed)|rtabmap|vins|loam"
    r"|odometry/(local|global)|(local|global)_position|kinematic_state"
    r"|(^|[/_])(ekf|ukf|amcl|map|vio|icp|lio|dlio|zed|t265|cartographer|gps|gnss|imu)([/_]|$)",
    re.IGNORECASE,
)
_COMMAND = re.compile(r"cmd|command", re.IGNORECASE)
_DRIVE = re.compile(r"(^|[/_])(drive|teleop)$", re.IGNORECASE)
"""Usual names of a commanded AckermannDrive."""
_RECEIVER = re.compile(r"gps|gnss|navsat|nav_?pvt|ublox|novatel|septentrio", re.IGNORECASE)
_WHEEL = re.compile(r"wheel|encoder|velocity_controller|diff_?drive|odom|joint_states", re.IGNORECASE)
_GNSS_VELOCITY = re.compile(r"(fix|gps|gnss|navsat).*vel|vel.*(fix|gps|gnss|navsat)", re.IGNORECASE)
_TERRAIN = re.compile(r"terrain|ground_class|surface", re.IGNORECASE)
_DATUM = re.compile(r"(^|/)datum$", re.IGNORECASE)
_NAMED = {"truth": _TRUTH, "datum": _DATUM, "terrain": _TERRAIN, "command": _COMMAND,
          "gnss_velocity": _GNSS_VELOCITY}  # fmt: skip
"""Channels whose topics are known by their names alone."""
_RAW = re.compile(r"raw", re.IGNORECASE)
_ROBOT = re.compile(r"([_-]?\d+|[_-][a-z])/$", re.IGNORECASE)
"""What tells names of robots such as husky_1 and husky_2 apart."""
_PART = re.compile(
    r"imu|ins|ahrs|gyro|acc|gps|gnss|rtk|nav|fix|mag|baro|wheel|odom|enc|joint|motor|drive|steer|track|base|body|chassis"
    r"|platform|vehicle|robot|sens|control|driver|device|hardware|hw|board|mcu|micro|arduino|esp|stm|teensy|can|ros"
    r"|camera|realsense|zed|oak|kinect|lidar|ouster|velodyne|livox|hesai|sick|vectornav|vn\d|xsens|mti|microstrain|adis"
    r"|bno|mpu|phidget|razor|novatel|oem|septentrio|mosaic|ublox|zed_f9p|trimble|piksi|swift|emlid|reach|sbg|ellipse"
    r"|kvh|oxts|applanix|fixposition|anello|spatial|witmotion|roboteq|vesc|odrive|sabertooth|local|global|raw|data",
    re.IGNORECASE,
)
"""In names of sensors, boards and drivers, which are no robot's."""
_PREFERRED_WHEEL = re.compile(r"wheel|encoder|velocity_controller|diff_?drive|joint_states", re.IGNORECASE)

MOST_SHOWN, MOST_FIELDS = 8, 20
_NEVER = re.compile(
    r"^(tf2|rcl_interfaces|rosgraph|diagnostic|visualization|rosbag2)_?\w*/|Image|PointCloud|Log$"
)
_LIKELY = re.compile(r"wheel|vel|speed|motor|enc|tick|rpm|odo|drive", re.IGNORECASE)


@dataclass(frozen=True)
class BagTopic:
    """A topic of the bag: name, normalised type, number of messages; `beside`: topics of the other wheels."""

    name: str
    msgtype: str
    count: int
    beside: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Its name and those beside it."""
        return self.name, *self.beside


def choose_topics(
    bag: list[BagTopic],
    *,
    user: Mapping[str, str] | None = None,
    usual: Mapping[str, str] | None = None,
    is_wheel_joints: Callable[[str], bool] = lambda topic: True,
    is_steering_joints: Callable[[str], bool] = lambda topic: False,
    one_of: Callable[[str, list[BagTopic]], BagTopic] = lambda kind, candidates: candidates[0],
) -> tuple[dict[str, BagTopic], list[str]]:
    """The topic of each channel, and notes on what was taken and left.

    The user's choice goes first and must be there; then the vehicle's usual topics where the bag has
    them; then by type, the preferred one first. Of several sensors of a type `one_of` decides; of other
    topics the name, then the most messages, then the alphabet. A topic that looks like a fused estimate is
    never taken for a sensor by itself. Other robots than that of the wheels are left out.

    Args:
        bag: topics with at least one message.
        user: channel -> topic that the user asks for.
        usual: channel -> topic that the vehicle file names.
        is_wheel_joints, is_steering_joints: whether a JointState topic holds wheels, or steering axes.
        one_of: the topic of a sensor, such as "imu", among several of one type; raises where that is open.

    Raises:
        DataError: an unknown channel, a topic that is not in the bag or has an unfit type.
    """
    chosen: dict[str, BagTopic] = {}
    notes: list[str] = []
    for kind, name in _wanted(user or {}).items():
        chosen[kind] = _asked_for(bag, kind, name)
    for kind, name in _wanted(usual or {}).items():
        fits = [t for t in bag if t.name == name and t.msgtype in TYPES[kind]]
        if kind not in chosen and fits:
            chosen[kind] = fits[0]
    known = len(chosen) > len(_wanted(user or {}))
    bag = _of_one_robot(bag, chosen, is_wheel_joints, one_of, notes, known=known)
    for kind in TYPES:
        taken = {t.name for k, t in chosen.items() if k != kind and {k, kind} != {"wheels", "steering"}}
        found = [t for t in bag if t.msgtype in TYPES[kind] and t.name not in taken]
        if kind == "gnss_velocity" and not ("gnss" in chosen and chosen["gnss"].msgtype == FIX):
            found = [t for t in found if t.msgtype not in TYPES["gnss"]]  # fixes have that of their own
        fits = [
            t for t in found if _fits(kind, t, is_steering_joints if kind == "steering" else is_wheel_joints)
        ]
        fits.sort(key=functools.partial(_rank, kind))
        if kind not in chosen and fits:
            candidates = [t for t in fits if t.msgtype == fits[0].msgtype]
            chosen[kind] = one_of(kind, candidates) if kind in SENSORS and len(candidates) > 1 else fits[0]
        notes += _choice_notes(kind, chosen.get(kind), fits, found)
    return chosen, notes


def _of_one_robot(
    bag: list[BagTopic],
    chosen: dict[str, BagTopic],
    has_joints: Callable[[str], bool],
    one_of: Callable[[str, list[BagTopic]], BagTopic],
    notes: list[str],
    *,
    known: bool,
) -> list[BagTopic]:
    """The bag without topics of other robots than that of the wheels; chooses the wheels where they are open.

    A namespace with wheels and another sensor is a robot's, and so are those named alike but for a number or
    a letter (husky_1, husky_2) that hold both together, or named neither as sensors nor as boards (husky,
    jackal), unless it is `known` which topics are of the robot. Whether these are parts of one robot is asked
    where none has what another has.
    """
    sensors = [(t, kind) for t in bag for kind in SENSORS if t.msgtype in TYPES[kind]]
    paths = [t.name.split("/") for t, _ in sensors]
    depth = next((i for i, parts in enumerate(zip(*paths, strict=False)) if len(set(parts)) > 1), 0)
    spaces: dict[str, dict[str, list[BagTopic]]] = {}
    for (topic, kind), path in zip(sensors, paths, strict=True):
        if len(path) > depth + 1 and _fits(kind, topic, has_joints):
            space = "/".join(path[: depth + 1]) + "/"
            spaces.setdefault(space, {}).setdefault(kind, []).append(topic)
    robots = [space for space, kinds in spaces.items() if _makes_a_robot(kinds)]
    names = [space for space in spaces if not (known or _PART.search(space))]
    for space in (*spaces, ""):
        alike = [other for other in spaces if _ROBOT.sub("", other) == _ROBOT.sub("", space)] or names
        if len(robots) < 2 <= len(alike) and _makes_a_robot(kind for one in alike for kind in spaces[one]):
            robots = alike
            held = [(kind, topics[0].name) for one in alike for kind, topics in spaces[one].items()]
            if not chosen and len(dict(held)) == len(held):
                raise _robots_or_boards(alike, dict(held))
    if len(robots) < 2:
        return bag
    if "wheels" not in chosen:
        rank = functools.partial(_rank, "wheels")
        of_each = [min(spaces[one]["wheels"], key=rank) for one in robots if "wheels" in spaces[one]]
        chosen["wheels"] = one_of("wheels", of_each) if len(of_each) > 1 else of_each[0]
    others = tuple(one for one in robots if not chosen["wheels"].name.startswith(one))
    if len(others) == len(robots):
        return bag
    notes.append(f"not used: {', '.join(others)}, as of other robots; name what is of this one with --topic")
    return [topic for topic in bag if not topic.name.startswith(others)]


def _robots_or_boards(spaces: Sequence[str], held: Mapping[str, str]) -> DataError:
    """The question whether namespaces, whose sensors are `held` by kind, are of one robot."""
    every = " ".join(f"--topic {kind}={name}" for kind, name in held.items())
    return DataError(
        f"{', '.join(spaces)} may be boards of one robot, or robots",
        remedy=f"of one robot: {every}; of several: --topic wheels={held['wheels']} leaves the others out",
    )


def _makes_a_robot(kinds: Iterable[str]) -> bool:
    """Whether these are wheels and another sensor."""
    return len(held := set(kinds)) > 1 and "wheels" in held


def _choice_notes(
    kind: str, taken: BagTopic | None, fits: list[BagTopic], found: list[BagTopic]
) -> Iterator[str]:
    """What was left beside the topic taken; without one, the fused estimates that were not."""
    left = [f"{t.name} ({t.count})" for t in fits if taken is not None and t.name != taken.name]
    if taken is not None and left:
        yield f"{kind}: took {taken.name} ({taken.count} messages), left {', '.join(left)}"
    elif taken is None and kind in ("wheels", "gnss"):
        possible = (t for t in found if kind != "wheels" or not _GNSS_VELOCITY.search(t.name))
        fused = [t.name for t in possible if looks_fused(kind, t)]
        if fused:
            yield (
                f"{kind}: {', '.join(fused)} looks like a fused estimate and was not taken; "
                f"ask for it with topic {kind}={fused[0]}"
            )


def joints_given(user: Mapping[str, str] | None) -> dict[str, str]:
    """Wheel -> joint name from the entries `joint.<wheel>`."""
    entries = (user or {}).items()
    return {key.removeprefix(JOINT_PREFIX): name for key, name in entries if key.startswith(JOINT_PREFIX)}


def _wanted(topics: Mapping[str, str]) -> dict[str, str]:
    wanted = {}
    for key, name in topics.items():
        if key.startswith(JOINT_PREFIX):
            continue
        kind = ALIASES.get(key, key)
        if kind not in TYPES:
            close = difflib.get_close_matches(key, [*TYPES, *ALIASES], n=1)
            meant = f"did you mean '{close[0]}'? " if close else ""
            raise DataError(
                f"'{key}' is not a channel that a topic can be given for",
                remedy=f"{meant}known: {', '.join(TYPES)}",
            )
        wanted[kind] = name
    return wanted


def _asked_for(bag: list[BagTopic], kind: str, name: str) -> BagTopic:
    named = [t for t in bag if t.name == name]
    fits = [t for t in named if t.msgtype in TYPES[kind]]
    if fits:
        return fits[0]
    if named:
        what = f"topic {name} is of type {named[0].msgtype}, which cannot be {kind}"
        remedy = f"types of {kind}: {', '.join(TYPES[kind])}"
    else:
        what = f"no topic {name} with messages in this bag"
        remedy = f"topics here: {', '.join(f'{t.name} ({t.msgtype})' for t in bag) or 'none'}"
    raise DataError(what, channel=kind, remedy=remedy)


def looks_commanded(name: str) -> bool:
    """Whether a topic's name says that its messages are commands."""
    return bool(_COMMAND.search(name))


def looks_fused(kind: str, topic: BagTopic) -> bool:
    """Whether a topic looks like an estimate, which is no sensor."""
    if kind == "gnss":
        return bool(re.search(r"filter|fused|ekf", topic.name, re.IGNORECASE))
    return topic.msgtype != JOINTS and bool(_FUSED.search(topic.name)) and not _TRUTH.search(topic.name)


def _fits(kind: str, topic: BagTopic, has_joints: Callable[[str], bool]) -> bool:
    name = topic.name
    if kind == "gnss_velocity" and topic.msgtype in TYPES["gnss"]:
        return not looks_fused("gnss", topic)
    if kind in _NAMED:
        return bool(_NAMED[kind].search(name))
    if kind in ("imu", "barometer", "magnetometer"):
        return True
    if _TRUTH.search(name) or looks_fused(kind, topic):
        return False
    if kind == "gnss":
        return not _DATUM.search(name)
    if topic.msgtype == JOINTS:
        return not _COMMAND.search(name) and has_joints(name)
    if topic.msgtype in (ACKERMANN, ACKERMANN_STAMPED):  # mostly a command, which is no measurement
        return not _COMMAND.search(name) and not (kind == "wheels" and _DRIVE.search(name))
    if topic.msgtype == TWIST:  # mostly a command, and without a time: only on request
        return False
    if topic.msgtype in (TWIST_STAMPED, TWIST_COVARIANCE):
        return bool(_WHEEL.search(name)) and not _COMMAND.search(name)
    return True


def _rank(kind: str, topic: BagTopic) -> tuple[int, bool, bool, int, str]:
    order = TYPES[kind].index(topic.msgtype)
    unpreferred = kind == "wheels" and not _PREFERRED_WHEEL.search(topic.name)
    return order, unpreferred, bool(_RAW.search(topic.name)), -topic.count, topic.name


def unread_receivers(bag: Sequence[BagTopic]) -> list[str]:
    """A note for a bag without fixes, on its topics that may hold some in a type that is not read."""
    strange = (t for t in bag if not any(t.msgtype in types for types in TYPES.values()))
    others = [
        t for t in strange if _RECEIVER.search(f"{t.name} {t.msgtype}") and not _NEVER.search(t.msgtype)
    ]
    shown = ", ".join(f"{t.name} ({t.msgtype})" for t in others[:MOST_SHOWN])
    what = f"gnss: not used are {shown}, of types that are not read; record the fixes as {FIX}"
    return [f"{what}, or name their fields by --columns FILE"] if others else []


def wheel_advice(
    bag: Sequence[BagTopic],
    taken: Sequence[str],
    joints_of: Callable[[str], Sequence[str]],
    numbers_of: Callable[[BagTopic], Sequence[str]],
) -> str:
    """A note for a bag without wheels; other sensors have taken the topics `taken`."""
    others = [topic for topic in bag if topic.name not in taken and not _NEVER.search(topic.msgtype)]
    steered = ACKERMANN, ACKERMANN_STAMPED  # which report what they do by the message of their command
    fit = [topic for topic in others if topic.msgtype in TYPES["wheels"]]
    usable = [topic for topic in fit if topic.msgtype in steered or not looks_commanded(topic.name)]
    parts = [*_named(usable, joints_of)]
    strange = [topic for topic in others if not any(topic.msgtype in types for types in TYPES.values())]
    strange.sort(key=lambda topic: not _LIKELY.search(f"{topic.name} {topic.msgtype}"))
    if strange:
        shown = [f"{topic.name} ({topic.msgtype})" for topic in strange[:MOST_SHOWN]]
        more = [f"{len(strange) - MOST_SHOWN} more"] if len(strange) > MOST_SHOWN else []
        parts.append(f"not used are {', '.join([*shown, *more])}, of types that are not read")
    if not parts or not usable:
        columns = [column for topic in strange[:MOST_SHOWN] for column in numbers_of(topic)]
        section = wheels_of(columns) or "left_radps: /TOPIC.FIELD, right_radps: /TOPIC.FIELD"
        how = f"name fields, with the right units, by --columns FILE: {{channels: {{wheels: {{{section}}}}}}}"
        listed = f" (there are {', '.join(columns[:MOST_FIELDS])})" if columns else ""
        other = f"{how}{listed}" if columns else "give them as a table"
        parts.append(f"record the speeds as {JOINTS} or {ODOMETRY}, or {other}")
    return f"wheels: no topic was chosen for them, and replay needs them: {'; '.join(parts)}"


def _named(usable: Sequence[BagTopic], joints_of: Callable[[str], Sequence[str]]) -> Iterator[str]:
    """How each topic of a fit type is asked for."""
    for topic in usable:
        if topic.msgtype == JOINTS and not _COMMAND.search(topic.name):
            joints = joints_of(topic.name)
            names = ", ".join(joints[:MOST_SHOWN]) or "none"
            yield (
                f"the joints of {topic.name} ({names}) name no side: give two with --topic joint.left=NAME "
                "--topic joint.right=NAME, or four with joint.front_left, ..."
            )
        elif not looks_fused("wheels", topic):  # which has a note of its own
            steers = topic.msgtype in (ACKERMANN, ACKERMANN_STAMPED)
            kinds = ("wheels", "steering") if steers else ("wheels",)
            options = " ".join(f"--topic {kind}={topic.name}" for kind in kinds)
            yield f"{options} uses this {topic.msgtype} if it is measured, not commanded"
