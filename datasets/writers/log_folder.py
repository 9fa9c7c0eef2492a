"""Write a recording as a log folder; reading it back gives the same recording to the bit.

A recording as tables and keys of `meta.yaml` serves all writers. The vehicle file that a recording names is
copied beside it: the folder can be moved.
"""

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import expanded, unwritable
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import PREFIX, UNFINISHED, is_part, scratch_folder, sweep
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.wrapped_angles import unwrapped
from terrafusion.datasets.core.yaml_file import dump_yaml, read_yaml
from terrafusion.datasets.readers.channel_tables import (
    ACCEL,
    COVARIANCE,
    GYRO,
    MAX_T_S,
    QUATERNION,
    TRUTH_TWIST,
    WHEEL_LAYOUTS,
    rows_with_values,
)
from terrafusion.datasets.readers.log_folder import CHANNELS, META
from terrafusion.datasets.readers.log_meta import parse_meta

PLANAR_TWIST = ("u_mps", "v_mps", "r_radps")
NUMBERS = ("wheel_radius_m", "track_m", "drive", "wheelbase_m", "steering_ratio")

BLOCK_ROWS = 100_000
"""Rows that are turned into text at a time, which bounds the memory."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns what goes wrong while a log is written into a DataError of the path."""
    try:
        yield
    except UnicodeEncodeError as error:
        raise DataError(
            f"a text holds {error.object[error.start : error.end]!r}, which is no character",
            file=path,
            remedy="take it out of the texts of the recording",
        ) from None
    except OSError as error:
        raise unwritable(path, error) from None


@dataclass(frozen=True, eq=False)
class OutputTable:
    """The table of one channel: times (N,) int64 ns, and its columns (N,) by name, texts among them."""

    t_ns: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]

    def is_full(self) -> bool:
        """Whether there are rows, and each holds a value."""
        if "label" in self.columns:
            held = self.columns["label"].astype(object) != ""
        else:
            numbers = {name: c for name, c in self.columns.items() if c.dtype.kind == "f"}
            held = rows_with_values(numbers, len(self.t_ns))
        return len(held) > 0 and bool(held.all())


def tables_of(recording: Recording) -> dict[str, OutputTable]:
    """The table of every channel that is there, empty ones too, and of the truth.

    Raises:
        DataError: the truth holds quaternions that a reader would refuse.
    """
    tables = {}
    for name in Recording.CHANNELS:
        channel = getattr(recording, name)
        if channel is not None:
            columns = channel.columns()
            if isinstance(channel, Imu) and not columns:  # a table needs columns
                both = np.hstack([channel.gyro_radps, channel.accel_mps2])
                columns = dict(zip((*GYRO, *ACCEL), both.T, strict=True))
            tables[name] = OutputTable(channel.t_ns, columns)
    if recording.truth is not None:
        q = recording.truth.quaternion
        if q is not None and (np.abs(np.linalg.norm(q, axis=1) - 1.0) > 0.01).any():
            raise DataError("quaternions are not of norm 1", channel="truth", remedy="normalise them")
        tables["truth"] = OutputTable(recording.truth.t_ns, truth_columns(recording.truth))
    return tables


def truth_columns(truth: Trajectory) -> dict[str, NDArray[Any]]:
    """Columns of truth.csv; what is not known at all has none."""
    columns: dict[str, NDArray[Any]] = {"x_m": truth.position_m[:, 0], "y_m": truth.position_m[:, 1]}
    if not np.isnan(truth.position_m[:, 2]).all():
        columns["z_m"] = truth.position_m[:, 2]
    if truth.quaternion is not None:
        columns |= {name: truth.quaternion[:, k] for k, name in enumerate(QUATERNION)}
    if truth.twist_body is not None:
        twist = {name: truth.twist_body[:, k] for name, k in TRUTH_TWIST.items()}
        columns |= {n: c for n, c in twist.items() if n in PLANAR_TWIST or not np.isnan(c).all()}
    if truth.covariance is not None:
        P = truth.covariance
        symmetric = P.tobytes() == np.ascontiguousarray(P.transpose(0, 2, 1)).tobytes()
        columns |= {n: P[:, i, j] for n, (i, j) in COVARIANCE.items() if i <= j or not symmetric}
    return columns


def meta_of(recording: Recording, file: Path, name: str) -> dict[str, Any]:
    """The keys of `meta.yaml`, checked as they will be on reading; `name` is what the log would be called.

    Raises:
        ConfigError: a value that the format does not take; the message is about `file`.
    """
    r, o = recording, recording.overrides
    source = r.terrain.source if r.terrain is not None else "annotation"
    places = {"antenna_m": o.antenna_m, "imu_m": o.imu_m, "datum": r.datum}
    meta: dict[str, Any] = {
        "name": r.name if r.name != name else None,
        "start_ns": int(r.start_ns),
        "vehicle": r.vehicle,
        "terrain": r.terrain_name or None,
        **{key: getattr(r, key) or None for key in ("description", "licence", "source")},
        **{key: getattr(o, key) for key in NUMBERS},
        **{key: place and [float(x) for x in place] for key, place in places.items()},
        "truth_channels": list(r.truth_channels) if r.truth is not None or r.truth_channels else None,
        "truth_frame": r.truth_frame if r.truth_frame != "base" else None,
        "terrain_source": source if source != "annotation" else None,
        "imu_frame_id": r.imu_frame_id or None,
        "unturned": list(r.unturned) or None,
        "notes": list(r.notes) or None,
        "clock_jumps": [
            {"channel": jump.channel, "t_ns": int(jump.t_ns), "step_s": float(jump.step_s)}
            for jump in r.clock_jumps
        ]
        or None,
    }
    meta = {key: value for key, value in meta.items() if value is not None}
    parse_meta(meta, file)
    return meta


def write_log_folder(recording: Recording, folder: Path | str) -> Path:
    """Write `meta.yaml` and one CSV a channel into `folder`, which is made where needed.

    Values keep all their bits, times their nanoseconds; NaN becomes an empty cell. A vehicle file that the
    recording names is copied into the folder, as `vehicle.yaml`. A log folder that is already there is
    replaced. The log is written beside its place and moved there when it is whole: a writer that fails or
    is stopped leaves no folder that could be taken for a log.

    Raises:
        DataError: `folder` is a file, or holds other things than a log; or the recording holds what
            the format has no place for: wheels of another layout, an infinite value, a time more
            than 1e9 s from its start. ConfigError: a text, position or datum out of its range.
    """
    folder = Path(folder)
    tables = tables_of(recording)
    if not any(len(table.t_ns) for table in tables.values()):
        raise DataError("the recording holds no sample", file=folder, remedy="write one that does")
    _check_wheels(recording.wheels, folder)
    for name, table in tables.items():
        _check_table(table, recording.start_ns, folder, name)
    vehicle = vehicle_file(recording.vehicle)
    described = recording if vehicle is None else dataclasses.replace(recording, vehicle=COPY)
    meta = meta_of(described, folder / META, folder.resolve().name)
    meta = finite(recording.metadata) | meta
    if _is_mended(recording) or not all(table.is_full() for table in tables.values()):
        meta["keep_empty"] = True
    text = _meta_text(meta, folder)
    _check_room(folder)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside = folder if folder.is_dir() else folder.parent
        sweep(folder.parent, PREFIX)
        with scratch_folder(beside) as scratch:
            whole = scratch / "log"
            whole.mkdir()
            for name, table in tables.items():
                _write_table(whole / f"{name}.csv", recording.start_ns, table)
            if vehicle is not None:
                copy_vehicle(vehicle, whole)
            (whole / META).write_text(text, encoding="utf-8", newline="\n")
            _put_in_place(whole, folder)
    return folder


def _is_mended(recording: Recording) -> bool:
    """Whether the reader would fill sigmas that are missing, or count the turns of angles that do not."""
    gnss, wheels = recording.gnss, recording.wheels
    if gnss is not None and np.isnan(gnss.sigma_enu_m[:, :2]).any():
        return True
    return wheels is not None and unwrapped(wheels.angle_rad, wheels.names)[1] != ""


def _check_room(folder: Path) -> None:
    """Refuse a place that holds something other than a log."""
    with writing(folder):
        if folder.exists() and not folder.is_dir():
            raise DataError("is a file", file=folder, remedy="give a folder to write the log into")
        found = folder.iterdir() if folder.is_dir() else ()
        if not all(is_part(path.name) for path in found) and not (folder / META).is_file():
            raise DataError(
                "the folder is not empty and holds no log", file=folder, remedy="give an empty or new folder"
            )


def _put_in_place(whole: Path, folder: Path) -> None:
    """Move a written log to its place. `meta.yaml` goes first and comes last: without it nothing is a log."""
    if not folder.exists():
        whole.rename(folder)
        return
    (whole.parent / META).write_text(f"{UNFINISHED}: true  # by terrafusion\n", encoding="utf-8")
    os.replace(whole.parent / META, folder / META)
    for name in CHANNELS:
        (folder / f"{name}.csv").unlink(missing_ok=True)
        (folder / f"{name}.csv.gz").unlink(missing_ok=True)
    for path in sorted(whole.iterdir(), key=lambda path: path.name == META):
        os.replace(path, folder / path.name)


def _check_wheels(wheels: Wheels | None, folder: Path) -> None:
    if wheels is None:
        return
    known = (wheels.names, wheels.unit) in WHEEL_LAYOUTS
    if not known or (wheels.angle_rad is not None and wheels.names == ("speed",)):
        what = "wheels" if not known else "an angle of wheels"
        raise DataError(
            f"the format has no columns for {what} {', '.join(wheels.names)} in {wheels.unit}",
            file=folder,
            channel="wheels",
            remedy="give left and right, or four wheels in rad/s",
        )


def _check_table(table: OutputTable, start_ns: int, folder: Path, channel: str) -> None:
    """Refuse what the reader would refuse."""
    for name, column in table.columns.items():
        if column.dtype.kind == "f":
            what = f"{name} holds infinite values" if np.isinf(column).any() else ""
        else:
            zero = any("\0" in str(text) for text in set(column.tolist()))
            what = f"a {name} holds a zero byte" if zero else ""
        if what:
            raise DataError(what, file=folder, channel=channel, remedy="mark what is unknown by NaN or ''")
        if not name.isprintable() or name != name.strip() or name == "p_":
            raise DataError(f"'{name}' cannot be a column", file=folder, channel=channel, remedy="rename it")
    ends = [int(table.t_ns[0]), int(table.t_ns[-1])] if len(table.t_ns) else []
    far = [t for t in ends if abs(t - int(start_ns)) > int(MAX_T_S) * 10**9]
    if far:
        raise DataError(
            f"time {far[0]} ns is {abs(far[0] - int(start_ns)) / 1e9:.3g} s from start_ns",
            file=folder,
            channel=channel,
            remedy=f"bring all channels onto one clock, within {MAX_T_S:g} s of start_ns; a file without "
            "calendar times begins in 1970",
        )


def _write_table(path: Path, start_ns: int, table: OutputTable) -> None:
    """By blocks of rows, twice as fast as pandas, which leaves a carriage return in a text unquoted."""
    with path.open("w", encoding="utf-8", newline="") as out:
        out.write(",".join(["t_s", *_quoted(list(table.columns))]) + "\n")
        for first in range(0, len(table.t_ns), BLOCK_ROWS):
            rows = slice(first, first + BLOCK_ROWS)
            since_start = table.t_ns[rows] - np.int64(start_ns)
            cells = [decimal_seconds(since_start), *(_cells(c[rows]) for c in table.columns.values())]
            out.write("\n".join(map(",".join, zip(*cells, strict=True))) + "\n")


def _cells(column: NDArray[Any]) -> list[str]:
    """Shortest decimals that read back to the same double; empty for NaN."""
    if column.dtype.kind != "f":
        return _quoted([str(value) for value in column.tolist()])
    return repr(column.astype(float).tolist())[1:-1].replace("nan", "").split(", ")


def _quoted(texts: Sequence[str]) -> list[str]:
    special = set(',"\r\n')
    return [f'"{text.replace(chr(34), chr(34) * 2)}"' if special & set(text) else text for text in texts]


def decimal_seconds(t_ns: NDArray[np.int64]) -> list[str]:
    """Nanoseconds as decimal seconds with 9 decimals, exactly."""
    whole, rest = np.divmod(np.abs(t_ns), 10**9)
    signs = np.where(t_ns < 0, "-", "").tolist()
    rows = zip(signs, whole.tolist(), rest.tolist(), strict=True)
    return [f"{sign}{seconds}.{nanos:09d}" for sign, seconds, nanos in rows]


_UNPRINTABLE = re.compile("[^\t\n -~\xa0-\u2027\u202a-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")
"""Characters that YAML does not take as they are, or takes for the end of a line."""


def _meta_text(meta: dict[str, Any], folder: Path) -> str:
    """One key a line, its value in JSON, which is YAML too."""
    text = "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}" + "\n" for key, value in meta.items())
    text = _UNPRINTABLE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
    if len(text.encode()) > limits.YAML_BYTES:
        raise DataError(
            f"its texts take more than {limits.YAML_BYTES // 1024} KiB",
            file=folder / META,
            remedy="shorten the notes",
        )
    return text


COPY = "vehicle.yaml"
MOST_FILES = 10
"""So many files may extend each other; a circle is refused where the vehicle is loaded."""


def vehicle_file(vehicle: str | None) -> Path | None:
    """The absolute path of the file that a recording names as its vehicle; None for a name or no vehicle."""
    path = expanded(vehicle or "")
    return path.resolve() if path.suffix in (".yaml", ".yml") and path.is_file() else None


def copy_vehicle(file: Path, folder: Path) -> None:
    """Copy a vehicle file to `vehicle.yaml`, and each file it extends to `vehicle_2.yaml`, ...

    Raises:
        ConfigError: it is not YAML. OSError: it cannot be copied.
    """
    name = COPY
    for number in range(2, MOST_FILES + 2):
        content = read_yaml(file)
        robot = content.get("robot")
        under = robot.get("extends") if isinstance(robot, dict) else None
        below = vehicle_file(str(file.parent / expanded(under))) if isinstance(under, str) else None
        if below is None or not isinstance(robot, dict):
            shutil.copyfile(file, folder / name)
            return
        following = f"vehicle_{number}.yaml"
        dump_yaml(folder / name, {**content, "robot": {**robot, "extends": following}})
        file, name = below, following
