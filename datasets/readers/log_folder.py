"""The log folder: `meta.yaml` and one CSV a channel (the format is stated in docs/conventions.md).

An absent file is an absent channel, an empty cell a missing value. Anything
else that is not a number is an error: this reader never guesses.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import DataError
from terrafusion.datasets.readers.csv_table import Table, read_table
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_meta import Meta, read_meta
from terrafusion.datasets.recording import Command, Fix, Gnss, Imu, Motor, Recording, Terrain, Wheels
from terrafusion.datasets.trajectory import Trajectory

META = "meta.yaml"
CHANNELS = ("command", "wheels", "imu", "gnss", "motor", "terrain", "truth")

WHEEL_LAYOUTS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("left", "right"), "radps"),
    (("front_left", "front_right", "rear_left", "rear_right"), "radps"),
    (("left", "right"), "mps"),
    (("speed",), "mps"),
)
"""Layouts of wheels.csv: names and unit; the column is name_unit. name_rad may hold the angle."""

GYRO = ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps")
ACCEL = ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2")
GNSS_POSITION = ("east_m", "north_m", "sigma_e_m", "sigma_n_m")
GNSS_HEIGHT = ("up_m", "sigma_u_m")
GNSS_VELOCITY = ("v_e_mps", "v_n_mps", "v_u_mps")
QUATERNION = ("qx", "qy", "qz", "qw")
TRUTH_TWIST = {"u_mps": 0, "v_mps": 1, "r_radps": 5}
"""Columns of truth.csv and where they stand in `Trajectory.twist_body`."""


def claims(path: Path, head: bytes) -> bool:
    """Whether `path` is a log folder: any folder that is not a ROS 2 bag."""
    return path.is_dir() and ((path / META).is_file() or not (path / "metadata.yaml").is_file())


def read(request: Request) -> list[Recording]:
    """The one recording of a log folder."""
    return [read_log_folder(request.path)]


def read_log_folder(folder: Path) -> Recording:
    """Read a log folder.

    Returns:
        Recording named after the folder, times in ns from `start_ns`; its notes tell what was
        left out or assumed.

    Raises:
        ConfigError: meta.yaml is wrong. DataError: meta.yaml is missing or a CSV is wrong; the
            message names file, column, line or time, and the remedy.
    """
    meta_path = folder / META
    if not meta_path.is_file():
        bags = sorted(p.name for p in folder.iterdir() if p.suffix in (".bag", ".mcap", ".db3"))
        remedy = "give a log folder, a ROS bag, or write meta.yaml with start_ns and vehicle"
        if bags:
            remedy = f"give the bag itself: {', '.join(bags[:5])}{' ...' if len(bags) > 5 else ''}"
        raise DataError("no meta.yaml in this folder", file=folder, remedy=remedy)
    meta = read_meta(meta_path)
    reader = _FolderReader(folder, meta)
    command, wheels, imu = reader.command(), reader.wheels(), reader.imu()
    gnss, motor, terrain, truth = reader.gnss(), reader.motor(), reader.terrain(), reader.truth()
    if not any((command, wheels, imu, gnss, motor, terrain, truth)):
        names = ", ".join(f"{name}.csv" for name in CHANNELS)
        raise DataError("no channel holds a sample", file=folder, remedy=f"add at least one of {names}")
    reader.note_strangers()
    return Recording(
        name=folder.resolve().name,
        start_ns=meta.start_ns,
        vehicle=meta.texts.get("vehicle"),
        command=command,
        wheels=wheels,
        imu=imu,
        gnss=gnss,
        motor=motor,
        terrain=terrain,
        truth=truth,
        datum=meta.datum,
        truth_channels=_truth_channels(meta, truth),
        truth_frame=meta.truth_frame,
        overrides=meta.overrides,
        description=meta.texts.get("description", ""),
        terrain_name=meta.texts.get("terrain", ""),
        licence=meta.texts.get("licence", ""),
        source=meta.texts.get("source", ""),
        notes=tuple(reader.notes),
    )


class _FolderReader:
    """Reads the channels of one folder and gathers what is to be noted."""

    def __init__(self, folder: Path, meta: Meta) -> None:
        self.folder = folder
        self.meta = meta
        self.notes: list[str] = list(meta.notes)

    def command(self) -> Command | None:
        names = ("v_mps", "yaw_rate_radps")
        table = self._table("command", names, required=names)
        if table is None:
            return None
        return Command(self._t(table), table.numbers["v_mps"], table.numbers["yaw_rate_radps"])

    def wheels(self) -> Wheels | None:
        known = dict.fromkeys(f"{n}_{unit}" for names, unit in WHEEL_LAYOUTS for n in names)
        angles = dict.fromkeys(f"{n}_rad" for names, _ in WHEEL_LAYOUTS for n in names if n != "speed")
        table = self._table("wheels", [*known, *angles])
        if table is None:
            return None
        names, unit = self._wheel_layout(table)
        columns = [f"{n}_rad" for n in names]
        present = [c for c in columns if c in table.numbers]
        if present and len(present) < len(columns):
            lacking = next(c for c in columns if c not in present)
            raise self._error("wheels", f"column '{lacking}' is missing beside '{present[0]}'", "add it")
        speed = table.stack([f"{n}_{unit}" for n in names])
        return Wheels(self._t(table), speed, names, unit, table.stack(columns) if present else None)

    def _wheel_layout(self, table: Table) -> tuple[tuple[str, ...], str]:
        speeds = [c for c in table.numbers if not c.endswith("_rad")]
        for names, unit in WHEEL_LAYOUTS:
            if sorted(speeds) == sorted(f"{n}_{unit}" for n in names):
                angles = {c for c in table.numbers if c.endswith("_rad")}
                stray = angles - {f"{n}_rad" for n in names}
                if stray:
                    raise self._error(
                        "wheels",
                        f"column '{min(stray)}' has no speed beside it",
                        "remove it or add the speed",
                    )
                return names, unit
        layouts = " | ".join(", ".join(f"{n}_{unit}" for n in names) for names, unit in WHEEL_LAYOUTS)
        raise self._error(
            "wheels", f"columns {', '.join(speeds) or '(none)'} are not a layout", f"give one of: {layouts}"
        )

    def imu(self) -> Imu | None:
        table = self._table("imu", [*GYRO, *ACCEL])
        if table is None:
            return None
        if not table.numbers:
            raise self._error("imu", "no column beside t_s", f"give any of {', '.join([*GYRO, *ACCEL])}")
        return Imu(self._t(table), table.stack(GYRO), table.stack(ACCEL))

    def gnss(self) -> Gnss | None:
        numeric = [*GNSS_POSITION, *GNSS_HEIGHT, *GNSS_VELOCITY, "sigma_v_mps"]
        table = self._table("gnss", numeric, required=GNSS_POSITION, texts=("fix",))
        if table is None:
            return None
        has = table.numbers.__contains__
        if has("up_m") != has("sigma_u_m"):
            raise self._error("gnss", "up_m and sigma_u_m must come together", "add the missing one")
        if has("v_e_mps") != has("v_n_mps") or (
            (has("v_u_mps") or has("sigma_v_mps")) and not has("v_e_mps")
        ):
            raise self._error(
                "gnss", "the velocity is incomplete", "give v_e_mps and v_n_mps, or no velocity column"
            )
        return Gnss(
            self._t(table),
            table.stack(("east_m", "north_m", "up_m")),
            table.stack(("sigma_e_m", "sigma_n_m", "sigma_u_m")),
            self._fix(table),
            table.stack(GNSS_VELOCITY) if has("v_e_mps") else None,
            table.numbers.get("sigma_v_mps"),
        )

    def _fix(self, table: Table) -> NDArray[np.uint8]:
        if "fix" not in table.texts:
            self.notes.append("gnss: the log has no fix class; all fixes are taken as 'single'")
            return np.full(len(table.t_ns), Fix.SINGLE, dtype=np.uint8)
        codes = {fix.name.lower(): fix for fix in Fix} | {"": Fix.SINGLE}
        words, inverse = np.unique(table.texts["fix"].astype(str), return_inverse=True)
        for k, word in enumerate(words):
            if word not in codes:
                i = int(np.flatnonzero(inverse == k)[0])
                raise self._error(
                    "gnss",
                    f"column 'fix' is '{word}' at data row {i + 1}",
                    f"give one of {', '.join(fix.name.lower() for fix in Fix)}",
                    time_s=float(table.t_ns[i]) * 1e-9,
                )
        unsaid = int((table.texts["fix"] == "").sum())
        if unsaid:
            self.notes.append(f"gnss: {unsaid} rows have no fix class; taken as 'single'")
        return np.array([codes[word] for word in words], dtype=np.uint8)[inverse]

    def motor(self) -> Motor | None:
        names = ("left_a", "right_a", "left_v", "right_v")
        table = self._table("motor", names, required=names[:2])
        if table is None:
            return None
        voltages = [name for name in names[2:] if name in table.numbers]
        if len(voltages) == 1:
            raise self._error("motor", f"'{voltages[0]}' comes alone", "give both voltages or none")
        return Motor(self._t(table), table.stack(names[:2]), table.stack(names[2:]) if voltages else None)

    def terrain(self) -> Terrain | None:
        table = self._table("terrain", (), texts=("label",), prefixes=("p_",), required=("label",))
        if table is None:
            return None
        columns = sorted(table.numbers)
        return Terrain(
            self._t(table),
            table.texts["label"],
            self.meta.texts.get("terrain_source", "annotation"),
            tuple(name.removeprefix("p_") for name in table.numbers),
            table.stack(list(table.numbers)) if columns else None,
        )

    def truth(self) -> Trajectory | None:
        names = ["x_m", "y_m", "z_m", *QUATERNION, *TRUTH_TWIST]
        table = self._table("truth", names, required=("x_m", "y_m"))
        if table is None:
            return None
        quaternion = self._quaternion(table)
        twist = None
        if any(name in table.numbers for name in TRUTH_TWIST):
            twist = np.full((len(table.t_ns), 6), np.nan)
            for name, k in TRUTH_TWIST.items():
                twist[:, k] = table.numbers.get(name, twist[:, k])
        try:
            return Trajectory(self._t(table), table.stack(("x_m", "y_m", "z_m")), quaternion, twist)
        except DataError as error:
            raise self._error("truth", error.what, error.remedy or "", time_s=error.time_s) from None

    def _quaternion(self, table: Table) -> NDArray[np.float64] | None:
        present = [name for name in QUATERNION if name in table.numbers]
        if not present:
            return None
        if len(present) < 4:
            raise self._error(
                "truth", f"only {', '.join(present)} of the quaternion", "give qx, qy, qz and qw, or none"
            )
        q = table.stack(QUATERNION)
        off = np.flatnonzero(np.abs(np.linalg.norm(q, axis=1) - 1.0) > 0.01)
        if off.size:
            i = int(off[0])
            raise self._error(
                "truth",
                f"the quaternion has norm {np.linalg.norm(q[i]):.3g} at data row {i + 1}",
                "give unit quaternions x, y, z, w",
                time_s=float(table.t_ns[i]) * 1e-9,
            )
        return q

    def _t(self, table: Table) -> NDArray[np.int64]:
        return table.t_ns + np.int64(self.meta.start_ns)

    def _path(self, channel: str) -> Path | None:
        plain, packed = self.folder / f"{channel}.csv", self.folder / f"{channel}.csv.gz"
        if plain.exists() and packed.exists():
            raise DataError(
                f"both {plain.name} and {packed.name} exist", file=self.folder, remedy="keep one of them"
            )
        return plain if plain.exists() else packed if packed.exists() else None

    def _table(
        self,
        channel: str,
        known: Sequence[str],
        *,
        required: Sequence[str] = (),
        texts: Sequence[str] = (),
        prefixes: Sequence[str] = (),
    ) -> Table | None:
        """The channel's rows that hold a value, or None when the file is absent or has none."""
        path = self._path(channel)
        if path is None:
            return None
        table = read_table(path, known, texts=texts, prefixes=prefixes)
        self.notes.extend(table.notes)
        for name in required:
            if name not in table.numbers and name not in table.texts:
                raise DataError(
                    f"column '{name}' is missing", file=path, remedy=f"needed: t_s, {', '.join(required)}"
                )
        held = np.zeros(len(table.t_ns), dtype=bool)
        for column in table.numbers.values():
            held |= ~np.isnan(column)
        if channel == "terrain":
            held = table.texts["label"] != ""
        empty = int((~held).sum())
        if empty:
            self.notes.append(f"{channel}: {empty} of {len(held)} rows hold no value and were left out")
        if not held.any() and (table.numbers or table.texts):
            self.notes.append(f"{channel}: {path.name} holds no sample; the channel is absent")
            return None
        return table.select(held) if empty else table

    def _error(self, channel: str, what: str, remedy: str, *, time_s: float | None = None) -> DataError:
        return DataError(what, file=self._path(channel), time_s=time_s, remedy=remedy)

    def note_strangers(self) -> None:
        """Note CSV files that are no channel: a misspelt name would otherwise go unseen."""
        for path in sorted(self.folder.iterdir()):
            stem = path.name.removesuffix(".gz").removesuffix(".csv")
            if stem == path.name or not path.name.endswith((".csv", ".csv.gz")) or stem in CHANNELS:
                continue
            close = difflib.get_close_matches(stem, CHANNELS, n=1)
            meant = f" (did you mean {close[0]}.csv?)" if close else ""
            self.notes.append(f"{path.name} is not a channel of the format and was not read{meant}")


def _truth_channels(meta: Meta, truth: Trajectory | None) -> tuple[str, ...]:
    """What meta.yaml says the truth holds, else what its columns hold."""
    if truth is None:
        return ()
    return meta.truth_channels if meta.truth_channels is not None else truth_contents(truth)


def truth_contents(truth: Trajectory) -> tuple[str, ...]:
    """Names of what a trajectory holds: position, yaw, orientation (more than yaw), velocity."""
    found = ["position"]
    if truth.quaternion is not None:
        found.append("yaw")
        if np.nanmax(np.abs(truth.quaternion[:, :2]), initial=0.0) > 0.0:
            found.append("orientation")
    if truth.twist_body is not None and not np.isnan(truth.twist_body[:, :2]).all():
        found.append("velocity")
    return tuple(found)
