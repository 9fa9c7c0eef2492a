"""Plain tables, text or Parquet, with a column map."""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pymap3d
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs, distinct
from terrafusion.datasets.core.channels import Gnss, Wheels
from terrafusion.datasets.core.conventions import apply, true_updates
from terrafusion.datasets.core.decimals import (
    DAY_NS,
    OF_CLOCK,
    OF_DAY,
    NotADecimal,
    dates_to_ns,
    iso_dates,
    month_is_assumed,
)
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.gnss_time import gps_to_unix_ns, leap_note
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import UP_FACTOR
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.channel_tables import GNSS_SIGMA, GNSS_VELOCITY, QUATERNION, ChannelReader
from terrafusion.datasets.readers.delimited import MISSING, head_lines, number_in, separator_of, split
from terrafusion.datasets.readers.formats import MAP_SUFFIX, PARQUET_MAGIC, Request
from terrafusion.datasets.readers.log_folder import CHANNELS, recording_of
from terrafusion.datasets.readers.text.column_map import (
    DDMM,
    ECEF,
    EPOCHS,
    GEODETIC,
    TEXT_FIELDS,
    VARIANCE,
    YAW_RATE,
    ColumnMap,
    MappedColumn,
    TimeColumn,
    contract_map,
    read_column_map,
    units_of,
)
from terrafusion.datasets.readers.text.column_names import header_of
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE, Fixes, gnss_channel
from terrafusion.datasets.readers.text.json_lines import is_json_lines
from terrafusion.datasets.readers.text.proposed_map import (
    GEAR,
    TICKS,
    TRACK,
    has_time,
    left_out,
    second_sensors,
    starter_map,
)
from terrafusion.datasets.readers.text.text_columns import (
    NamedColumns,
    ParquetColumns,
    TextColumns,
    numbered,
)
from terrafusion.datasets.readers.timed_tables import TimedTable, new_times, row_times

SUFFIXES, LOOSE_SUFFIXES = (".csv", ".tsv"), (".txt", ".dat")
PACKED = (".csv.gz", ".tsv.gz")
JSON_SUFFIXES = (".jsonl", ".ndjson", ".json", ".log", ".txt")

_OF_HOUR = re.compile(r"\d\d:\d\d\.\d+")
_DAYS = re.compile(r"^\d+ days? \+?(?=\d)")
"""In front of the times of day of pandas' differences of times."""
SHOWN_COLUMNS = 60
MOST_AT_ONCE = 50
"""So many rows of one time, and no other, are no log."""
LONG_S = 20.0
"""No robot that is worth a log stands for so long (assumed)."""
EARTH_M, FAR_M = 6.37e6, 1e5
"""Mean radius of the Earth, and how far from it a ground robot is at most."""
LEAST_ROWS, SHORTEST_STEP_S = 20, 1e-6
"""So many rows tell how far they are apart; no sensor is read faster."""
MAX_NS = 8 * 10**18
"""Leaves room for any epoch in int64."""

TableColumns = TextColumns | ParquetColumns


def claims(path: Path, head: bytes) -> bool:
    """Whether a file is Parquet, or text that ends as tables do (.txt, .dat: with rows of one length)."""
    if head.startswith(PARQUET_MAGIC) or path.name.lower().endswith(PACKED):
        return True
    if path.suffix.lower() in JSON_SUFFIXES and is_json_lines(head):
        return True
    if path.suffix.lower() not in (*SUFFIXES, *LOOSE_SUFFIXES) or b"\0" in head:
        return False
    if path.suffix.lower() in SUFFIXES:
        return True
    try:
        head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 3:  # else the head ends inside a character
            return False
    lines = [line for _, line in head_lines(head, 20) if line.strip() and not line.startswith("#")]
    lengths = {len(split(line, separator_of(lines[0]))) for line in lines[: max(len(lines) - 1, 2)]}
    return len(lines) > 1 and len(lengths) == 1 and lengths.pop() > 1


def read(request: Request) -> list[Recording]:
    """The one recording of a table."""
    path = request.path
    given = request.columns or path.with_name(path.name + MAP_SUFFIX)
    column_map = read_column_map(given) if request.columns or given.is_file() else None
    with path.open("rb") as file:
        parquet = file.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC
    columns: TableColumns = ParquetColumns(path) if parquet else TextColumns(path, column_map)
    notes = [] if column_map is None else [f"columns as {given.name} says"]
    if column_map is None:
        column_map = contract_map(columns.names)
        notes = ["columns are known by the log folder's names for them"]
    if column_map is None:
        raise _mapless(path, columns)
    for name in column_map.columns():
        if name not in columns.names:
            raise DataError(f"there is no column '{name}'", remedy=f"the file has {_few(columns.names)}")
    columns.read(column_map)
    return [_recording(request, columns, column_map, notes)]


def _few(names: list[str]) -> str:
    return ", ".join(names[:SHOWN_COLUMNS])


def _mapless(path: Path, columns: TableColumns) -> DataError:
    names, first = columns.names, columns.first_cells()
    signal = next((name for name in names if name.lower() in ("signal", "variable", "name", "topic")), "")
    if signal and "value" in map(str.lower, names):
        what = f"is a long table: a value of one '{signal}' a line"
        return DataError(what, remedy=f"export one column for each '{signal}', and one of time")
    if len(names) > SHOWN_COLUMNS or sum(map(len, names)) > 20 * SHOWN_COLUMNS:
        names = [name[:40] for name in names[:SHOWN_COLUMNS]]
    proposal = starter_map(names, first, columns.units, of_file=path.stem, sample=columns.sample)
    if names == numbered(len(names)):
        proposal = f"header: none, {proposal}"
        given = f"{', '.join(names)} (first row: {', '.join(first)})"
    else:
        given = ", ".join(filter(None, names))
    open_scales = {TICKS: "how many ticks make a turn?", GEAR: "what is the gear ratio?"}
    open_scales[TRACK] = "how far apart are the wheels? any distance keeps the yaw rate"
    if "increments" not in proposal:
        open_scales[TICKS] += " where they begin again with each row, add increments: true"
    ask = "".join(f" ({scale}: {question})" for scale, question in open_scales.items() if scale in proposal)
    if not has_time(names, first):
        ask += f" (no name is a time's: does '{names[0]}' hold seconds?)"
    headers = [header_of(name) for name in names]
    for taken, left in second_sensors(headers).items():
        ask += (
            f" (of several sensors it takes that of {taken}: for another write its columns, {left[0]}, ...)"
        )
    rest = left_out(names, proposal)
    if strange := [header.column for header in headers if header.strange_unit and header.column not in rest]:
        ask += f" (the units in {', '.join(strange)} are not known)"
    unused = f" and which leaves out {', '.join(rest)}" if rest else ""
    return DataError(
        f"nothing says what the columns {given} are",
        remedy=f"correct this proposal, whose fields and units are guesses{ask}{unused} "
        "(entries: Plain tables in docs/reference/formats.md), and save it as "
        f"{path.name}{MAP_SUFFIX}: {{{proposal}}}",
    )


def _recording(request: Request, columns: TableColumns, column_map: ColumnMap, notes: list[str]) -> Recording:
    t_ns, time_notes = _times(columns, column_map)
    times = row_times(request, "table", t_ns)
    if not len(t_ns):
        raise DataError("holds no rows", remedy="record or copy it again")
    if len(t_ns) > MOST_AT_ONCE and not np.ptp(t_ns):
        what = f"all {len(t_ns)} rows have the same time by column '{column_map.time.column}'"
        raise DataError(what, remedy=f"map 'time' to another column: the file has {_few(columns.names)}")
    start_ns = max(int(times.t_ns[0]), 0)  # no recording starts before 1970
    meta = dataclasses.replace(column_map.meta, start_ns=start_ns)
    fields = {name: fields for name, fields in column_map.channels.items() if fields}
    t_s = times.t_ns - start_ns
    track_m, track_notes = odometry_track(request, column_map)
    tables = {
        name: table_of(columns, of, times.order, t_s, request.path, track_m, column_map.held.get(name))
        for name, of in fields.items()
    }
    reader = TableReader(tables, meta, rig=request.rig)
    channels = {name: reader.channel(name) for name in CHANNELS}
    if not any(channel is not None and len(channel) for channel in channels.values()):
        raise DataError("no channel holds a sample", remedy="check the column map")
    notes += [*time_notes, *columns.notes, *times.notes, *track_notes, *reader.notes]
    notes += increments_note(channels["wheels"], fields.get("wheels", {}), "wheels" in column_map.held)
    recording = recording_of(channels, meta, request.path.stem, notes)
    held = [name for name, channel in channels.items() if channel is not None]
    recording = dataclasses.replace(recording, datum=reader.datum, clock_jumps=times.jumps_of(held))
    return apply(recording, column_map.conventions())


def odometry_track(request: Request, column_map: ColumnMap) -> tuple[float, list[str]]:
    """Track (m) of an odometry that gives speed and yaw rate, and a note; nan where it gives wheels.

    Raises:
        DataError: nobody gives it.
    """
    if YAW_RATE not in column_map.channels.get("wheels", {}):
        return math.nan, []
    track_m = request.rig.track_m if request.rig is not None else column_map.meta.track_m
    if track_m is None:
        remedy = "give track_m in the column map, or --vehicle; any keeps the yaw rate"
        raise DataError("speed and yaw rate need the track", channel="wheels", remedy=remedy)
    return track_m, [f"wheels: sides of speed and yaw rate, {track_m:g} m apart"]


def _times(columns: TableColumns, column_map: ColumnMap) -> tuple[NDArray[np.int64], list[str]]:
    """Nanoseconds of the rows, since 1970 where the map gives the epoch."""
    time = column_map.time
    t_ns = columns.times_ns(time.column, time.unit)
    if t_ns is None:
        return _iso_ns(columns, time)
    if time.nanoseconds:
        rest_ns = columns.times_ns(time.nanoseconds, "ns")
        if rest_ns is None or (np.abs(rest_ns) >= 10**9).any():
            what = f"column '{time.nanoseconds}' holds no nanoseconds below a second"
            raise DataError(what, remedy="correct 'time' of the column map")
        t_ns = t_ns + rest_ns
    late = np.flatnonzero(np.abs(t_ns) > MAX_NS)
    if late.size:
        raise DataError(
            f"the time of row {int(late[0]) + 1} is {t_ns[late[0]] * 1e-9:.9g} s",
            remedy=f"is the unit {time.unit}?",
        )
    _check_unit(t_ns, time)
    if time.epoch == "none":
        return t_ns, ["times have no calendar"]
    if time.epoch == "gps":
        t_ns = gps_to_unix_ns(t_ns)
        return t_ns, [leap_note(t_ns)] if len(t_ns) else []
    if time.epoch != "unix":
        t_ns = t_ns + dates_to_ns([time.epoch])[0]
    return t_ns, []


def _check_unit(t_ns: TimesNs, time: TimeColumn) -> None:
    """Refuse times of rows (N,) that are of another kind than numbers in the unit."""
    span_s = float(np.ptp(t_ns)) * 1e-9 if len(t_ns) > LEAST_ROWS else 0.0
    step_s = span_s / max(len(t_ns) - 1, 1)
    if 0.0 < step_s < SHORTEST_STEP_S:
        what = f"rows are {step_s:.2g} s apart by column '{time.column}'"
        raise DataError(what, remedy=f"is its unit {time.unit}? write days, as Excel counts them, as dates")
    if time.unit == "s" and span_s > 200.0 and step_s < 10.0 and (t_ns % (100 * 10**9) < 60 * 10**9).all():
        what = f"column '{time.column}' holds hours, minutes and seconds such as {t_ns[0] * 1e-9:06.0f}"
        raise DataError(what, remedy="give it the unit iso8601 in the column map")


def _iso_ns(columns: TableColumns, time: TimeColumn) -> tuple[NDArray[np.int64], list[str]]:
    """Dates with times, or times of day: these begin on the day of the epoch, and go on after midnight.

    So do minutes and seconds, as Excel shows times, after each hour.
    """
    texts = columns.texts(time.column).tolist()
    plain = [_DAYS.sub("", text) for text in iso_dates(texts)]
    if plain and all(map(OF_CLOCK.fullmatch, plain)):
        plain = [OF_CLOCK.sub(r"\1:\2:\3", text) for text in plain]
    turn_ns = DAY_NS
    if plain and all(map(_OF_HOUR.fullmatch, plain)):
        plain, turn_ns = [f"00:{text}" for text in plain], DAY_NS // 24
    of_day = bool(texts) and OF_DAY.fullmatch(plain[0]) is not None
    try:
        t_ns = dates_to_ns(
            ["1970-01-01T" + "0" * (text[1:2] == ":") + text for text in plain] if of_day else plain
        )
    except NotADecimal as bad:
        raise DataError(
            f"column '{time.column}' is '{texts[bad.row][:40]}' in row {bad.row + 1}",
            remedy="give ISO 8601 times such as 2024-05-01T12:00:00.25Z, or another time unit in the map "
            "(of dates such as 5/1/2024 alone nothing tells day and month)",
        ) from None
    if not of_day:
        zoned = bool(texts) and re.search(r"(Z|:\S*[+-]\d\d(:?\d\d)?)$", plain[0])
        notes = [] if zoned else ["times without an offset are taken as UTC"]
        if month_is_assumed(texts):
            notes += [f"the month is taken first in dates such as {texts[0][:40]}, as beside AM and PM"]
        return t_ns, notes
    steps = np.diff(t_ns, prepend=t_ns[:1])
    t_ns = t_ns + turn_ns * np.cumsum((steps < -turn_ns // 2).astype(np.int64) - (steps > turn_ns // 2))
    if time.epoch in EPOCHS:
        return t_ns, ["times of day are those of 1970-01-01; 'epoch' of the column map can give the day"]
    return t_ns + dates_to_ns([time.epoch])[0], ["times without an offset are taken as UTC"]


def table_of(
    columns: NamedColumns,
    fields: Mapping[str, MappedColumn],
    order: Any,
    t_ns: TimesNs,
    path: Path,
    track_m: float,
    held: float | None,
) -> TimedTable:
    """The mapped columns of a channel in SI units, its rows in the `order` of their times; speed and yaw rate
    as the sides' speeds that an odometry of that track makes them of; increments `held` for rows once."""
    texts = {name: _words(columns, name, of)[order] for name, of in fields.items() if name in TEXT_FIELDS}
    numbers = {}
    for name, of in fields.items():
        if name not in TEXT_FIELDS:
            factor = units_of(name).get(of.unit, 1.0) * (-of.scale if of.sign == "-" else of.scale)
            values = columns.numbers(of.column)[order]
            if of.unit == DDMM:
                values = _degrees(values, of.column)
            if of.hemisphere:
                values = values * _signs(columns.texts(of.hemisphere)[order], of.hemisphere)
            numbers[name] = values if factor == 1.0 else values * factor
            if of.unit == VARIANCE:  # zero and below: the receiver knows none
                numbers[name] = np.sqrt(np.where(numbers[name] <= 0.0, np.nan, numbers[name]))
    if counted := [name for name, of in fields.items() if of.increments]:
        steps = np.stack([numbers[name] for name in counted], axis=1)
        steps[~true_updates(steps, round(held or 1))] = np.nan
        numbers |= dict(
            zip(counted, np.where(np.isnan(steps), np.nan, np.nancumsum(steps, axis=0)).T, strict=True)
        )
    if "yaw_rad" in numbers:
        yaw = numbers.pop("yaw_rad")
        rpy = np.stack([np.zeros(len(yaw)), np.zeros(len(yaw)), yaw], axis=1)
        numbers |= dict(zip(QUATERNION, rpy_to_quaternion(rpy).T, strict=True))
    if {"speed_mps", YAW_RATE} <= numbers.keys():  # alone, it is a command's
        speed, half = numbers.pop("speed_mps"), 0.5 * track_m * numbers.pop(YAW_RATE)
        numbers |= {"left_mps": speed - half, "right_mps": speed + half}
    return TimedTable(t_ns=t_ns, path=path, numbers=numbers, texts=texts)


def increments_note(wheels: Wheels | None, fields: Mapping[str, MappedColumn], held: bool) -> list[str]:
    """A note where the angles of wheels, which have no speeds, stay within a turn, as increments do; or where
    no increment comes once, as where rows hold them."""
    if wheels is None or wheels.angle_rad is None or not all(name.endswith("_rad") for name in fields):
        return []
    steps = np.diff(wheels.angle_rad, axis=0).round(9)
    begins = np.flatnonzero((steps[1:] != steps[:-1]).any(axis=1)) + 1
    runs = np.diff(begins)[steps[begins[:-1]].any(axis=1)]
    if (
        any(of.increments for of in fields.values())
        and not held
        and len(runs) > LEAST_ROWS
        and runs.min() > 1
    ):
        rows = np.bincount(runs).argmax()
        return [f"wheels: increments stay for {rows} rows: if these hold them, add held: {{wheels: {rows}}}"]
    range_rad, span_s = float(np.ptp(wheels.angle_rad, axis=0).max()), np.ptp(wheels.t_ns) * 1e-9
    if range_rad > 2.0 * math.pi or span_s < LONG_S:
        return []
    what = f"wheels: no angle leaves a range of {range_rad:.2g} rad in {span_s:.0f} s"
    return [f"{what}: of counts that begin again with each row, add increments: true to their entries"]


def _degrees(values: Array, column: str) -> Array:
    """Degrees (N,) of numbers such as 4807.5, which are degrees and minutes."""
    degrees = np.trunc(values / 100.0)
    minutes = values - 100.0 * degrees
    if (np.abs(minutes) >= 60.0).any():
        bad = values[np.flatnonzero(np.abs(minutes) >= 60.0)[0]]
        raise DataError(f"column '{column}' is {bad:.12g}: no minutes", remedy="is its unit deg?")
    return degrees + minutes / 60.0


def _geodetic(ecef_m: Array) -> Array:
    """Latitude (deg), longitude (deg) and height (m) above the ellipsoid (N, 3) of ECEF positions (N, 3).

    NaN where a receiver writes zeros for no position.

    Raises:
        DataError: a position that is not within 100 km of the ground.
    """
    ecef_m = np.where((ecef_m == 0.0).all(axis=1)[:, None], np.nan, ecef_m)
    radius_m = np.linalg.norm(ecef_m, axis=1)
    if (far := np.abs(radius_m - EARTH_M) > FAR_M).any():
        what = f"is {radius_m[far][0]:.4g} m from the centre of the Earth by {', '.join(ECEF)}"
        raise DataError(what, channel="gnss", remedy="correct the units, or map east_m and north_m")
    return np.stack(pymap3d.ecef2geodetic(*ecef_m.T), axis=1)


def _signs(letters: NDArray[Any], column: str) -> Array:
    """Signs (N,) of hemispheres, NaN where there is none."""
    signs = {"N": 1.0, "E": 1.0, "S": -1.0, "W": -1.0} | dict.fromkeys(MISSING, math.nan)
    words, inverse = distinct(letters)
    if strange := [word for word in words if word.strip().upper() not in signs]:
        raise DataError(f"column '{column}' is '{strange[0][:40]}'", remedy="give N, S, E or W")
    return np.array([signs[word.strip().upper()] for word in words])[inverse]


def _words(columns: NamedColumns, name: str, of: MappedColumn) -> NDArray[Any]:
    """Texts (N,) of a column; codes of fixes in words."""
    texts = columns.texts(of.column)
    if name != "fix" or not of.unit:
        return texts
    words, inverse = distinct(texts)
    codes: dict[float, str] = {code: fix.name.lower() for code, fix in FIX_OF_CODE[of.unit].items()}
    numbers = map(number_in, words)
    meanings = ["" if number is None else codes.get(number, "") for number in numbers]
    for word, meant in zip(words, meanings, strict=True):
        if word.strip() not in MISSING and not meant:
            raise DataError(
                f"column '{of.column}' is '{word[:40]}'",
                remedy=f"{of.unit} has the codes {', '.join(map(str, codes))}",
            )
    return np.array(meanings, dtype=object)[inverse]


class TableReader(ChannelReader):
    """Channels of a table; a GNSS channel may be in latitude and longitude, and without sigmas."""

    REQUIRED: ClassVar[dict[str, tuple[str, ...]]] = ChannelReader.REQUIRED | {"gnss": ()}

    def _gnss(self, table: TimedTable) -> Gnss | None:
        for every in (GEODETIC[:2], ("east_m", "north_m"), ECEF):
            if 0 < len(present := [name for name in every if name in table.numbers]) < len(every):
                what = f"has only {', '.join(present)} of {', '.join(every)}"
                raise DataError(what, channel="gnss", remedy="give all")
        local = "east_m" in table.numbers
        position = table.stack(("east_m", "north_m", "up_m") if local else GEODETIC)
        if ECEF[0] in table.numbers:
            position = _geodetic(table.stack(ECEF))
        sigma = table.stack(GNSS_SIGMA)
        if "sigma_e_m" in table.numbers and "sigma_u_m" not in table.numbers:
            sigma[:, 2] = UP_FACTOR * sigma[:, :2].max(axis=1)
        fixes = Fixes(
            self._t(table),
            position,
            self._fix(table),
            sigma,
            table.stack(GNSS_VELOCITY) if "v_e_mps" in table.numbers else None,
            table.numbers.get("sigma_v_mps"),
            local,
        )
        gnss, self.datum, notes = gnss_channel(self.rig, fixes, self.datum)
        self.notes += notes
        return gnss

    def _truth(self, table: TimedTable) -> Trajectory:
        once = new_times(table.t_ns)
        if not once.all():
            self.notes.append(f"truth: {int((~once).sum())} poses with a repeated time left out")
        return super()._truth(table.select(once))
