"""What the name of a table's column tells: its unit, its sensor, and the field it may stand for."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from terrafusion.datasets.readers.text.column_map import FIELDS, TEXT_FIELDS, YAW_RATE, units_of

_WORDS = {
    "deg/s": "deg/s|°/s|dps|degps|degs|deg_s|deg_per_s|deg/sec",
    "mdeg/s": "mdeg/s|mdps",
    "rad/s": "rad/s|radps|rads|rad_s|rad/sec|rads^-1",
    "rpm": "rpm|1/min|u/min",
    "rev/s": "rev/s|rps|revps",
    "m/s": "m/s|mps|m_s|m/sec",
    "km/h": "km/h|kmh|kph|kmph|km_h",
    "cm/s": "cm/s|cmps|cm_s",
    "mm/s": "mm/s|mmps|mm_s",
    "kn": "kn|kt|kts|knots",
    "m/s2": "m/s2|m/s^2|m/s²|m/s/s|mps2|m_s2|ms2|ms-2|ms^-2",
    "m": "m|meter|metre|meters|metres",
    "ft": "ft|feet",
    "rad": "rad",
    "deg": "deg|°|degree|degrees",
    "1e-7 deg": "1e-7 deg|1e-7deg|deg*1e7|dege7|e7",
    "rev": "rev|turns",
    "A": "a|amp|amps",
    "ticks": "tick|ticks|count|counts|pulse|pulses",
    "s": "s|sec|secs|seconds",
    "ms": "ms|msec|millis",
    "us": "us|µs|usec|micros",
    "ns": "ns|nsec|nsecs|nanos|nanosec",
}
UNIT_OF = {word: unit for unit, words in _WORDS.items() for word in words.split("|")}
UNIT_OF |= {unit.lower(): unit for unit in ("mph", "g", "mg", "km", "cm", "mm", "mA", "Pa", "hPa")}
"""Units as headers write them, in brackets or behind an underscore."""
TIME_UNITS = ("s", "ms", "us", "ns")
_ELEMENT = re.compile(
    r"(?:(?<=gyro)|(?<=accel)|(?<=acc)|(?<=acceleration)|(?<=angular_velocity))\[([012])\]$"
)
"""Elements of vectors of an IMU."""
_BRACKETS = re.compile(r"^(.*?)[\s_]*[\[(]([^\])]*)[\])]\s*$")
TIME = re.compile(
    r"(^|_)([a-z]*time|timestamp|stamp|ts?|sec|secs|seconds|utc|epoch|date|zeit|uhrzeit|datum|i?tow|sow)(_|$)"
)
WEEK = re.compile(r"(^|_)(g?wk|week|week_?n(r|o|um|umber)?|wn)$")
OF_WEEK = re.compile(r"(^|_)(i?tow|sow)(_|$)|of_week")
"""Names of GPS weeks, and of the time within one."""
_TRUTH = ("gt", "truth", "groundtruth", "ground_truth", "mocap", "vicon", "optitrack")
_OWNER = {"gps": "gnss", "gnss": "gnss", "imu": "imu", "wheels": "wheels", "odom": "wheels"}
_OWNER |= dict.fromkeys(_TRUTH, "truth")
"""Channel that a column belongs to by the sensor in front of its name: gps_speed is none of the wheels."""

SIDES = {
    "left": "left|l",
    "right": "right|r",
    "front_left": "front_left|fl|left_front|lf",
    "front_right": "front_right|fr|right_front|rf",
    "rear_left": "rear_left|rl|back_left|bl|left_rear|left_back|lr|hind_left|left_hind|lh",
    "rear_right": "rear_right|rr|back_right|br|right_rear|right_back|hind_right|right_hind|rh",
}
_SPEED = r"(?:(?:ground|track|wheel|whl|drive|chain|tyre|tire)_?)?(?:v|vel|velocity|speed|spd)|wheel|ws"
_SIGMA = "std?_?dev|std|sigma|sd"
_ROTATION = "w|omega|rpm"
_TURNED = "ticks?|counts?|pulses?|enc|encoder|angle|pos|position"


_INCREMENTS = {"d", "delta", "diff", "inc", "incr", "increment", "increments"}
_COUNTED = {"tick", "ticks", "count", "counts", "pulse", "pulses", "enc", "encoder"}
"""Words of counts that begin again with each row."""


def _beside(word: str, side: str) -> str:
    """Pattern of a name that holds a word and a side in either order, with or without "wheel"."""
    return rf"(?:{word})_?(?:{side})|(?:wheel_)?(?:{side})_?(?:wheel_)?(?:{word})"


_PATTERNS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (r"lat(?:itude)?", "gnss", ("latitude_deg",)),
    (r"lon|lng|long|longitude", "gnss", ("longitude_deg",)),
    (r"alt|altitude|height|h", "gnss", ("height_m",)),
    (r"(?:fix_)?qual(?:ity)?|q|status_status", "gnss", ("fix",)),
    (r"s_?acc|speed_acc(?:uracy)?", "gnss", ("sigma_v_mps",)),
    (r"fix_type", "gnss", ("fix",)),
    *(
        (rf"(?:{_SIGMA})_?(?:{words})|(?:{words})_?(?:{_SIGMA})", "gnss", (f"sigma_{a}_m",))
        for a, words in (("e", "lon|longitude|east"), ("n", "lat|latitude|north"), ("u", "alt|height|up"))
    ),
    (r"v_?acc|vertical_acc(?:uracy)?", "gnss", ("sigma_u_m",)),
    *((rf"position_covariance_?{i}", "gnss", (f"sigma_{a}_m",)) for a, i in (("e", 0), ("n", 4), ("u", 8))),
    (r"up", "gnss", ("up_m",)),
    *((rf"(?:pos(?:ition)?_)?ecef_?(?:pos_)?{a}|{a}_?ecef", "gnss", (f"ecef_{a}_m",)) for a in "xyz"),
    *(
        (
            rf"{word}|{word}ing|{a}|utm_?(?:{a}|{xy}|{word}|{word}ing)|(?:{a}|{xy})_?utm",
            "gnss",
            (f"{word}_m",),
        )
        for word, a, xy in (("east", "e", "x"), ("north", "n", "y"))
    ),
    *(
        (rf"v(?:el)?_?(?:{a}|{word})|{word}_vel(?:ocity)?", "gnss", (f"v_{a if a != 'd' else 'u'}_mps",))
        for a, word in (("e", "east"), ("n", "north"), ("u", "up"), ("d", "down"))
    ),
    *(
        (
            rf"(?:g|gyr|gyro|w|omega|angular_velocity|angular_rate|ang_vel|gyroscope|rotation_rate)_?{a}|gyro_rad_{i}|w_rs_s_{a}",
            "imu",
            (f"gyro_{a}_radps",),
        )
        for i, a in enumerate("xyz")
    ),
    (r"yaw_?rate|(?:gyro_)?yaw_velocity|gyro_yaw|yaw_dot|gyro", "imu", ("gyro_z_radps",)),
    *(
        (
            rf"(?:a|acc|accel|acceleration|linear_acceleration|lin_acc|(?:total_)?acceler(?:ation|ometer))_?{a}"
            rf"|accelerometer_m_s2_{i}|a_rs_s_{a}",
            "imu",
            (f"accel_{a}_mps2",),
        )
        for i, a in enumerate("xyz")
    ),
    *((_beside(_SPEED, s), "wheels", (f"{side}_mps", f"{side}_radps")) for side, s in SIDES.items()),
    *(
        (rf"(?:wheel_)?(?:{s})(?:_wheel)?", "wheels", (f"{side}_mps", f"{side}_radps"))
        for side, s in SIDES.items()
    ),
    *((_beside(_ROTATION, s), "wheels", (f"{side}_radps", f"{side}_mps")) for side, s in SIDES.items()),
    *((_beside("motor_rpm", s), "wheels", (f"{side}_radps",)) for side, s in SIDES.items()),
    *((_beside(_TURNED, s), "wheels", (f"{side}_rad",)) for side, s in SIDES.items()),
    (
        r"(?:(?:wheel|odo|odometer|odometry|vehicle|forward|linear)_)?(?:v|vel|velocity|speed)"
        r"|(?:twist_)?linear_x|linear_vel(?:ocity)?_x",
        "wheels",
        ("speed_mps",),
    ),
    (r"w|omega|(?:twist_)?angular_z", "wheels", (YAW_RATE,)),
    (r"steer(?:ing)?_wheel(?:_angle)?", "steering", ("steering_wheel_rad",)),
    (r"steer(?:ing)?(?:_angle)?", "steering", ("angle_rad",)),
    *(
        (_beside("i|cur|current|motor_current", SIDES[side]), "motor", (f"{side}_a",))
        for side in ("left", "right")
    ),
    *((rf"(?:pos|position|truth)?_?{a}|p_rs_r_{a}", "truth", (f"{a}_m",)) for a in "xyz"),
    *((rf"q_rs_{a}", "truth", (f"q{a}",)) for a in "xyzw"),
    (r"yaw|heading|theta", "truth", ("yaw_rad",)),
)
"""Names of columns that people often use, the channel, and its fields that they may stand for."""
_LEVEL = re.compile(r"h_?acc|horizontal_acc(?:uracy)?")
"""Names of a horizontal accuracy, which stands for the sigma of both axes."""
_MESSAGE = re.compile(
    r"(.*_)?(angular_velocity_[xyz]|linear_acceleration_[xyz]|twist_(?:linear_x|angular_z)"
    r"|latitude|longitude|altitude|status_status|header_stamp|position_covariance_?[048])"
)
"""Names of ROS messages' fields, behind the path that exports give them: /odom/twist/twist/linear/x."""


_OF_ODOMETRY = {"vx": "linear_x", "v_x": "linear_x", "wz": "angular_z", "w_z": "angular_z"}
"""Names that other sensors give to what they measure themselves."""
_FUSED = re.compile(r"filter|fused|ekf|ukf|slam|visual|camera|lidar|locali[sz]|amcl")
"""Topics of estimates, which are no odometry of wheels."""
_SENSOR = re.compile(
    r"(?:((?:front|rear|back|left|right|top|base|body|main|second(?:ary)?|primary)_)(?=imu|gps|gnss))?"
    rf"(imu|gps|gnss|odom|robot|wheels|{'|'.join(_TRUTH)})(_?\d+)?_(?=.)"
)
"""A sensor in front of the name of its column, and which of several it is."""


@dataclass(frozen=True)
class Header:
    """A column's name, without its unit, in small letters with underscores; the unit, "" for none; the sensor
    in front of the name; whether an encoder counts from row to row, by its name; which of several sensors
    the name tells, "" for none; and whether it has a unit that is not known."""

    column: str
    base: str
    unit: str
    sensor: str
    increments: bool = False
    device: str = ""
    strange_unit: bool = False


def is_time(name: str) -> bool:
    """Whether a column is a time by its name."""
    return TIME.search(header_of(name).base) is not None


def header_of(name: str) -> Header:
    bracketed = None if re.search(r"\[\d+\]$", name) else _BRACKETS.match(name)  # an element of an array
    base, unit = (bracketed[1], bracketed[2]) if bracketed else (name, "")
    if element := _ELEMENT.search(name):
        base = name[: element.start()] + "_" + "xyz"[int(element[1])]
    elif unit.lower() in ("x", "y", "z"):
        base, unit = f"{base}_{unit}", ""
    base = re.sub(r"([a-z])([A-Z])", r"\1_\2", base.strip())
    base = re.sub(r"[^a-z0-9]+", "_", base.lower()).strip("_")
    known = UNIT_OF.get(re.sub(r"\s+", "", unit.strip().lower()), UNIT_OF.get(unit.strip().lower(), ""))
    if not bracketed:
        words = base.split("_")
        for count in (3, 2, 1):  # deg_per_s, m_s, ms
            ending = "_".join(words[-count:])
            if count < len(words) and ending in UNIT_OF:
                base, known = "_".join(words[:-count]), UNIT_OF[ending]
                break
    if known == "ticks" and not bracketed:
        base = f"{base}_ticks"
    words = base.split("_")
    counts = known == "ticks" or not _COUNTED.isdisjoint(words)
    increments = counts and not _INCREMENTS.isdisjoint(words)
    if increments:
        base = "_".join(word for word in words if word not in _INCREMENTS)
    device = ""
    if path := _MESSAGE.fullmatch(base) if re.search(r"[./]", name) and "cmd" not in base else None:
        device, base = path[1] or "", path[2]
    if not known and "rpm" in base.split("_"):  # rpm_left
        known = "rpm"
    sensor = _SENSOR.match(base)
    if sensor:
        base = base[sensor.end() :]
        base = _OF_ODOMETRY.get(base, base) if sensor[2] == "odom" else base
        device = f"{sensor[1] or ''}{(sensor[3] or '').strip('_')}"
    return Header(
        name,
        base,
        known,
        sensor[2] if sensor else "",
        increments,
        device,
        bool(unit.strip(" -")) and not known,
    )


def _guess(header: Header) -> tuple[str, str] | None:
    """Channel and field that a column may stand for."""
    for channel, fields in FIELDS.items():
        own = header.column in fields and header.column not in TEXT_FIELDS  # whose codes no name tells
        if own and channel in ("imu", "wheels", "gnss", "motor", "steering"):
            return channel, header.column
    for pattern, channel, fields in _PATTERNS:
        fused = channel == "wheels" and _FUSED.search(header.device)
        if fused or _OWNER.get(header.sensor, channel) != channel or not re.fullmatch(pattern, header.base):
            continue
        for field in fields:
            fits = not header.unit or header.unit in units_of(field)
            if fits or (header.unit == "ticks" and field.endswith("_rad")):
                return channel, field
    return None


def guesses(header: Header) -> list[tuple[str, str]]:
    """Channels and fields that a column may stand for."""
    if _LEVEL.fullmatch(header.base):
        return [("gnss", "sigma_e_m"), ("gnss", "sigma_n_m")]
    if header.base == "fix_type" and not header.column.endswith(header.base):
        return []  # u-blox's fixType has other codes
    return [] if (guess := _guess(header)) is None else [guess]


def of_each(headers: Sequence[Header], channel: str) -> dict[str, list[str]]:
    """The columns of sensors that give the same field of a channel, by the sensor; {} where one does."""
    by_field: dict[str, set[str]] = {}
    for header in headers:
        for owner, field in guesses(header):
            if owner == channel:
                by_field.setdefault(field, set()).add(header.device)
    alike = set().union(*(devices for devices in by_field.values() if len(devices) > 1))
    found: dict[str, list[str]] = {}
    for header in headers:
        if header.device in alike and any(owner == channel for owner, _ in guesses(header)):
            found.setdefault(header.device, []).append(header.column)
    return found
