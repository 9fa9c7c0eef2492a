"""Drives of West Virginia University's Pathfinder rover, as MATLAB v7.3 workspaces, which are HDF5.

Times, fix class and sigmas of the fixes come in several ways. A file may claim any shape, fill it from a few
bytes, or point to other files: whatever is larger than `limits.HDF5_VALUES`, stored elsewhere or a link is
refused before it is read.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.gnss_time import GPS_EPOCH_S, WEEK_S, gps_to_unix_ns
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request

NEEDED = {"tTimu", "tTodom", "Ax", "Ay", "Az", "Gx", "Gy", "Gz", "frontLeftVel", "rearRightVel"}
WHEELS = ("frontLeft", "frontRight", "rearLeft", "rearRight")
NAMES = ("front_left", "front_right", "rear_left", "rear_right")
DEAD_RECKONING = ("lin_x", "lin_y", "ang_z", "Pos_x", "Pos_y", "Pos_z", "Orien_z")
LARGEST_DISAGREEMENT_M = 0.1
"""Between the file's ENU positions and those made of its latitudes; 2 cm is the ellipsoid's doing at 2 km."""
UNIX_SINCE_S = 1e9
"""Times beyond this are unix seconds, smaller ones seconds of the GPS week."""
NEAR_S = 3600.0
"""Fixes of one drive with the wheels lie no farther off."""
SMOOTH_M = 0.1
"""99 % of the second differences of 10 Hz carrier-phase fixes stay below: 0.066 m; of single points 1.8 m."""
SIGMA_FIXED_M, SIGMA_SINGLE_M = (0.01, 0.01, 0.02), (2.5, 2.5, 5.0)
"""East, north, up, where the file has none: what receivers' data sheets promise."""

_CLASSES = ((Fix.FIXED, 0.05), (Fix.FLOAT, 0.5), (Fix.DGPS, 1.0), (Fix.SINGLE, np.inf))
"""Fix class by the median horizontal sigma below, m; infinite sigmas are single points."""
MAGIC = b"\x89HDF\r\n\x1a\n"
USER_BLOCK = 512
"""Bytes of text that MATLAB puts before the HDF5."""
CLASS = "MATLAB_class"
"""Attribute of each variable."""


def claims(path: Path, head: bytes) -> bool:
    """Whether it is a MATLAB v7.3 file with the rover's variables, or one that cannot be opened."""
    begins = (head, head[USER_BLOCK:])  # of the HDF5, without or with MATLAB's text before it
    if not any(begin.startswith(MAGIC) for begin in begins) or not path.is_file():
        return False
    names = variables(path)
    return path.suffix == ".mat" if names is None else names >= NEEDED


def read(request: Request) -> list[Recording]:
    """The one drive of a workspace.

    Raises:
        DataError: the file is broken, a variable is missing, has other rows than its clock or
            claims an impossible size, or time runs backwards.
    """
    with opened(request.path) as file:
        return [_recording(file, request)]


def _recording(file: MatlabFile, request: Request) -> Recording:
    t_imu, t_wheels = _clock(file, "tTimu"), _clock(file, "tTodom")
    positions = [f"{name}Pos" for name in WHEELS]
    wheels = Wheels(
        seconds_to_ns(t_wheels),
        _columns(file, [f"{name}Vel" for name in WHEELS], len(t_wheels), "tTodom"),
        NAMES,
        "radps",
        _columns(file, positions, len(t_wheels), "tTodom") if all(map(file.has, positions)) else None,
    )
    gyro, accel = (_columns(file, [f"{kind}{axis}" for axis in "xyz"], len(t_imu), "tTimu") for kind in "GA")
    imu = Imu(seconds_to_ns(t_imu), gyro, accel)
    left_out = [name for name in DEAD_RECKONING if file.has(name)]
    recording = Recording(
        name=request.path.stem,
        start_ns=max(int(min(imu.t_ns[0], wheels.t_ns[0])), 0),  # no recording starts before 1970
        wheels=wheels,
        imu=imu,
        description="the rover's own dead reckoning is left out",
    )
    if left_out:
        names = ", ".join(left_out)
        recording = recording.with_notes(
            f"{names}: the rover's own dead reckoning in its odom frame, no truth; left out"
        )
    return _with_fixes(recording, file, t_wheels)


def _clock(file: MatlabFile, name: str) -> Array:
    seconds = file.vector(name)
    if not len(seconds) or not np.isfinite(seconds).all() or np.abs(seconds).max() > 9e9:
        raise DataError("holds no times, or ones that are not unix seconds", channel=name)
    return seconds


def _columns(file: MatlabFile, names: list[str], rows: int, clock: str) -> Array:
    columns = [file.vector(name) for name in names]
    for name, column in zip(names, columns, strict=True):
        if len(column) != rows:
            raise DataError(
                f"has {len(column)} values for {rows} times in {clock}",
                channel=name,
                remedy="give the variables as they were published",
            )
    return np.stack(columns, axis=-1)


def _with_fixes(recording: Recording, file: MatlabFile, t_wheels: Array) -> Recording:
    """The recording with the fixes, where the file has their times."""
    if not file.has("llhGPS") and not file.has("ENUGPS"):
        return recording
    enu_m, datum, notes = _positions(file)
    times = times_in_file(file, len(enu_m), t_wheels)
    if times is None:
        return recording.with_notes(*notes, "gnss: no times in the file; left out")
    t_s, how = times
    fix, sigma_m, why = fix_class_and_sigma(file, enu_m)
    gnss = Gnss(seconds_to_ns(t_s), enu_m, sigma_m, np.full(len(enu_m), fix, dtype=np.uint8))
    return dataclasses.replace(recording, gnss=gnss, datum=datum).with_notes(*notes, how, why)


def _positions(file: MatlabFile) -> tuple[Array, tuple[float, float, float] | None, list[str]]:
    """ENU positions (N, 3), their datum where the file has geodetic positions too, and what differs."""
    if not file.has("llhGPS"):
        return file.rows("ENUGPS", 3), None, ["gnss: no geodetic positions, so no datum"]
    llh = file.rows("llhGPS", 3)
    if not np.abs(llh[:, 0]).max(initial=0.0) <= np.pi / 2:
        raise DataError("latitudes are not radians", channel="llhGPS", remedy="give rad, rad, m")
    geodetic = np.stack([np.degrees(llh[:, 0]), np.degrees(llh[:, 1]), llh[:, 2]], axis=-1)
    known = np.flatnonzero(np.isfinite(geodetic).all(axis=1))
    if not known.size:
        raise DataError("holds no position", channel="llhGPS")
    lat, lon, height = (float(x) for x in geodetic[known[0]])
    enu_m = geodetic_to_enu(geodetic, (lat, lon, height))
    notes = ["gnss: the datum is the first fix"]
    if file.has("ENUGPS"):
        published = file.rows("ENUGPS", 3)
        off = np.abs(published - enu_m).max() if published.shape == enu_m.shape else np.inf
        if not off <= LARGEST_DISAGREEMENT_M:
            notes.append(f"gnss: ENUGPS is up to {off:.2f} m off llhGPS about the first fix; llhGPS is taken")
    return enu_m, (lat, lon, height), notes


def seconds_to_ns(seconds: Array) -> TimesNs:
    """Unix seconds (N,) as int64 nanoseconds, to the resolution of the double."""
    whole = np.floor(seconds)
    return whole.astype(np.int64) * 10**9 + np.rint((seconds - whole) * 1e9).astype(np.int64)


def times_in_file(file: MatlabFile, rows: int, t_wheels: Array) -> tuple[Array, str] | None:
    """Unix seconds (N,) of the fixes, with how; None where the file has none."""
    for table in file.tables():
        time = table.get("time", np.zeros(0))
        if len(time) == rows > 1 and (np.diff(time) > 0.0).all() and time[0] >= 0.0 and time[-1] < WEEK_S:
            t_s = _of_week(time, float(t_wheels[0]))
            if abs(t_s[0] - t_wheels[0]) < NEAR_S:
                return t_s, _of_table(t_s, t_wheels)
    if file.has("tTGPS"):
        t_s = file.vector("tTGPS")
        if len(t_s) == rows and np.isfinite(t_s).all() and t_s.min(initial=np.inf) > UNIX_SINCE_S:
            return t_s, "gnss: times are those of receipt (tTGPS)"
    return None


def _of_table(t_s: Array, t_wheels: Array) -> str:
    """How far the rows are from those of the wheels, which they look like."""
    missing = round((t_s[-1] - t_s[0]) / float(np.median(np.diff(t_s)))) + 1 - len(t_s)
    return (
        "gnss: times are GPS seconds of the week from the file's table, leap seconds taken off; "
        f"{missing} epochs are missing, so that row i lies {t_s[0] - t_wheels[0]:+.2f} s from wheel row i "
        f"at the start and {t_s[-1] - t_wheels[min(len(t_s), len(t_wheels)) - 1]:+.2f} s at the end"
    )


def _of_week(seconds: Array, near_unix_s: float) -> Array:
    """Unix seconds of GPS seconds of the week, in the week of `near_unix_s`."""
    week = round((near_unix_s - GPS_EPOCH_S - float(seconds[0])) / WEEK_S)
    gps_ns = np.rint(seconds * 1e9).astype(np.int64) + week * WEEK_S * 10**9
    return np.asarray(gps_to_unix_ns(gps_ns), dtype=float) * 1e-9


def fix_class_and_sigma(file: MatlabFile, enu_m: Array) -> tuple[Fix, Array, str]:
    """Fix class, sigma (N, 3) east, north, up, and why."""
    names = ("LonSigma", "LatSigma", "HeightSigma")
    if all(file.has(name) for name in names):
        sigma = np.stack([file.vector(name) for name in names], axis=-1)
        if len(sigma) == len(enu_m):
            size = float(np.nanmedian(sigma[:, :2])) if np.isfinite(sigma[:, :2]).any() else np.inf
            fix = next(fix for fix, limit in _CLASSES if size < limit)
            return fix, sigma, f"gnss: taken for {fix.name.lower()} by its sigmas (median {size:.2f} m)"
    bends = np.hypot(*np.diff(enu_m[:, :2], 2, axis=0).T)
    roughness = float(np.nanpercentile(bends, 99)) if np.isfinite(bends).any() else np.inf
    fix, level = (Fix.FIXED, SIGMA_FIXED_M) if roughness < SMOOTH_M else (Fix.SINGLE, SIGMA_SINGLE_M)
    why = (
        f"gnss: no sigmas in the file; taken for {fix.name.lower()}, {level[0]:g} m horizontally and "
        f"{level[2]:g} m in height, because 99 % of the second differences stay below {roughness:.2f} m"
    )
    return fix, np.tile(level, (len(enu_m), 1)), why


def variables(path: Path) -> set[str] | None:
    """Names of the variables, or None where the file cannot be opened."""
    try:
        with _file(path) as file:
            return set(file)
    except Exception:  # of unknown origin: whatever the library raises
        return None


@contextmanager
def opened(path: Path) -> Iterator[MatlabFile]:
    """The file, open for reading; a DataError where it cannot be opened or read, here or while it is open."""
    try:
        with _file(path) as file:
            yield MatlabFile(file)
    except DataError:
        raise
    except Exception as error:
        why = str(error).rpartition("(")[2].split("\n")[0].split(",")[0].rstrip(")")[:100]
        raise DataError(f"the HDF5 cannot be read: {why}", remedy="copy it again; is it complete?") from None


def _file(path: Path) -> Any:
    import h5py

    return h5py.File(path, "r", rdcc_nbytes=0, locking=False)


class MatlabFile:
    """Variables of an open file by name."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def has(self, name: str) -> bool:
        """Whether there is a variable of that name."""
        return name in self._file

    def vector(self, name: str) -> Array:
        """A variable (N,) that is one row or one column."""
        values = self._numbers(name)
        if values.size != max(values.shape, default=0):
            raise self._wrong(name, f"has the shape {values.shape}, not one row or column")
        return values.ravel()

    def rows(self, name: str, width: int) -> Array:
        """A variable (N, width), stored in either orientation."""
        values = self._numbers(name)
        if values.ndim != 2 or width not in values.shape:
            raise self._wrong(name, f"has the shape {values.shape}, not N x {width}")
        return values if values.shape[1] == width else values.T

    def _numbers(self, name: str) -> Array:
        import h5py

        if not self.has(name):
            raise self._wrong(name, "is missing")
        link = self._file.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink) or not isinstance(self._file[name], h5py.Dataset):
            raise self._wrong(name, "is no variable of numbers")
        return self._values(self._file[name], name)

    def _values(self, data: Any, name: str) -> Array:
        """The numbers of a dataset, after its claims were checked."""
        largest = max(math.prod(data.shape or ()), math.prod(data.chunks or ()))
        if data.dtype.kind not in "fiu" or data.dtype.itemsize > 8 or data.dtype.subdtype is not None:
            raise self._wrong(name, f"holds {data.dtype}, not numbers")
        if largest > limits.HDF5_VALUES or data.external or data.is_virtual:
            raise self._wrong(name, f"claims {largest} values, or keeps them in other files")
        values = np.asarray(data[()], dtype=float)
        values[np.isnan(values)] = np.nan  # a signalling NaN, which only broken files have, warns when used
        if (np.abs(values) > limits.LARGEST).any():
            raise self._wrong(name, f"holds numbers beyond {limits.LARGEST:g}")
        return values

    def _wrong(self, name: str, what: str) -> DataError:
        return DataError(what, channel=name, remedy="give the variable as it was published")

    def tables(self) -> Iterator[dict[str, Array]]:
        """Columns (N,) by name of every MATLAB `table` of numbers in the file.

        MATLAB keeps objects in `#subsystem#/MCOS`, a list of references: a table's columns are one
        cell array there and their names another, of the same length.
        """
        cells = [cell for cell in self._cells() if len(cell) > 0]
        names = [texts for texts in map(self._texts, cells) if texts]
        for cell in cells:
            columns = self._columns(cell)
            for texts in names if columns else ():
                if len(texts) == len(columns):
                    yield dict(zip(texts, columns, strict=True))

    def _cells(self) -> Iterator[list[Any]]:
        """Every cell array of datasets among the objects' data."""
        import h5py

        for item in self._referenced(self._file.get("#subsystem#/MCOS")):
            if isinstance(item, h5py.Dataset) and item.dtype.kind == "O":
                yield [part for part in self._referenced(item) if isinstance(part, h5py.Dataset)]

    def _referenced(self, data: Any) -> list[Any]:
        import h5py

        if not isinstance(data, h5py.Dataset) or h5py.check_ref_dtype(data.dtype) is not h5py.Reference:
            return []
        if math.prod(data.shape) > limits.HDF5_REFERENCES or data.external or data.is_virtual:
            return []
        return [self._file[reference] for reference in data[()].ravel() if reference]

    def _texts(self, cell: list[Any]) -> list[str]:
        """The cell's texts, or nothing where one is no text."""
        if any(part.attrs.get(CLASS) != b"char" or math.prod(part.shape) > 100 for part in cell):
            return []
        return ["".join(map(chr, self._values(part, "a table").astype(int).ravel())) for part in cell]

    def _columns(self, cell: list[Any]) -> list[Array]:
        """The cell's numeric columns, or nothing where it is no table."""
        if any(part.attrs.get(CLASS) not in (b"double", b"single") for part in cell):
            return []
        columns = [self._values(part, "a table").ravel() for part in cell]
        return columns if len({len(column) for column in columns}) == 1 else []
