"""The column map of a plain table: a YAML file that says what its columns are (docs/reference/formats.md)."""

import dataclasses
import difflib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.config import Prepared, refuse, structure
from terrafusion.datasets.core.conventions import BODY_AXES, HELD_CHANNELS, Conventions
from terrafusion.datasets.core.decimals import NS_PER, NotADecimal, dates_to_ns
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.quantity import Parsed, Quantity, RejectedError, Word, shown
from terrafusion.datasets.core.recording import Overrides
from terrafusion.datasets.core.sensors import axes_matrix
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.datasets.readers.channel_tables import COLUMNS, GNSS_SIGMA, TRUTH_TWIST
from terrafusion.datasets.readers.log_meta import DescriptionFile, Meta, parse_meta
from terrafusion.datasets.readers.text.fixes import FIX_OF_CODE

DEG = math.pi / 180.0

UNITS: dict[str, dict[str, float]] = {
    "radps": {
        "rad/s": 1.0,
        "deg/s": DEG,
        "mdeg/s": 1e-3 * DEG,
        "rpm": math.pi / 30.0,
        "rev/s": 2.0 * math.pi,
    },
    "mps": {"m/s": 1.0, "km/h": 1.0 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3, "mph": 0.44704, "kn": 1852.0 / 3600.0},
    "mps2": {"m/s2": 1.0, "g": GRAVITY_MPS2, "mg": 1e-3 * GRAVITY_MPS2, "cm/s2": 1e-2, "mm/s2": 1e-3},
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048},
    "rad": {"rad": 1.0, "deg": DEG, "rev": 2.0 * math.pi},
    "deg": {"deg": 1.0, "rad": 1.0 / DEG, "1e-7 deg": 1e-7},
    "pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3},
    "t": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "a": {"A": 1.0, "mA": 1e-3},
    "v": {"V": 1.0, "mV": 1e-3},
    "": {"1": 1.0, "%": 1e-2},
}
"""Factor from each unit to that of the field, the first. g: standard gravity; mph, kn, ft: international."""


DDMM = "ddmm"
"""Unit of NMEA: 4807.5 are 48 degrees and 7.5 minutes."""
VARIANCE = "m2"
"""Unit of a sigma's column that holds its square."""


def units_of(field: str) -> dict[str, float]:
    """The units that a column for `field` may be in, with their factors."""
    if field in GNSS_SIGMA:
        return UNITS["m"] | {VARIANCE: 1.0}
    if field in GEODETIC[:2]:
        return UNITS["deg"] | {DDMM: 1.0}
    ending = field.rpartition("_")[2]
    numeric = (field not in TRUTH_TWIST and field.startswith(("p_", "cov_"))) or "_" not in field
    return UNITS[""] if numeric or ending not in UNITS else UNITS[ending]


GEODETIC = ("latitude_deg", "longitude_deg", "height_m")
ECEF = ("ecef_x_m", "ecef_y_m", "ecef_z_m")
FIELDS = {channel: (*columns.numbers, *columns.texts) for channel, columns in COLUMNS.items()}
FIELDS["gnss"] = (*GEODETIC, *FIELDS["gnss"], *ECEF)
FIELDS["truth"] = (*FIELDS["truth"][:3], "yaw_rad", *FIELDS["truth"][3:])
YAW_RATE = "yaw_rate_radps"
FIELDS["wheels"] = (*FIELDS["wheels"], YAW_RATE)
"""Fields of each channel: the columns of the log folder, latitude and longitude, ECEF, a plain yaw, and the
yaw rate of wheel odometry beside its speed. `terrain` also takes p_<class>."""

TEXT_FIELDS = ("fix", "label")
FIX_CODES = ("", *FIX_OF_CODE)
"""What stands in a column for `fix`: words, or the codes of these (its unit)."""

TIME_UNITS = (*NS_PER, "iso8601")
EPOCHS = ("unix", "gps", "none")
ROWS = Quantity("rows", 1.0, 1e4)


def _section(raw: Any) -> Any:
    """A plain name of a column as a section."""
    if isinstance(raw, (str, int)) and not isinstance(raw, bool):
        return {"column": str(raw)}
    if isinstance(raw, dict) and type(raw.get("column")) is int:
        return raw | {"column": str(raw["column"])}
    return raw


_BY_NAME = Prepared(_section, {"type": ["string", "integer"]})


@dataclass(frozen=True)
class _Scale(Parsed):
    """A number, or the quotient of two as a text."""

    def hint(self) -> str:
        return "a number that is not 0, or a quotient such as 1/1024"

    def parse(self, raw: Any) -> float:
        parts = raw.split("/") if isinstance(raw, str) else [raw]
        try:
            if any(isinstance(part, bool) for part in parts) or len(parts) > 2:
                raise ValueError
            numbers = [float(part) for part in parts]
            scale = numbers[0] / numbers[1] if len(numbers) == 2 else numbers[0]
        except (TypeError, ValueError, ArithmeticError):
            scale = math.nan
        if not scale or not math.isfinite(scale):
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'", f"give {self.hint()}")
        return scale

    def schema(self) -> dict[str, Any]:
        return {"type": ["number", "string"], "description": self.hint()}


@dataclass(frozen=True)
class MappedColumn:
    """Where a field stands: `unit` "" for that of the field's name, `sign` "-" where it is the other way.

    The numbers of the column, times `scale`, are in the unit. Those of latitudes and longitudes are negative
    where the column `hemisphere`, "" for none, says S or W. With `increments` they count from
    row to row.
    """

    column: str
    unit: str = ""
    sign: Annotated[str, Word(("+", "-"))] = "+"
    scale: Annotated[float, _Scale()] = 1.0
    hemisphere: str = ""
    increments: bool = False

    def columns(self) -> list[str]:
        """Names of the columns that hold it."""
        return [self.column, *([self.hemisphere] if self.hemisphere else [])]


@dataclass(frozen=True)
class TimeColumn:
    """The time column: decimal numbers in `unit` since `epoch`, or ISO 8601.

    `epoch` is unix, gps (leap seconds are taken off), none (no calendar), or an instant in ISO 8601, also of
    the day that times of day are of.
    `nanoseconds` is the column with the rest below a second, where the times are split, "" for none.
    """

    column: str
    unit: Annotated[str, Word(TIME_UNITS)] = "s"
    epoch: str = "unix"
    nanoseconds: str = ""

    def columns(self) -> list[str]:
        """Names of the columns that hold the times."""
        return [self.column, *([self.nanoseconds] if self.nanoseconds else [])]


@dataclass(frozen=True, kw_only=True)
class ColumnMapFile(DescriptionFile):
    """Keys of a column map; see `ColumnMap`."""

    time: Annotated[TimeColumn, _BY_NAME]
    channels: dict[str, dict[str, Annotated[MappedColumn, _BY_NAME]]]
    separator: str = ""
    header: Annotated[str, Word(("line", "none"))] = "line"
    imu_axes: tuple[str, ...] = BODY_AXES
    held: dict[str, Annotated[float, ROWS]] = field(default_factory=dict)


TABLE_KEYS = tuple(f.name for f in dataclasses.fields(ColumnMapFile))
BAG_KEYS = ("channels", "imu_axes", "held", *(f.name for f in dataclasses.fields(Overrides)))
META_KEYS = tuple(f.name for f in dataclasses.fields(DescriptionFile))


@dataclass(frozen=True, kw_only=True)
class ColumnMap(ColumnMapFile):
    """What a table's columns are.

    Attributes:
        time, channels: where times and fields stand, by channel and field.
        separator: of the text; "" for tab, semicolon, comma or blanks, as the header shows.
        header: "none" where the first line is a row: columns are then named 1, 2, ...
        imu_axes: IMU axes that point along body x, y, z.
        held: rows for which a channel holds a value.
        meta: what a log folder's meta.yaml may say.
    """

    meta: Meta = field(default_factory=lambda: Meta(start_ns=0))

    def conventions(self) -> Conventions:
        """What is to be applied to the channels after reading."""
        return Conventions(imu_axes=self.imu_axes, held=self.held)

    def columns(self) -> list[str]:
        """Names of all columns that are asked for, each once."""
        fields = [of.columns() for channel in self.channels.values() for of in channel.values()]
        return list(dict.fromkeys([*self.time.columns(), *itertools.chain(*fields)]))

    def words(self) -> set[str]:
        """Names of the columns that hold words."""
        fields = [field for channel in self.channels.values() for field in channel.items()]
        hemispheres = {of.hemisphere for _, of in fields if of.hemisphere}
        return hemispheres | {of.column for name, of in fields if name in TEXT_FIELDS}


def read_column_map(path: Path, *, of_bag: bool = False) -> ColumnMap:
    """Read and check a column map, of a table or of fields of a bag's messages.

    Raises:
        ConfigError: unknown key, channel, field, unit or sign, a value of the wrong type.
    """
    raw = {key: value for key, value in read_yaml(path).items() if value is not None}
    if of_bag:
        foreign = [key for key in raw if key in TABLE_KEYS and key not in BAG_KEYS]
        refuse([(f"'{key}' is of tables, not of bags", "remove it") for key in foreign], path)
        raw["time"] = "header.stamp"
    found = structure(ColumnMapFile, raw, file=path)
    refuse(_problems(found), path)
    meta = parse_meta({key: raw[key] for key in META_KEYS if key in raw} | {"start_ns": 0}, path)
    return ColumnMap(**vars(found), meta=meta)


def contract_map(names: list[str]) -> ColumnMap | None:
    """The map of a table whose columns are those of the log folder, None where they are not."""
    rest = [name for name in names if name != "t_s"]
    channels: dict[str, dict[str, MappedColumn]] = {}
    for name in rest:
        owner = _owner(name, names)
        if owner is None:
            return None
        channels.setdefault(owner, {})[name] = MappedColumn(name)
    if "t_s" not in names or not channels:
        return None
    return ColumnMap(time=TimeColumn("t_s", "s", "none"), channels=channels)


def _owner(name: str, names: list[str]) -> str | None:
    """The channel of a column of the log folder, by the columns beside it; None for another name."""
    owners = [channel for channel, fields in FIELDS.items() if name in fields]
    if owners == ["command", "truth"]:  # v_mps: of the truth's twist beside x_m, else commanded
        return "truth" if "x_m" in names else "command"
    if owners == ["wheels", "steering"]:  # front_left_rad: of the wheel beside its speed, else steered
        wheel = name.removesuffix("_rad")
        return "wheels" if {f"{wheel}_radps", f"{wheel}_mps"} & set(names) else "steering"
    return owners[0] if owners else "terrain" if name.startswith("p_") else None


def _problems(found: ColumnMapFile) -> Iterator[tuple[str, str]]:
    """What is wrong beyond single values, and the remedy."""
    if found.time.epoch not in EPOCHS and not _is_instant(found.time.epoch):
        instant = "an instant such as 2024-05-01T12:00:00Z, in quotes"
        yield f"'time.epoch' is '{shown(found.time.epoch)}'", f"give {', '.join(EPOCHS)} or {instant}"
    if found.time.nanoseconds and found.time.unit == "iso8601":
        yield "'time' has nanoseconds beside iso8601", "remove them"
    if len(found.separator) > 1:
        yield f"'separator' is '{shown(found.separator)}'", "give one character"
    try:
        axes_matrix(found.imu_axes)
    except ValueError as error:
        what, _, remedy = str(error).partition("; ")
        yield f"'imu_axes': {what}", remedy
    strange = [channel for channel in found.held if channel not in HELD_CHANNELS]
    if strange:
        yield f"'held' names the channel '{shown(strange[0])}'", f"give {', '.join(HELD_CHANNELS)}"
    if not any(found.channels.values()):
        yield "'channels' is empty", f"give {', '.join(FIELDS)}"
    for channel, fields in found.channels.items():
        if channel not in FIELDS:
            yield f"unknown channel '{shown(channel)}'", f"known are {', '.join(FIELDS)}"
            continue
        for name, of in fields.items():
            yield from _field_problems(channel, name, of)
        if YAW_RATE in fields and {*fields} != {YAW_RATE, "speed_mps"}:
            yield f"'wheels' has {', '.join(fields)}", f"{YAW_RATE} stands beside speed_mps alone"
        positions = (GEODETIC[:2], ("east_m", "north_m"), ECEF)
        if channel == "gnss" and sum(bool({*fields} & {*one}) for one in positions) != 1:
            remedy = f"give one of: {' | '.join(map(', '.join, positions))}"
            yield "'gnss' has no position, or two", remedy


def _field_problems(channel: str, name: str, of: MappedColumn) -> Iterator[tuple[str, str]]:
    here = f"channels.{channel}.{name}"
    if name not in FIELDS[channel] and not (channel == "terrain" and name.startswith("p_")):
        close = difflib.get_close_matches(name, FIELDS[channel], n=1)
        known = f"known are {', '.join(FIELDS[channel][:24])}"
        yield f"unknown field '{shown(here)}'", f"did you mean '{close[0]}'?" if close else known
        return
    units = FIX_CODES if name == "fix" else ("",) if name == "label" else ("", *units_of(name))
    if of.unit not in units:
        allowed = ", ".join(unit for unit in units if unit)
        remedy = f"give one of {allowed}" if allowed else "leave the unit out"
        yield f"'{here}' is in the unit '{shown(of.unit)}'", remedy
    if of.hemisphere and name not in GEODETIC[:2]:
        yield f"'{here}' has a hemisphere", f"only {' and '.join(GEODETIC[:2])} have one"
    if of.increments and not (channel == "wheels" and name.endswith("_rad")):
        yield f"'{here}' has increments", "only angles of wheels come as increments"
    if name in TEXT_FIELDS and of.sign != "+":
        yield f"'{here}' has the sign '-', but is a text", "leave the sign out"
    if name in TEXT_FIELDS and of.scale != 1.0:
        yield f"'{here}' has a scale, but is a text", "leave the scale out"


def _is_instant(text: str) -> bool:
    try:
        dates_to_ns([text])
    except NotADecimal:
        return False
    return True
