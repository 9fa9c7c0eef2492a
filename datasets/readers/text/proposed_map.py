"""A first column map for a table without one, guessed from the names of its columns."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from terrafusion.datasets.core.decimals import OF_CLOCK, OF_DAY, iso_dates
from terrafusion.datasets.core.gnss_time import FULL_WEEK_MIN, WEEK_S, gps_to_unix_ns
from terrafusion.datasets.readers.delimited import number_in
from terrafusion.datasets.readers.text.column_map import DDMM, ECEF, VARIANCE, YAW_RATE, units_of
from terrafusion.datasets.readers.text.column_names import (
    OF_WEEK,
    SIDES,
    TIME,
    TIME_UNITS,
    UNIT_OF,
    WEEK,
    Header,
    guesses,
    header_of,
    of_each,
)

TICKS = "1/1024"
"""Scale proposed for encoder ticks: nothing in a table says how many make a turn."""
GEAR = "1/30"
"""Scale proposed for the speed of motors: nothing in a table tells the gear ratio."""
TRACK = "track_m: 1"
"""Proposed beside the yaw rate of an odometry, which it keeps."""
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
_LONGEST_DATED_S = 10.0
"""Nor are dated rows so far apart: ms, us or ns since a start may have the size of dates (assumed)."""
_IN_G = (0.85, 1.15)
"""Size of a specific force of a robot at rest that is in g."""
_CLOCK = re.compile(r"\d:\d\d:\d\d")
_NMEA_DATE = re.compile(r"^([0-3]\d)([01]\d)(\d\d)$")
_NEAR_GROUND_M = (6.3e6, 6.4e6)
"""Distances of ground robots from the centre of the Earth: x, y, z are ECEF."""
_TURN_RAD = 6.3
"""Headings beyond are in degrees."""
_HEMISPHERES = {"latitude_deg": ("N", "S"), "longitude_deg": ("E", "W")}
_NMEA_PLACE = re.compile(r"-?\d{4,5}\.\d+")
"""A latitude or longitude in degrees and minutes; with zeros in front of small ones."""
_TOGETHER = (
    ("gnss", ("latitude_deg", "longitude_deg")),
    ("gnss", ("east_m", "north_m")),
    ("gnss", ("ecef_x_m", "ecef_z_m")),
    ("gnss", ("ecef_x_m", "ecef_y_m")),
    ("gnss", ("v_e_mps", "v_n_mps")),
    ("gnss", ("sigma_e_m", "sigma_n_m")),
    ("motor", ("left_a", "right_a")),
    ("motor", ("left_v", "right_v")),
    ("truth", ("x_m", "y_m")),
)
_NEEDED = {"gnss": ("latitude_deg", "east_m", "ecef_x_m"), "truth": ("x_m",), "motor": ("left_a",)}
"""One of these must be there."""
_WHEELS = tuple(
    tuple(f"{side}_{unit}" for side in sides)
    for unit in ("radps", "mps", "rad")
    for sides in (tuple(SIDES)[2:], tuple(SIDES)[:2])
)


def starter_map(
    names: Sequence[str],
    first: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    of_file: str = "",
    sample: Callable[[str], Sequence[float]] = lambda name: (),
) -> str:
    """A first column map, on one line, for the user to correct.

    The first row's cells tell units, as do those of a line of `units` below the header and the numbers in a
    `sample` of a column; the name `of_file` tells the sensor of columns x, y, z.
    """
    headers = [header_of(name) for name in names]
    if {"x", "y", "z"} <= {h.base for h in headers}:
        sensor = next((word for word, name in _OF_FILE if name.search(of_file)), "")
        xyz = [n for h in headers if h.base in ("x", "y", "z") for n in sample(h.column)[:1]]
        if _NEAR_GROUND_M[0] < np.linalg.norm(xyz) < _NEAR_GROUND_M[1]:
            sensor = "ecef"
        headers = [
            replace(h, base=f"{sensor}_{h.base}") if sensor and h.base in "xyz" else h for h in headers
        ]
    for k, (header, unit) in enumerate(zip(headers, units, strict=False)):
        headers[k] = (
            header if header.unit else replace(header_of(f"{header.column} [{unit}]"), column=names[k])
        )
    cells = dict(zip(names, first, strict=False))
    time = _time_of(headers, cells) or headers[0]
    rest = _nanoseconds(time.column, names)
    channels: dict[str, dict[str, str]] = {}
    others = {name for several in second_sensors(headers).values() for name in several}
    headers = [header for header in headers if header.column not in others]
    headers.sort(key=lambda header: "lin" in header.base and "acc" in header.base)  # mostly without gravity
    for header in headers if not _in_g(headers, cells) else [_of_g(header) for header in headers]:
        if header.column in (time.column, rest):
            continue
        for channel, field in guesses(header):
            if field == "fix" and number_in(cells.get(header.column, "") or "0") is None:
                continue  # words, which may be none of the classes
            if field == "yaw_rad" and max(map(abs, sample(header.column)), default=0.0) > _TURN_RAD:
                header = replace(header, unit="deg")
            if field == "yaw_rad" and (header.base, header.unit) == ("heading", "deg"):
                continue  # of a compass, mostly
            if field not in channels.get(channel, {}):
                if _COUNTER.search(header.base) and _WHOLE.fullmatch(cells.get(header.column, "")):
                    header = replace(header, unit=header.unit or "ticks")
                place = _place_entry(header, cells, field) if field in _HEMISPHERES else ""
                channels.setdefault(channel, {})[field] = place or _entry(header, field)
    channels = _complete(channels) or {"imu": {"gyro_z_radps": "NAME"}}
    gnss = channels.get("gnss", {})
    if "1e-7 deg" in gnss.get("latitude_deg", ""):  # a receiver's own integers
        for header in headers:
            for channel, field in guesses(header):
                cell = cells.get(header.column, "")
                whole = _WHOLE.fullmatch(cell.removesuffix(".0") if field == "height_m" else cell)
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
    entry = _time_entry(time, cells.get(time.column, ""), rest, day, sample(time.column))
    track = f"{TRACK}, " if YAW_RATE in channels.get("wheels", {}) else ""
    return f"time: {entry}, {track}channels: {{{sections}}}"


def has_time(names: Sequence[str], first: Sequence[str]) -> bool:
    """Whether a column is a time by its name, or by its first cell."""
    return _time_of([header_of(name) for name in names], dict(zip(names, first, strict=False))) is not None


def _time_of(headers: Sequence[Header], cells: Mapping[str, str]) -> Header | None:
    """The column of the times: by its name, else by a first cell with hours, minutes and seconds."""
    times = [h for h in headers if TIME.search(h.base)]
    stamps = [h for h in times if h.base == "header_stamp"]
    of_day = [h for h in times if _cell_of_day(h, cells)]
    others = [h for h in headers if _CLOCK.search(cells.get(h.column, ""))]
    return next(iter([*stamps, *of_day, *times, *others]), None)


def wheels_of(columns: Sequence[str]) -> str:
    """The map's section of wheels for fields of a bag, such as /left_ticks.data; "" where none has a name."""
    found: dict[str, str] = {}
    for column in columns:
        for name in (column.removesuffix(".data"), column.rpartition(".")[2]):
            header = header_of(name)
            fields = [field for channel, field in guesses(header) if channel == "wheels"]
            if fields and fields[0] not in found:
                found[fields[0]] = _entry(replace(header, column=column), fields[0])
                break
    section = _complete({"wheels": found}).get("wheels", {})
    return ", ".join(f"{field}: {entry}" for field, entry in section.items())


def second_sensors(headers: Sequence[Header]) -> dict[str, list[str]]:
    """Columns of all but the first of several sensors alike, by the first column of the first."""
    found = {}
    for channel in ("imu", "gnss", "wheels"):
        first, *rest = [*of_each(headers, channel).values()] or [[]]
        if rest:
            found[first[0]] = [name for names in rest for name in names]
    return found


def left_out(names: Sequence[str], proposal: str) -> list[str]:
    """The columns that a proposed map does not use."""
    return [name for name in names if name and json.dumps(name, ensure_ascii=False) not in proposal]


def _in_g(headers: Sequence[Header], cells: Mapping[str, str]) -> bool:
    """Whether the first specific force is 1, not 9.8, long, in columns without a unit."""
    square, axes = 0.0, 0
    for header in headers:
        if not _is_force(header):
            continue
        value = number_in(cells.get(header.column, "").replace(",", "."))
        if value is None:
            return False
        square, axes = square + value**2, axes + 1
    return axes == 3 and _IN_G[0] ** 2 < square < _IN_G[1] ** 2


def _of_g(header: Header) -> Header:
    return replace(header, unit="g") if _is_force(header) else header


def _is_force(header: Header) -> bool:
    """Whether a column is a specific force whose unit nothing tells."""
    fields = [field for _, field in guesses(header)]
    return not header.unit and fields[:1] != [header.column] and "accel_" in "".join(fields)


def _entry(header: Header, field: str) -> str:
    name = json.dumps(header.column, ensure_ascii=False)
    if field.endswith("_rad") and (header.unit == "ticks" or "tick" in header.base):
        return f"{{column: {name}, unit: rev, scale: {TICKS}{', increments: true' * header.increments}}}"
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


def _place_entry(header: Header, cells: Mapping[str, str], field: str) -> str:
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
        local = ("east_m", "north_m", "up_m", *ECEF)
        found["gnss"] = {name: entry for name, entry in gnss.items() if name not in local}
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


def _cell_of_day(header: Header, cells: Mapping[str, str]) -> bool:
    return OF_DAY.fullmatch(iso_dates([cells.get(header.column, "")])[0]) is not None


def _day(headers: Sequence[Header], time: Header, cells: Mapping[str, str]) -> str:
    """The day or GPS week of a time within it, by another column; "" where none tells."""
    others = [(header, cells.get(header.column, "")) for header in headers if header is not time]
    if OF_WEEK.search(time.base):
        weeks = [number_in(cell) for header, cell in others if WEEK.search(header.base)]
        full = [week for week in weeks if week is not None and FULL_WEEK_MIN <= week < 10 * FULL_WEEK_MIN]
        starts = gps_to_unix_ns(np.array(full[:1], dtype=np.int64) * WEEK_S * 10**9)
        return "".join(f"{np.datetime64(int(start), 'ns').astype('datetime64[s]')}Z" for start in starts)
    dates = iso_dates([cell for header, cell in others if TIME.search(header.base)])
    dates = [_NMEA_DATE.sub(r"20\3-\2-\1", date) for date in dates]
    known = [date for date in dates if re.fullmatch(r"\d{4}-\d\d-\d\d", date)]
    of_day = _cell_of_day(time, cells) or OF_CLOCK.fullmatch(cells.get(time.column, ""))
    return known[0] if known and of_day else ""


def _time_entry(time: Header, cell: str, rest: str, day: str, sample: Sequence[float]) -> str:
    name = json.dumps(time.column, ensure_ascii=False)
    unit = time.unit or UNIT_OF.get(time.base, "")
    unit = unit if unit in TIME_UNITS else ""
    since = f", epoch: {json.dumps(day)}" if day else ""
    value = number_in(cell.removesuffix(" sec").replace(",", "."))
    clocks = bool(OF_CLOCK.fullmatch(cell)) and all(number % 100.0 < 60.0 for number in sample)
    if (value is None and cell.strip()) or (clocks and (day or "utc" in time.base.split("_"))):
        return f"{{column: {name}, unit: iso8601{since}}}"
    if value is None:
        return f"{{column: {name}, unit: {unit or 's'}, epoch: unix}}"
    if OF_WEEK.search(time.base):
        unit = unit or ("ms" if abs(value) > WEEK_S or time.base == "i_tow" else "s")
        return f"{{column: {name}, unit: {unit}{since or ', epoch: none'}}}"
    size = {"s": 1e9, "ms": 1e12, "us": 1e15, "ns": 1e18}  # in 2001
    dated = unit or next((known for known in TIME_UNITS[::-1] if abs(value) >= size[known]), "s")
    step = float(np.median(np.diff(sample))) if len(sample) > 1 else 0.0
    uptime = abs(value) < size[dated] or (not unit and step > _LONGEST_DATED_S * size[dated] * 1e-9)
    if not unit and uptime and step == round(step):
        unit = next((known for known in TIME_UNITS if step <= _LONGEST_STEP_S * size[known] * 1e-9), "")
    unit, epoch = unit or dated, "none" if uptime else "unix"
    split = f", nanoseconds: {json.dumps(rest, ensure_ascii=False)}" if rest else ""
    return f"{{column: {name}, unit: {unit}, epoch: {epoch}{split}}}"
