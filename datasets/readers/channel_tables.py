"""Tables with the columns of the log folder -> channels of a recording.

`read_table` reads one from its CSV: strict header, times exact to the nanosecond.
"""

import csv
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, Mask, distinct
from terrafusion.datasets.core.channels import (
    Barometer,
    Channel,
    Command,
    Fix,
    Gnss,
    Imu,
    Magnetometer,
    Motor,
    Steering,
    Terrain,
    Wheels,
)
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.sensors import Rig, with_assumed_sigma
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.wrapped_angles import (
    paired_sides,
    sampled_apart,
    speeds_of,
    unwrapped_alone,
    unwrapped_beside_speeds,
)
from terrafusion.datasets.readers.delimited import TextLayout, not_a_table, read_text
from terrafusion.datasets.readers.log_meta import Meta
from terrafusion.datasets.readers.timed_tables import TimedTable, read_timed

MAX_T_S = 1e9
"""A |t_s| beyond this (32 years) is a Unix time, not seconds from the start."""


@dataclass(frozen=True)
class ChannelColumns:
    """Columns that the table of a channel may have, beside `t_s`.

    Attributes:
        numbers, texts: names of numeric columns and of texts.
        prefixes: numeric columns that start with one of these are known, too.
        required: those that must be there.
    """

    numbers: tuple[str, ...]
    texts: tuple[str, ...] = ()
    prefixes: tuple[str, ...] = ()
    required: tuple[str, ...] = ()


def read_table(path: Path, known: ChannelColumns) -> TimedTable:
    """Read one channel's `.csv` or `.csv.gz`, which must have a column `t_s`.

    Raises:
        DataError: unreadable or empty file, unknown or repeated column, a cell that is not a
            finite number, a line with too few or too many cells, a time that is missing or looks like Unix
            time. The message names file, column, line and time. Times are not checked for order.
    """
    with errors_of(path):
        data = read_text(path)
        header = _header(data, known)
        layout = TextLayout(tuple(header), ",", 2, time="t_s", strict=True)
        words = [name for name in header if name in known.texts]
        numbers = [name for name in header if name not in (*words, "t_s")]
        table = read_timed(path, data, layout, numbers, words)
        far = np.flatnonzero(np.abs(table.t_ns) > int(MAX_T_S) * 10**9)
        if far.size:
            what = f"t_s is {table.t_ns[far[0]] * 1e-9:.9g}, which looks like Unix time"
            raise DataError(what, remedy="t_s must be seconds from start_ns of meta.yaml")
    return table


def _header(data: bytes, known: ChannelColumns) -> list[str]:
    try:
        header = [name.strip() for name in next(csv.reader([data.split(b"\n", 1)[0].decode()]), [])]
    except csv.Error as error:
        raise not_a_table(1, error) from None
    for mark, named in ((";", "a semicolon"), ("\t", "a tab")):
        if len(header) == 1 and mark in header[0]:
            what = f"the columns are separated by {named}"
            raise DataError(what, remedy="write commas, and points in decimal numbers")
    allowed = ["t_s", *known.numbers, *known.texts]
    for name in header:
        if name in allowed or any(name.startswith(p) and name != p for p in known.prefixes):
            continue
        close = difflib.get_close_matches(name[:100], allowed, n=1)
        meant = f"did you mean '{close[0]}'? " if close else ""
        listed = ", ".join([*allowed, *(f"{p}<name>" for p in known.prefixes)])
        raise DataError(f"unknown column '{shown(name)}'", remedy=f"{meant}allowed: {listed}")
    if "t_s" not in header:
        raise DataError("column 't_s' is missing", remedy="add it: seconds from start_ns")
    return header


Layouts = tuple[tuple[tuple[str, ...], str], ...]

WHEEL_LAYOUTS: Layouts = (
    (("left", "right"), "radps"),
    (("front_left", "front_right", "rear_left", "rear_right"), "radps"),
    (("left", "right"), "mps"),
    (("front_left", "front_right", "rear_left", "rear_right"), "mps"),
    (("speed",), "mps"),
)
"""Layouts of wheels.csv: names and unit; the column is name_unit. name_rad may hold the angle."""

GYRO, ACCEL = Imu.COLUMNS.values()
CURRENTS, VOLTAGES = Motor.COLUMNS.values()
GNSS_POSITION = ("east_m", "north_m", "sigma_e_m", "sigma_n_m")
GNSS_SIGMA = ("sigma_e_m", "sigma_n_m", "sigma_u_m")
GNSS_HEIGHT = ("up_m", "sigma_u_m")
GNSS_VELOCITY = ("v_e_mps", "v_n_mps", "v_u_mps")
QUATERNION = ("qx", "qy", "qz", "qw")
TRUTH_TWIST = {"u_mps": 0, "v_mps": 1, "w_mps": 2, "p_radps": 3, "q_radps": 4, "r_radps": 5}
"""Columns of truth.csv and where they stand in `Trajectory.twist_body`."""

_POSE = ("x", "y", "z", "rx", "ry", "rz")
COVARIANCE = {f"cov_{a}_{b}": (i, j) for i, a in enumerate(_POSE) for j, b in enumerate(_POSE)}
"""Columns of truth.csv and where they stand in `Trajectory.covariance`; below the diagonal optional."""


def wheel_columns(layouts: Layouts) -> tuple[str, ...]:
    """Columns of speeds and angles of these layouts; a mean speed of both sides has no angle."""
    turning = [names for names, unit in layouts if (names, unit) != (("speed",), "mps")]
    speeds = [f"{name}_{unit}" for names, unit in layouts for name in names]
    return tuple(dict.fromkeys([*speeds, *(f"{name}_rad" for names in turning for name in names)]))


PLAIN: dict[str, type[Channel]] = {kind.name: kind for kind in (Command, Barometer, Magnetometer)}
"""Channels whose table holds all their columns, whatever else."""
STEERING = tuple(dict.fromkeys(f"{name}_rad" for names in Steering.LAYOUTS for name in names))
_WHOLE = {name: tuple(chain.from_iterable(kind.COLUMNS.values())) for name, kind in PLAIN.items()}
COLUMNS = {name: ChannelColumns(columns, required=columns) for name, columns in _WHOLE.items()} | {
    "wheels": ChannelColumns(wheel_columns(WHEEL_LAYOUTS)),
    "imu": ChannelColumns((*GYRO, *ACCEL)),
    "gnss": ChannelColumns(
        (*GNSS_POSITION, *GNSS_HEIGHT, *GNSS_VELOCITY, "sigma_v_mps"), ("fix",), required=GNSS_POSITION[:2]
    ),
    "motor": ChannelColumns((*CURRENTS, *VOLTAGES), required=CURRENTS),
    "terrain": ChannelColumns((), ("label",), ("p_",), required=("label",)),
    "steering": ChannelColumns(STEERING),
    "truth": ChannelColumns(
        ("x_m", "y_m", "z_m", *QUATERNION, *TRUTH_TWIST, *COVARIANCE), required=("x_m", "y_m")
    ),
}
"""Of the log folder, by channel."""


class ChannelReader:
    """Makes channels of tables; `notes` collects what was assumed or left out.

    `tables` are those of the channels that are there, with columns of `COLUMNS`; `rig` gives the sigmas of
    fixes that have none.
    """

    REQUIRED: ClassVar[dict[str, tuple[str, ...]]] = {name: c.required for name, c in COLUMNS.items()}

    def __init__(
        self,
        tables: Mapping[str, TimedTable],
        meta: Meta,
        layouts: Layouts = WHEEL_LAYOUTS,
        rig: Rig | None = None,
    ) -> None:
        self.tables = tables
        self.meta = meta
        self.layouts = layouts
        self.rig = rig
        self.datum = meta.datum
        self.notes: list[str] = list(meta.remarks)

    def channel(self, name: str) -> Any:
        """The channel, or the truth; None where there is no table, or none of its rows holds a value."""
        table = self._table(name)
        if table is None:
            return None
        if name not in PLAIN:
            return getattr(self, f"_{name}")(table)
        parts = PLAIN[name].COLUMNS.values()
        fields = (table.numbers[names[0]] if len(names) == 1 else table.stack(names) for names in parts)
        return PLAIN[name](self._t(table), *fields)

    def _wheels(self, table: TimedTable) -> Wheels:
        alone = [names for names, _ in self.layouts if {f"{n}_rad" for n in names} == {*table.numbers}]
        if alone:
            return self._wheels_of_angles(table, alone[0])
        names, unit = self._wheel_layout(table)
        columns = [f"{n}_rad" for n in names]
        present = [c for c in columns if c in table.numbers]
        missing = [c for c in columns if c not in table.numbers]
        if present and missing:
            raise DataError(f"column '{missing[0]}' is missing beside '{present[0]}'", remedy="add it")
        speed = table.stack([f"{n}_{unit}" for n in names])
        angle = table.stack(columns) if present else None
        if self.meta.keep_empty:
            return Wheels(self._t(table), speed, names, unit, angle)
        angle, note = unwrapped_beside_speeds(angle, names)
        self.notes += [f"wheels: {note}"] if note else []
        wheels = Wheels(self._t(table), speed, names, unit, angle)
        if not sampled_apart(wheels):
            return wheels
        self.notes.append(
            "wheels: left and right are sampled at different times; each is interpolated over its own samples"
        )
        return paired_sides(wheels)

    def _wheels_of_angles(self, table: TimedTable, names: tuple[str, ...]) -> Wheels:
        """Wheels of a table that has angles alone."""
        columns = [f"{name}_rad" for name in names]
        angle = table.stack(columns)
        held = np.isfinite(angle).all(axis=1)
        angle, note = unwrapped_alone(angle[held], names, ", ".join(columns))
        keep, speed = speeds_of(self._t(table)[held], angle)
        self.notes += [f"wheels: {note}"] if note else []
        self.notes.append("wheels: no speeds are there; they are differences of the angles")
        return Wheels(self._t(table)[held][keep], speed, names, "radps", angle[keep])

    def _wheel_layout(self, table: TimedTable) -> tuple[tuple[str, ...], str]:
        speeds = [c for c in table.numbers if not c.endswith("_rad")]
        for names, unit in self.layouts:
            if sorted(speeds) == sorted(f"{n}_{unit}" for n in names):
                stray = set(table.numbers) - set(speeds) - {f"{n}_rad" for n in names}
                if stray:
                    what = f"column '{min(stray)}' has no speed beside it"
                    raise DataError(what, remedy="remove it or add the speed")
                return names, unit
        layouts = " | ".join(", ".join(f"{n}_{unit}" for n in names) for names, unit in self.layouts)
        what = f"columns {', '.join(speeds) or '(none)'} are not a layout"
        raise DataError(what, remedy=f"give one of: {layouts}")

    def _imu(self, table: TimedTable) -> Imu:
        if not table.numbers:
            raise DataError("no column beside t_s", remedy=f"give any of {', '.join([*GYRO, *ACCEL])}")
        return Imu(self._t(table), table.stack(GYRO), table.stack(ACCEL))

    def _gnss(self, table: TimedTable) -> Gnss | None:
        has = table.numbers.__contains__
        missing = [name for name in GNSS_SIGMA[:2] if not has(name)]
        if missing and any(map(has, GNSS_SIGMA)):
            needed = f"needed: t_s, {', '.join(GNSS_POSITION)}, or no sigma at all"
            raise DataError(f"column '{missing[0]}' is missing", remedy=needed)
        if has("up_m") != has("sigma_u_m") and not missing:
            raise DataError("up_m and sigma_u_m must come together", remedy="add the missing one")
        if has("v_e_mps") != has("v_n_mps") or (has("v_u_mps") and not has("v_e_mps")):
            remedy = "give v_e_mps and v_n_mps, or no velocity column"
            raise DataError("the velocity is incomplete", remedy=remedy)
        position, fix = table.stack(("east_m", "north_m", "up_m")), self._fix(table)
        return Gnss(
            self._t(table),
            position,
            self._with_sigma(position, table.stack(GNSS_SIGMA), fix),
            fix,
            table.stack(GNSS_VELOCITY) if has("v_e_mps") else None,
            table.numbers.get("sigma_v_mps"),
        )

    def _with_sigma(self, position: Array, sigma: Array, fix: NDArray[np.uint8]) -> Array:
        """Sigmas (N, 3) where those of fixes without one are filled; zero and negative ones stay."""
        lacking = np.isnan(sigma[:, :2]).any(axis=1) & np.isfinite(position[:, :2]).all(axis=1)
        lacking &= fix > Fix.NONE
        if self.meta.keep_empty or not lacking.any():
            return sigma
        filled, notes = with_assumed_sigma(self.rig, sigma[lacking], fix[lacking], fix)
        self.notes += notes
        sigma[lacking] = filled
        return sigma

    def _fix(self, table: TimedTable) -> NDArray[np.uint8]:
        if "fix" not in table.texts:
            self.notes.append("gnss: the log has no fix class; all fixes are taken as 'single'")
            return np.full(len(table.t_ns), Fix.SINGLE, dtype=np.uint8)
        codes = {fix.name.lower(): fix for fix in Fix} | {"": Fix.SINGLE}
        words, inverse = distinct(table.texts["fix"])
        for k, word in enumerate(words):
            if word not in codes:
                row = int(np.flatnonzero(inverse == k)[0])
                remedy = f"give one of {', '.join(fix.name.lower() for fix in Fix)}"
                raise table.error(row, f"column 'fix' is '{shown(word)}'", remedy)
        unknown = int((table.texts["fix"] == "").sum())
        if unknown:
            self.notes.append(f"gnss: {unknown} rows have no fix class; taken as 'single'")
        return np.array([codes[word] for word in words], dtype=np.uint8)[inverse]

    def _motor(self, table: TimedTable) -> Motor:
        voltages = [name for name in VOLTAGES if name in table.numbers]
        if len(voltages) == 1:
            raise DataError(f"'{voltages[0]}' comes alone", remedy="give both voltages or none")
        return Motor(self._t(table), table.stack(CURRENTS), table.stack(VOLTAGES) if voltages else None)

    def _terrain(self, table: TimedTable) -> Terrain:
        return Terrain(
            self._t(table),
            table.texts["label"],
            "annotation" if self.meta.terrain_source is None else self.meta.terrain_source,
            tuple(name.removeprefix("p_") for name in table.numbers),
            table.stack(list(table.numbers)) if table.numbers else None,
        )

    def _steering(self, table: TimedTable) -> Steering:
        layouts = [tuple(f"{name}_rad" for name in names) for names in Steering.LAYOUTS]
        for names, layout in zip(Steering.LAYOUTS, layouts, strict=True):
            if sorted(table.numbers) == sorted(layout):
                return Steering(self._t(table), table.stack(layout), names)
        what = f"columns {', '.join(table.numbers) or '(none)'} are not a layout"
        raise DataError(what, remedy=f"give one of: {' | '.join(map(', '.join, layouts))}")

    def _truth(self, table: TimedTable) -> Trajectory:
        quaternion = self._quaternion(table)
        twist = None
        if any(name in table.numbers for name in TRUTH_TWIST):
            twist = np.full((len(table.t_ns), 6), np.nan)
            for name, k in TRUTH_TWIST.items():
                twist[:, k] = table.numbers.get(name, twist[:, k])
        try:
            position = table.stack(("x_m", "y_m", "z_m"))
            return Trajectory(self._t(table), position, quaternion, twist, self._covariance(table))
        except DataError as error:
            raise DataError(error.what, time_s=error.time_s, remedy=error.remedy) from None

    def _quaternion(self, table: TimedTable) -> Array | None:
        present = [name for name in QUATERNION if name in table.numbers]
        if not present:
            return None
        if len(present) < 4:
            what = f"only {', '.join(present)} of the quaternion"
            raise DataError(what, remedy="give qx, qy, qz and qw, or none")
        q = table.stack(QUATERNION)
        norm = np.linalg.norm(q, axis=1)
        off = np.flatnonzero(np.abs(norm - 1.0) > 0.01)
        if off.size:
            what = f"the quaternion has norm {norm[off[0]]:.3g}"
            raise table.error(int(off[0]), what, "give unit quaternions x, y, z, w")
        return q

    def _covariance(self, table: TimedTable) -> Array | None:
        """(N, 6, 6); what is missing below the diagonal is taken from above it."""
        present = [name for name in COVARIANCE if name in table.numbers]
        if not present:
            return None
        out = np.empty((len(table.t_ns), 6, 6))
        for name, (i, j) in COVARIANCE.items():
            if i <= j and name not in table.numbers:
                raise DataError(f"column '{name}' is missing beside '{present[0]}'", remedy="add it")
            mirrored = f"cov_{_POSE[j]}_{_POSE[i]}"
            out[:, i, j] = table.numbers[name if name in table.numbers else mirrored]
        return out

    def _t(self, table: TimedTable) -> NDArray[np.int64]:
        return table.t_ns + np.int64(self.meta.start_ns)

    def _table(self, channel: str) -> TimedTable | None:
        """The channel's rows that hold a value, or None when the table is absent or has none."""
        table = self.tables.get(channel)
        if table is None:
            return None
        self.notes.extend(table.notes)
        required = self.REQUIRED[channel]
        missing = [name for name in required if name not in table.numbers and name not in table.texts]
        if missing:
            what = f"column '{missing[0]}' is missing"
            raise DataError(what, remedy=f"needed: t_s, {', '.join(required)}")
        return table if self.meta.keep_empty else self._with_values(channel, table)

    def _with_values(self, channel: str, table: TimedTable) -> TimedTable | None:
        held = rows_with_values(table.numbers, len(table.t_ns))
        if channel == "terrain":
            held = table.texts["label"] != ""
        empty = int(np.count_nonzero(~held))
        if empty:
            self.notes.append(f"{channel}: {empty} of {len(held)} rows hold no value and were left out")
        if not held.any() and (table.numbers or table.texts):
            self.notes.append(f"{channel}: {table.path.name} holds no sample; the channel is absent")
            return None
        return table.select(held) if empty else table


def rows_with_values(numbers: Mapping[str, Array], n: int) -> Mask:
    """Mask (n,) of the rows in which at least one of the columns (n,) is not NaN."""
    held = np.zeros(n, dtype=bool)
    for column in numbers.values():
        held |= ~np.isnan(column)
    return held
