"""A first column map for a table without one, guessed from the names of its columns."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from terrafusion.datasets.core.decimals import OF_DAY, iso_dates
from terrafusion.datasets.core.gnss_time import FULL_WEEK_MIN, WEEK_S, gps_to_unix_ns
from terrafusion.datasets.readers.delimited import number_in
from terrafusion.datasets.readers.text.column_map import (
    DDMM,
    FIELDS,
    TEXT_FIELDS,
    VARIANCE,
    YAW_RATE,
    units_of,
)

TICKS = "1/1024"
"""Scale proposed for encoder ticks: nothing in a table says how many make a turn."""
GEAR = "1/30"
"""Scale proposed for the speed of motors: nothing in a table tells the gear ratio."""
_WORDS = {
    "deg/s": "deg/s|°/s|dps|degps|degs|deg_s|deg_per_s|deg/sec",
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
_BRACKETS = re.compile(r"^(.*?)[\s_]*[\[(]([^\])]*)[\])]\s*$")
_TIME = re.compile(
    r"(^|_)([a-z]*time|timestamp|stamp|ts?|sec|secs|seconds|utc|epoch|date|zeit|uhrzeit|datum|i?tow|sow)(_|$)"
)
_WEEK = re.compile(r"(^|_)(g?wk|week|week_?n(r|o|um|umber)?|wn)$")
_OF_WEEK = re.compile(r"(^|_)(i?tow|sow)(_|$)|of_week")
"""Names of GPS weeks, and of the time within one."""
_OWNER = {"gps": "gnss", "gnss": "gnss", "imu": "imu", "wheels": "wheels"}
"""Channel that a column belongs to by the sensor in front of its name: gps_speed is none of the wheels."""

_SIDES = {
    "left": "left|l",
    "right": "right|r",
    "front_left": "front_left|fl|left_front|lf",
    "front_right": "front_right|fr|right_front|rf",
    "rear_left": "rear_left|rl|back_left|bl|left_rear|left_back|lr",
    "rear_right": "rear_right|rr|back_right|br|right_rear|right_back",
}
_SPEED = r"(?:(?:ground|track|wheel|drive|chain|tyre|tire)_)?(?:v|vel|velocity|speed)|wheel"
_ROTATION = "w|omega|rpm"
_TURNED = "ticks?|counts?|pulses?|enc|encoder|angle|pos|position"


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
    (r"v_?acc|vertical_acc(?:uracy)?", "gnss", ("sigma_u_m",)),
    *((rf"position_covariance_?{i}", "gnss", (f"sigma_{a}_m",)) for a, i in (("e", 0), ("n", 4), ("u", 8))),
    (r"up", "gnss", ("up_m",)),
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
            rf"(?:g|gyr|gyro|w|omega|angular_velocity|angular_rate|ang_vel|gyroscope)_?{a}|gyro_rad_{i}|w_rs_s_{a}",
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
    *((_beside(_SPEED, s), "wheels", (f"{side}_mps", f"{side}_radps")) for side, s in _SIDES.items()),
    *(
        (rf"(?:wheel_)?(?:{s})(?:_wheel)?", "wheels", (f"{side}_mps", f"{side}_radps"))
        for side, s in _SIDES.items()
    ),
    *((_beside(_ROTATION, s), "wheels", (f"{side}_radps", f"{side}_mps")) for side, s in _SIDES.items()),
    *((_beside("motor_rpm", s), "wheels", (f"{side}_radps",)) for side, s in _SIDES.items()),
    *((_beside(_TURNED, s), "wheels", (f"{side}_rad",)) for side, s in _SIDES.items()),
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
        (_beside("i|cur|current|motor_current", _SIDES[side]), "motor", (f"{side}_a",))
        for side in ("left", "right")
    ),
    *((rf"(?:pos|position|truth)?_?{a}|p_rs_r_{a}", "truth", (f"{a}_m",)) for a in "xyz"),
    *((rf"q_rs_{a}", "truth", (f"q{a}",)) for a in "xyzw"),
    (r"yaw|heading", "truth", ("yaw_rad",)),
)
"""Names of columns that people often use, the channel, and its fields that they may stand for."""
_LEVEL = re.compile(r"h_?acc|horizontal_acc(?:uracy)?")
"""Names of a horizontal accuracy, which stands for the sigma of both axes."""
_MESSAGE = re.compile(
    r"(?:.*_)?(angular_velocity_[xyz]|linear_acceleration_[xyz]|twist_(?:linear_x|angular_z)"
    r"|latitude|longitude|altitude|status_status|header_stamp|position_covariance_?[048])"
)
"""Names of ROS messages' fields, behind the path that exports give them: /odom/twist/twist/linear/x."""
_OF_FILE = (
    ("gyro", re.compile(r"gyro", re.IGNORECASE)),
    ("acc", re.compile(r"^(?!.*lin).*acc", re.IGNORECASE)),
)
"""Sensors whose files, by their names, may call columns just x, y, z; a linear acceleration lacks gravity."""
_COURSE = re.compile(r"(^|_)(bearing|course|cog|g_?crs|track_angle|direction)(_|$)")
"""Names of a receiver's direction of motion, which its speed stands beside."""
_COUNTER, _WHOLE = re.compile(r"(^|_)(enc|encoder)(_|$)"), re.compile(r"-?\d+")
"""Whole numbers of an encoder are ticks."""
_SCALED = 1e6
"""A latitude or longitude above that is in 1e-7 deg; heights and whole numbers beside it are in mm and mm/s
(as u-blox and MAVLink have them)."""
_LONGEST_STEP_S = 2.0
"""Rows of a drive are not farther apart: larger steps of a time are in a smaller unit (assumed)."""
_IN_G = (0.85, 1.15)
"""Size of a specific force of a robot at rest that is in g."""
_HEMISPHERES = {"latitude_deg": ("N", "S"), "longitude_deg": ("E", "W")}
_NMEA_PLACE = re.compile(r"-?\d{4,5}\.\d+")
"""A latitude or longitude in degrees and minutes; with zeros in front of small ones."""
_TOGETHER = (
    ("gnss", ("latitude_deg", "longitude_deg")),
    ("gnss", ("east_m", "north_m")),
    ("gnss", ("v_e_mps", "v_n_mps")),
    ("motor", ("left_a", "right_a")),
    ("motor", ("left_v", "right_v")),
    ("truth", ("x_m", "y_m")),
)
_NEEDED = {"gnss": ("latitude_deg", "east_m"), "truth": ("x_m",), "motor": ("left_a",)}
"""One of these must be there."""
_WHEELS = tuple(
    tuple(f"{side}_{unit}" for side in sides)
    for unit in ("radps", "mps", "rad")
    for sides in (tuple(_SIDES)[2:], tuple(_SIDES)[:2])
)


@dataclass(frozen=True)
class _Header:
    """A column's name, without its unit, in small letters with underscores; the unit, "" for none; and the
    sensor in front of the name."""

    column: str
    base: str
    unit: str
    sensor: str


def starter_map(
    names: Sequence[str],
    first: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    of_file: str = "",
    step: Callable[[str], float] = lambda name: 0.0,
) -> str:
    """A first column map, on one line, for the user to correct.

    The first row's cells tell units, as do those of a line of `units` below the header and the median `step`
    of a column; the name `of_file` tells the sensor of columns x, y, z.
    """
    headers = [_header(name) for name in names]
    if {"x", "y", "z"} <= {h.base for h in headers}:
        sensor = next((word for word, name in _OF_FILE if name.search(of_file)), "")
        headers = [
            replace(h, base=f"{sensor}_{h.base}") if sensor and h.base in "xyz" else h for h in headers
        ]
    for k, (header, unit) in enumerate(zip(headers, units, strict=False)):
        headers[k] = header if header.unit else replace(_header(f"{header.column} [{unit}]"), column=names[k])
    cells = dict(zip(names, first, strict=False))
    times = [h for h in headers if _TIME.search(h.base)]
    of_day = [h for h in times if _cell_of_day(h, cells)]
    time = next((h for h in times if h.base == "header_stamp"), [*of_day, *times, headers[0]][0])
    rest = _nanoseconds(time.column, names)
    channels: dict[str, dict[str, str]] = {}
    for header in headers if not _in_g(headers, cells) else [_of_g(header) for header in headers]:
        if header.column in (time.column, rest):
            continue
        for channel, field in _guesses(header):
            if field == "fix" and number_in(cells.get(header.column, "") or "0") is None:
                continue  # words, which may be none of the classes
            if field not in channels.get(channel, {}):
                if _COUNTER.search(header.base) and _WHOLE.fullmatch(cells.get(header.column, "")):
                    header = replace(header, unit=header.unit or "ticks")
                place = _place_entry(header, cells, field) if field in _HEMISPHERES else ""
                channels.setdefault(channel, {})[field] = place or _entry(header, field)
    channels = _complete(channels) or {"imu": {"gyro_z_radps": "NAME"}}
    gnss = channels.get("gnss", {})
    if "1e-7 deg" in gnss.get("latitude_deg", ""):  # a receiver's own integers
        for header in headers:
            for channel, field in _guesses(header):
                whole = field == "height_m" or _WHOLE.fullmatch(cells.get(header.column, ""))
                small = {"m": "mm", "mps": "mm/s"}.get(field.rpartition("_")[2], "")
                if channel == "gnss" and field in gnss and small and whole and not header.unit:
                    gnss[field] = _entry(replace(header, unit=small), field)
    if gnss and any(_COURSE.search(h.base) for h in headers) and "speed_mps" in channels.get("wheels", {}):
        del channels["wheels"]
    sections = ", ".join(
        f"{channel}: {{{', '.join(f'{field}: {entry}' for field, entry in fields.items())}}}"
        for channel, fields in channels.items()
    )
    day = _day(headers, time, cells)
    entry = _time_entry(time, cells.get(time.column, ""), rest, day, step(time.column))
    return f"time: {entry}, channels: {{{sections}}}"


def is_time(name: str) -> bool:
    """Whether a column is a time by its name."""
    return _TIME.search(_header(name).base) is not None


def left_out(names: Sequence[str], proposal: str) -> list[str]:
    """The columns that a proposed map does not use."""
    return [name for name in names if name and json.dumps(name, ensure_ascii=False) not in proposal]


def _guesses(header: _Header) -> list[tuple[str, str]]:
    """Channels and fields that a column may stand for."""
    if _LEVEL.fullmatch(header.base):
        return [("gnss", "sigma_e_m"), ("gnss", "sigma_n_m")]
    if header.base == "fix_type" and not header.column.endswith(header.base):
        return []  # u-blox's fixType has other codes
    guess = _guess(header)
    return [] if guess is None else [guess]


def _in_g(headers: Sequence[_Header], cells: Mapping[str, str]) -> bool:
    """Whether the first specific force is 1, not 9.8, long, in columns without a unit."""
    square, axes = 0.0, 0
    for header in headers:
        guess = _guess(header)
        if guess is None or not guess[1].startswith("accel_") or header.unit or header.column == guess[1]:
            continue
        value = number_in(cells.get(header.column, "").replace(",", "."))
        if value is None:
            return False
        square, axes = square + value**2, axes + 1
    return axes == 3 and _IN_G[0] ** 2 < square < _IN_G[1] ** 2


def _of_g(header: _Header) -> _Header:
    guess = _guess(header)
    in_g = guess is not None and guess[1].startswith("accel_") and not header.unit
    return replace(header, unit="g") if in_g else header


def _header(name: str) -> _Header:
    bracketed = None if re.search(r"\[\d+\]$", name) else _BRACKETS.match(name)  # an element of an array
    base, unit = (bracketed[1], bracketed[2]) if bracketed else (name, "")
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
    if path := _MESSAGE.fullmatch(base) if re.search(r"[./]", name) and "cmd" not in base else None:
        base = path[1]
    if not known and "rpm" in base.split("_"):  # rpm_left
        known = "rpm"
    sensor = re.match(r"(imu|gps|gnss|odom|robot|wheels)_(?=.)", base)
    return _Header(name, base[sensor.end() :] if sensor else base, known, sensor[1] if sensor else "")


def _guess(header: _Header) -> tuple[str, str] | None:
    """Channel and field that a column may stand for."""
    for channel, fields in FIELDS.items():
        own = header.column in fields and header.column not in TEXT_FIELDS  # whose codes no name tells
        if own and channel in ("imu", "wheels", "gnss", "motor", "steering"):
            return channel, header.column
    for pattern, channel, fields in _PATTERNS:
        if _OWNER.get(header.sensor, channel) != channel or not re.fullmatch(pattern, header.base):
            continue
        for field in fields:
            fits = not header.unit or header.unit in units_of(field)
            if fits or (header.unit == "ticks" and field.endswith("_rad")):
                return channel, field
    return None


def _entry(header: _Header, field: str) -> str:
    name = json.dumps(header.column, ensure_ascii=False)
    if field.endswith("_rad") and (header.unit == "ticks" or "tick" in header.base):
        return f"{{column: {name}, unit: rev, scale: {TICKS}}}"
    if field == "fix":
        codes = {"status_status": "navsatfix", "fix_type": "mavlink"}.get(header.base, "nmea")
        return f"{{column: {name}, unit: {codes}}}"
    own = VARIANCE if "covariance" in header.base else next(iter(units_of(field)))
    if own == VARIANCE:
        return f"{{column: {name}, unit: {VARIANCE}}}"
    if "motor_rpm" in header.base:
        return f"{{column: {name}, unit: rpm, scale: {GEAR}}}"
    if field == "v_u_mps" and re.search(r"d$|down", header.base):
        return f"{{column: {name}, unit: {header.unit or own}, sign: '-'}}"
    if header.column == field or header.unit in ("", own):
        return name
    return f"{{column: {name}, unit: {header.unit}}}"


def _place_entry(header: _Header, cells: Mapping[str, str], field: str) -> str:
    """The entry of a latitude or longitude beside a column of its hemisphere, or as NMEA writes it; "" for
    another."""
    beside = [name for name, cell in cells.items() if cell.strip() in _HEMISPHERES[field]]
    cell = cells.get(header.column, "").strip()
    unit = header.unit or (DDMM if _NMEA_PLACE.fullmatch(cell) else "")
    if not unit and abs(number_in(cell) or 0.0) > _SCALED:
        unit = "1e-7 deg"
    parts = [("column", header.column), *([("unit", unit)] if unit else [])]
    parts += [("hemisphere", name) for name in beside[:1]]
    written = (f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in parts)
    return f"{{{', '.join(written)}}}" if beside or unit != header.unit else ""


def _complete(channels: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """The channels without fields that cannot stand alone, and of wheels the best layout only."""
    found = {channel: dict(fields) for channel, fields in channels.items()}
    for channel, pair in _TOGETHER:
        fields = found.get(channel, {})
        if len(set(pair) & set(fields)) == 1:
            fields.pop(pair[0], None)
            fields.pop(pair[1], None)
    for channel, needed in _NEEDED.items():
        if not set(needed) & set(found.get(channel, {})):
            found.pop(channel, None)
    gnss, wheels, steering = (found.get(channel, {}) for channel in ("gnss", "wheels", "steering"))
    one_axle = {"front_rad", "rear_rad"} & set(steering) == {"front_rad"}
    if "angle_rad" in steering or one_axle:
        found["steering"] = {"angle_rad": steering["angle_rad" if "angle_rad" in steering else "front_rad"]}
    elif "front_rad" not in steering:
        steering.pop("rear_rad", None)
    if "latitude_deg" in gnss:
        found["gnss"] = {name: e for name, e in gnss.items() if name not in ("east_m", "north_m", "up_m")}
    layout = next((names for names in _WHEELS if set(names) <= set(wheels)), ())
    one = {name: wheels[name] for name in ("speed_mps", YAW_RATE) if "speed_mps" in wheels and name in wheels}
    found["wheels"] = {name: wheels[name] for name in layout} or one
    if YAW_RATE in found["wheels"] and '"x"' in found.get("truth", {}).get("x_m", "").lower():
        del found["truth"]  # of the odometry that gives the speeds
    return {channel: fields for channel, fields in found.items() if fields}


def _nanoseconds(time: str, names: Sequence[str]) -> str:
    """The column of the nanoseconds that belong to one of seconds, "" where there is none."""
    before, word, after = time.rpartition("sec")
    pairs = [f"{before}{nano}{word}{after}" for nano in ("n", "nano")] if word else []
    return next((name for name in pairs if name in names), "")


def _cell_of_day(header: _Header, cells: Mapping[str, str]) -> bool:
    return OF_DAY.fullmatch(iso_dates([cells.get(header.column, "")])[0]) is not None


def _day(headers: Sequence[_Header], time: _Header, cells: Mapping[str, str]) -> str:
    """The day or GPS week of a time within it, by another column; "" where none tells."""
    others = [(header, cells.get(header.column, "")) for header in headers if header is not time]
    if _OF_WEEK.search(time.base):
        weeks = [number_in(cell) for header, cell in others if _WEEK.search(header.base)]
        full = [week for week in weeks if week is not None and FULL_WEEK_MIN <= week < 10 * FULL_WEEK_MIN]
        starts = gps_to_unix_ns(np.array(full[:1], dtype=np.int64) * WEEK_S * 10**9)
        return "".join(f"{np.datetime64(int(start), 'ns').astype('datetime64[s]')}Z" for start in starts)
    dates = iso_dates([cell for header, cell in others if _TIME.search(header.base)])
    known = [date for date in dates if re.fullmatch(r"\d{4}-\d\d-\d\d", date)]
    return known[0] if known and _cell_of_day(time, cells) else ""


def _time_entry(time: _Header, cell: str, rest: str, day: str, step: float) -> str:
    name = json.dumps(time.column, ensure_ascii=False)
    unit, epoch = time.unit or UNIT_OF.get(time.base, ""), "unix"
    unit = unit if unit in TIME_UNITS else ""
    since = f", epoch: {json.dumps(day)}" if day else ""
    value = number_in(cell.removesuffix(" sec").replace(",", "."))
    if value is None and cell.strip():
        return f"{{column: {name}, unit: iso8601{since}}}"
    if value is None:
        return f"{{column: {name}, unit: {unit or 's'}, epoch: unix}}"
    if _OF_WEEK.search(time.base):
        unit = unit or ("ms" if abs(value) > WEEK_S or time.base == "i_tow" else "s")
        return f"{{column: {name}, unit: {unit}{since or ', epoch: none'}}}"
    size = {"s": 1e9, "ms": 1e12, "us": 1e15, "ns": 1e18}  # in 2001
    unit = unit or next((known for known in ("ns", "us", "ms") if abs(value) >= size[known]), "")
    if not unit and abs(value) < 0.1 * size["s"] and step == round(step):
        unit = next((known for known in TIME_UNITS if step <= _LONGEST_STEP_S * size[known] * 1e-9), "")
    unit = unit or "s"
    if abs(value) < 0.1 * size[unit]:
        epoch = "none"
    split = f", nanoseconds: {json.dumps(rest, ensure_ascii=False)}" if rest else ""
    return f"{{column: {name}, unit: {unit}, epoch: {epoch}{split}}}"
