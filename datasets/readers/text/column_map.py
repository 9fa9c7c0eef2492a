"""The column map of a plain table: a YAML file that says what its columns are (docs/formats.md)."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.config import Quantity, checked_number, read_yaml, shown, structure
from terrafusion.datasets.core.conventions import BODY_AXES, Conventions
from terrafusion.datasets.core.decimals import NS_PER, NotADecimal, dates_to_ns
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.sensors import axes_matrix
from terrafusion.datasets.readers import log_meta
from terrafusion.datasets.readers.channel_tables import (
    ACCEL,
    COVARIANCE,
    FIELD,
    GNSS_HEIGHT,
    GNSS_POSITION,
    GNSS_VELOCITY,
    GYRO,
    QUATERNION,
    TRUTH_TWIST,
    WHEEL_LAYOUTS,
)
from terrafusion.datasets.readers.log_meta import Meta, parse_meta
from terrafusion.datasets.readers.text.units import units_of

GEODETIC = ("latitude_deg", "longitude_deg", "height_m")
WHEEL_FIELDS = tuple(dict.fromkeys(f"{n}_{unit}" for names, unit in WHEEL_LAYOUTS for n in names))
ANGLE_FIELDS = tuple(f"{n}_rad" for n in dict.fromkeys(n for names, _ in WHEEL_LAYOUTS[:3] for n in names))
FIELDS: dict[str, tuple[str, ...]] = {
    "command": ("v_mps", "yaw_rate_radps"),
    "wheels": (*WHEEL_FIELDS, *ANGLE_FIELDS),
    "imu": (*GYRO, *ACCEL),
    "gnss": (*GEODETIC, *GNSS_POSITION, *GNSS_HEIGHT, *GNSS_VELOCITY, "sigma_v_mps", "fix"),
    "motor": ("left_a", "right_a", "left_v", "right_v"),
    "terrain": ("label",),
    "barometer": ("pressure_pa",),
    "magnetometer": FIELD,
    "truth": ("x_m", "y_m", "z_m", "yaw_rad", *QUATERNION, *TRUTH_TWIST, *COVARIANCE),
}
"""Fields of each channel: the columns of the log folder, latitude and longitude, and a plain yaw.
`terrain` also takes p_<class>."""

TEXT_FIELDS = ("fix", "label")
FIX_CODES = ("", "nmea", "rtklib", "navsatfix")
"""What stands in a column for `fix`: words, or the codes of these (its unit)."""

TIME_UNITS = (*NS_PER, "iso8601")
EPOCHS = ("unix", "gps", "none")
META_KEYS = tuple(key for key in log_meta.KEYS if key not in ("start_ns", *log_meta.HISTORY_KEYS))
ROWS = Quantity("rows", 1.0, 1e4)


@dataclass(frozen=True)
class ColumnOf:
    """Where a field stands: `unit` "" for that of the field's name, `sign` "-" where it is the other way."""

    column: str
    unit: str = ""
    sign: str = "+"


@dataclass(frozen=True)
class TimeOf:
    """The time column: decimal numbers in `unit` since `epoch`, or ISO 8601.

    `epoch` is unix, gps (leap seconds are taken off), none (no calendar), or an instant in ISO 8601.
    """

    column: str
    unit: str = "s"
    epoch: str = "unix"


@dataclass(frozen=True)
class Layout:
    """How a table stands.

    Attributes:
        time, channels: where times and fields stand, by channel and field.
        separator: of the text; "" for tab, semicolon, comma or blanks, as the header shows.
        header: "none" where the first line is a row: columns are then named 1, 2, ...
        imu_axes: IMU axes that point along body x, y, z.
    """

    time: TimeOf
    channels: dict[str, dict[str, ColumnOf]]
    separator: str = ""
    header: str = "line"
    imu_axes: tuple[str, ...] = BODY_AXES


LAYOUT_KEYS = tuple(f.name for f in dataclasses.fields(Layout))
KEYS = (*LAYOUT_KEYS, "held", *META_KEYS)


@dataclass(frozen=True)
class ColumnMap(Layout):
    """What a table's columns are.

    Attributes:
        held: rows for which a channel holds a value.
        meta: what a log folder's meta.yaml may say.
    """

    held: dict[str, float] = field(default_factory=dict)
    meta: Meta = field(default_factory=lambda: Meta(0))

    def conventions(self) -> Conventions:
        """What is to be applied to the channels after reading."""
        return Conventions(imu_axes=self.imu_axes, held=self.held)

    def columns(self) -> list[str]:
        """Names of all columns that are asked for, each once."""
        fields = (of.column for channel in self.channels.values() for of in channel.values())
        return list(dict.fromkeys([self.time.column, *fields]))


def read_column_map(path: Path) -> ColumnMap:
    """Read and check a column map.

    Raises:
        ConfigError: unknown key, channel, field, unit or sign, a value of the wrong type.
    """
    raw = {key: value for key, value in read_yaml(path).items() if value is not None}
    strange = next((key for key in raw if key not in KEYS), None)
    if strange is not None:
        close = difflib.get_close_matches(strange, KEYS, n=1)
        remedy = f"did you mean '{close[0]}'?" if close else f"known are {', '.join(KEYS)}"
        raise ConfigError(f"unknown key '{shown(strange)}'", file=path, remedy=remedy)
    sections = {key: raw[key] for key in LAYOUT_KEYS if key in raw}
    for key, levels in (("time", 0), ("channels", 2)):
        if key in sections:
            sections[key] = _columns_as_sections(sections[key], levels)
    layout = structure(Layout, sections, file=path)
    _check_time(path, layout.time)
    _check_channels(path, layout.channels)
    if layout.header not in ("line", "none"):
        raise ConfigError(f"'header' is '{shown(layout.header)}'", file=path, remedy="give line or none")
    if len(layout.separator) > 1:
        raise ConfigError(
            f"'separator' is '{shown(layout.separator)}'", file=path, remedy="give one character"
        )
    try:
        axes_matrix(layout.imu_axes)
    except ValueError as error:
        raise ConfigError(str(error), file=path, channel="imu_axes") from None
    meta = parse_meta({key: raw[key] for key in META_KEYS if key in raw} | {"start_ns": 0}, path)
    told = {key: getattr(layout, key) for key in LAYOUT_KEYS}
    return ColumnMap(**told, held=_held(path, raw.get("held", {})), meta=meta)


def contract_map(names: list[str]) -> ColumnMap | None:
    """The map of a table whose columns are those of the log folder, None where they are not."""
    rest = [name for name in names if name != "t_s"]
    channels: dict[str, dict[str, ColumnOf]] = {}
    for name in rest:
        owners = [c for c in FIELDS if name in FIELDS[c] or (c == "terrain" and name.startswith("p_"))]
        if len(owners) > 1:  # v_mps: of the truth's twist beside x_m, else commanded
            owners = ["truth" if "x_m" in names else "command"]
        if not owners:
            return None
        channels.setdefault(owners[0], {})[name] = ColumnOf(name)
    if "t_s" not in names or not channels:
        return None
    return ColumnMap(TimeOf("t_s", "s", "none"), channels)


def starter_map(names: list[str]) -> str:
    """A first column map for these columns, on one line, to be mended by hand."""
    time = next((n for n in names if re.search(r"time|stamp|^t(_|$)|sec", n, re.I)), names[0])
    channels: dict[str, dict[str, str]] = {}
    for name in names:
        field_of = next((f for pattern, f in GUESSES if re.fullmatch(pattern, name, re.I)), None)
        if name != time and field_of and field_of[1] not in channels.get(field_of[0], {}):
            channels.setdefault(field_of[0], {})[field_of[1]] = name
    channels = channels or {"imu": {"gyro_z_radps": names[-1]}}
    told = ", ".join(
        f"{channel}: {{{', '.join(f'{f}: {json.dumps(n)}' for f, n in fields.items())}}}"
        for channel, fields in channels.items()
    )
    return f"time: {{column: {json.dumps(time)}, unit: s, epoch: unix}}, channels: {{{told}}}"


_UNIT = r"(?:_\w+| ?[\[(].*)?"
_LEFT, _RIGHT = r"(?:l|left)", r"(?:r|right)"
GUESSES: tuple[tuple[str, tuple[str, str]], ...] = (
    (r"lat(?:itude)?(?:_deg)?", ("gnss", "latitude_deg")),
    (r"(?:lon|lng|long|longitude)(?:_deg)?", ("gnss", "longitude_deg")),
    (r"(?:alt|altitude|height)(?:_m)?", ("gnss", "height_m")),
    *(
        (rf"(?:g|gyr|gyro|w|omega|angular_velocity)[_. ]?{a}{_UNIT}", ("imu", f"gyro_{a}_radps"))
        for a in "xyz"
    ),
    *(
        (rf"(?:a|acc|accel|acceleration|linear_acceleration)[_. ]?{a}{_UNIT}", ("imu", f"accel_{a}_mps2"))
        for a in "xyz"
    ),
    *(
        (rf"(?:v|vel|speed|wheel)[_. ]?{side}|{side}[_. ]?(?:v|vel|velocity|speed|wheel)", ("wheels", to))
        for side, to in ((_LEFT, "left_mps"), (_RIGHT, "right_mps"))
    ),
    *(
        (rf"(?:i|cur|current)[_. ]?{side}|{side}[_. ]?(?:i|cur|current)", ("motor", to))
        for side, to in ((_LEFT, "left_a"), (_RIGHT, "right_a"))
    ),
    *((rf"(?:pos|position|truth)?[_. ]?{a}(?:_m)?", ("truth", f"{a}_m")) for a in "xyz"),
    (r"yaw(?:_rad)?|heading", ("truth", "yaw_rad")),
)
"""Names of columns that people often use, and the field they may stand for."""


def _columns_as_sections(raw: Any, levels: int) -> Any:
    """The same mapping with plain column names as sections, `levels` deep."""
    if levels and isinstance(raw, dict):
        return {key: _columns_as_sections(value, levels - 1) for key, value in raw.items()}
    if isinstance(raw, (str, int)) and not isinstance(raw, bool):
        return {"column": str(raw)}
    if isinstance(raw, dict) and isinstance(raw.get("column"), int):
        return raw | {"column": str(raw["column"])}
    return raw


def _held(path: Path, raw: Any) -> dict[str, float]:
    if not isinstance(raw, dict) or not set(raw) <= set(FIELDS):
        raise ConfigError(
            f"'held' is '{shown(raw)}'", file=path, remedy=f"give rows by channel: {', '.join(FIELDS)}"
        )
    rows = {key: checked_number(value, ROWS, file=path, key=f"held.{key}") for key, value in raw.items()}
    return {key: value for key, value in rows.items() if isinstance(value, float)}


def _check_time(path: Path, time: TimeOf) -> None:
    if time.unit not in TIME_UNITS:
        raise ConfigError(
            f"'time.unit' is '{shown(time.unit)}'", file=path, remedy=f"give one of {', '.join(TIME_UNITS)}"
        )
    if time.epoch in EPOCHS:
        return
    try:
        dates_to_ns([time.epoch])
    except NotADecimal:
        raise ConfigError(
            f"'time.epoch' is '{shown(time.epoch)}'",
            file=path,
            remedy=f"give {', '.join(EPOCHS)} or an instant such as 2024-05-01T12:00:00Z, in quotes",
        ) from None


def _check_channels(path: Path, channels: dict[str, dict[str, ColumnOf]]) -> None:
    if not any(channels.values()):
        raise ConfigError("'channels' is empty", file=path, remedy=f"give {', '.join(FIELDS)}")
    for channel, fields in channels.items():
        if channel not in FIELDS:
            raise ConfigError(
                f"unknown channel '{shown(channel)}'", file=path, remedy=f"known are {', '.join(FIELDS)}"
            )
        for name, of in fields.items():
            _check_field(path, channel, name, of)
        if channel == "gnss" and bool({"east_m", "north_m"} & set(fields)) == ("latitude_deg" in fields):
            raise ConfigError(
                "'gnss' must have either latitude_deg and longitude_deg or east_m and north_m", file=path
            )


def _check_field(path: Path, channel: str, name: str, of: ColumnOf) -> None:
    here = f"channels.{channel}.{name}"
    if name not in FIELDS[channel] and not (channel == "terrain" and name.startswith("p_")):
        close = difflib.get_close_matches(name, FIELDS[channel], n=1)
        known = ", ".join(FIELDS[channel][:24])
        remedy = f"did you mean '{close[0]}'?" if close else f"known are {known}"
        raise ConfigError(f"unknown field '{shown(here)}'", file=path, remedy=remedy)
    units = FIX_CODES if name == "fix" else ("",) if name == "label" else ("", *units_of(name))
    if of.unit not in units:
        allowed = ", ".join(unit for unit in units if unit)
        raise ConfigError(
            f"'{here}' is in the unit '{shown(of.unit)}'",
            file=path,
            remedy=f"give one of {allowed}" if allowed else "leave the unit out",
        )
    if of.sign not in ("+", "-") or (name in TEXT_FIELDS and of.sign != "+"):
        raise ConfigError(f"'{here}' has the sign '{shown(of.sign)}'", file=path, remedy="give '+' or '-'")
