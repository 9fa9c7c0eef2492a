"""Calibration drives of Norlab's DRIVE as pickled DataFrames: whole drives, and windows of 2 s.

A drive (`raw_dataframe.pkl`) has one row every 50 ms with what was last received on each topic; a
window file (`slip_dataset_all.pkl`) has one row a window, 40 columns a signal.

A pickle is a program: it names functions and calls them. It is opened where its SHA-256 is in a catalogue: a
crafted pickle can crash the process. As a catalogue may come from someone else, too, a pickle gets the parts
of a DataFrame and no other function.
"""

import hashlib
import io
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.catalog.catalog import CATALOG_VARIABLE
from terrafusion.datasets.core import limits
from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Command, Imu, Motor, Terrain, Wheels
from terrafusion.datasets.core.conventions import Conventions
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.core.quantity import shown
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.formats import Request

Table = dict[str, NDArray[Any]]

SUFFIXES = (".pkl", ".pickle")
SIDES = ("left", "right")
ROBOT = "warthog"
GROUNDS = {"asphalt": "asphalt", "grass": "grass", "gravel": "gravel", "ice": "ice", "sand": "loose_sand"}
"""Ground in the folder's name -> terrain."""
WINDOW_SAMPLES, SAMPLE_NS = 40, 50_000_000
WINDOWS_A_STEP = 3
UNIT_TOLERANCE = 0.1
SIGNALS = {
    "sides": ("left_wheel_vel", "right_wheel_vel"),
    "commanded": ("cmd_left", "cmd_right"),
    "rate": ("imu_yaw",),
    "accel": ("imu_acceleration_x", "imu_acceleration_y", "imu_acceleration_z"),
    "position": ("icp_x", "icp_y", "icp_z"),
    "rpy": ("icp_roll", "icp_pitch", "icp_yaw"),
}
"""Columns of a window file, each numbered 0 to 39; `imu_yaw` is a rate despite its name."""
TRUTH_CHANNELS = ("position", "yaw", "orientation")
COMMANDING = "calib"
"""State of the calibration driver in which its command drives; otherwise a person does."""


def claims(path: Path, head: bytes) -> bool:
    """Whether it is a pickle: by its first bytes, or its name."""
    return path.is_file() and ((head[:1] == b"\x80" and b"DataFrame" in head) or path.suffix in SUFFIXES)


def read(request: Request) -> list[Recording]:
    """The drive, or all windows in their order.

    Raises:
        DataError: the file's hash is in no catalogue, it holds anything but a DataFrame, or its
            columns are not those of a drive or of windows.
    """
    path = request.path
    table = read_table(_pinned_bytes(path, request.sha256))
    try:
        with errors_of(path):
            if "ros_time" in table:
                return [_drive(path, table, request.conventions)]
            if "imu_yaw_0" in table:
                return _windows(path, table, request.conventions)
    except KeyError as error:
        raise DataError(f"column {error} is missing", remedy="give an unchanged table") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"cannot be read: {error}", remedy="give an unchanged table") from None
    raise DataError(
        "has neither the columns of a drive (ros_time) nor those of windows (imu_yaw_0)",
        remedy="give a raw_dataframe.pkl or a slip_dataset_all.pkl of the DRIVE data",
    )


def _pinned_bytes(path: Path, sha256: str) -> bytes:
    """The bytes of the file, read once: those that are hashed are those that are unpickled."""
    try:
        with path.open("rb") as file:
            data = file.read(limits.PICKLE_BYTES + 1)
            size = file.seek(0, os.SEEK_END)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}") from None
    if len(data) > limits.PICKLE_BYTES:
        most = f"give a table of up to {limits.PICKLE_BYTES >> 20} MiB"
        raise DataError(f"the pickle has {size >> 20} MiB", remedy=most)
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        raise DataError(
            f"a pickle can run code, and this one (SHA-256 {found}) is in no catalogue",
            remedy=f"if you trust its source, add it to a catalogue of your own ({CATALOG_VARIABLE})",
        )
    return data


def _drive(path: Path, table: Table, conventions: Conventions) -> Recording:
    terrain, notes = _of_folder(path.parent.name, conventions)
    stamps = table["ros_time"]
    first = next((row for row, cell in enumerate(stamps.tolist()) if float(cell) > 0.0), len(stamps))
    if first == len(stamps):
        raise DataError("no row has a time", remedy="give an unchanged table")
    if stamps.dtype.kind == "f":
        notes.append("times are stored as doubles: exact to 0.3 microseconds")
    if first:
        notes.append(f"the first {first} row{'s' * (first > 1)}, without a time, left out")
    table = {name: column[first:] for name, column in table.items()}
    t_ns = np.array([int(cell) for cell in table["ros_time"].tolist()], dtype=np.int64)
    imu = Imu(
        t_ns,
        _stack(table, "imu_x", "imu_y", "imu_z"),
        _stack(table, *(f"imu_acceleration_{axis}" for axis in "xyz")),
    )
    motor, live = _motor(t_ns, table, notes)
    speed = _stack(table, "meas_left_vel", "meas_right_vel")
    return Recording(
        name=path.parent.name,
        start_ns=int(t_ns[0]),
        command=_command_of_drive(t_ns, table, notes),
        wheels=Wheels(t_ns[live], speed[live], SIDES, "radps"),
        imu=imu.select(_since_first(imu.accel_mps2.any(axis=1), "imu", "its first message", notes)),
        motor=motor,
        terrain=Terrain.throughout(int(t_ns[0]), terrain) if terrain else None,
        terrain_name=terrain,
        truth=_truth_of_drive(t_ns, table, notes),
        truth_channels=TRUTH_CHANNELS,
        description="a whole drive, by hand and by the calibration driver",
        notes=tuple(notes),
    )


def _stack(table: Table, *names: str) -> Array:
    return np.stack([numbers(table[name]) for name in names], axis=-1)


def _since_first(known: Any, channel: str, what: str, notes: list[str]) -> slice:
    """Rows from the first true one of (N,) on: before it the log holds zeros for what it has not received."""
    first = int(np.argmax(known)) if known.any() else len(known)
    if first:
        rows = f"{first} row{'s' * (first > 1)}"
        notes.append(f"{channel}: {rows} of zeros before {what} left out")
    return slice(first, None)


def _motor(t_ns: TimesNs, table: Table, notes: list[str]) -> tuple[Motor | None, slice]:
    """The motors, and the rows from which on they, and the wheels' encoders with them, are on."""
    voltages, currents = ([f"{side}_wheel_{what}" for side in SIDES] for what in ("voltage", "current"))
    if not {*voltages, *currents} <= set(table):
        notes.append("motor: no currents and voltages in the file")
        return None, slice(None)
    voltage = _stack(table, *voltages)
    on = (voltage != 0.0).all(axis=1)
    if not on.any():
        notes.append("motor: the voltages are zero throughout; left out")
        return None, slice(None)
    live = _since_first(on, "wheels, motor", "the motors were on", notes)
    return Motor(t_ns[live], _stack(table, *currents)[live], voltage[live]), live


def _command_of_drive(t_ns: TimesNs, table: Table, notes: list[str]) -> Command | None:
    state = table.get("calib_state")
    driving = np.ones(len(t_ns), dtype=bool) if state is None else state == COMMANDING
    if not driving.any():
        notes.append("command: none, a person drove all the time")
        return None
    when = (
        "at all times, as far as the file shows" if state is None else f"in {driving.mean():.0%} of the rows"
    )
    notes.append(f"command: the calibration driver's, {when}; what a person commanded is not in the log")
    twist = _stack(table, "cmd_vel_x", "cmd_vel_omega")[driving]
    return Command(t_ns[driving], twist[:, 0], twist[:, 1])


def _truth_of_drive(t_ns: TimesNs, table: Table, notes: list[str]) -> Trajectory:
    position = _stack(table, "icp_pos_x", "icp_pos_y", "icp_pos_z")
    quaternion = _stack(table, "icp_quat_x", "icp_quat_y", "icp_quat_z", "icp_quat_w")
    placed = position.any(axis=1) | quaternion[:, :3].any(axis=1)
    rows = _since_first(placed, "truth", "the first pose in the map", notes)
    truth = Trajectory(t_ns[rows], position[rows], quaternion[rows])
    turned = np.abs(np.linalg.norm(quaternion[rows], axis=1) - 1.0) < UNIT_TOLERANCE
    if not turned.all():
        notes.append(f"truth: {int((~turned).sum())} poses without a unit quaternion left out")
    return truth.select(turned)


def _windows(path: Path, table: Table, conventions: Conventions) -> list[Recording]:
    terrain, notes = _of_folder(path.parent.name, conventions)
    signals = {name: _signals(table, *columns) for name, columns in SIGNALS.items()}
    notes.append("windows have no absolute time: it counts from the start of the command step")
    notes.extend(_against_the_wheels(signals, conventions))
    begins = numbers(table["transitory_state_mask"]) == 1.0
    if not len(begins):
        raise DataError("holds no windows", remedy="give an unchanged table")
    recordings = []
    for k, begin in enumerate(begins.tolist()):
        part = _part_of_step(begins[: k + 1])
        t_ns = (part * WINDOW_SAMPLES + np.arange(WINDOW_SAMPLES, dtype=np.int64)) * SAMPLE_NS
        window = {name: signal[k] for name, signal in signals.items()}
        gyro = np.pad(window["rate"], ((0, 0), (2, 0)), constant_values=np.nan)
        step, state = int(begins[: k + 1].sum()), "the command just changed" if begin else "steady command"
        recordings.append(
            Recording(
                name=f"{path.parent.name}#{k}",
                start_ns=int(t_ns[0]),
                command=_command_of_window(t_ns, window["commanded"], conventions),
                wheels=Wheels(t_ns, window["sides"], SIDES, "radps"),
                imu=Imu(t_ns, gyro, window["accel"]),
                terrain=Terrain.throughout(0, terrain) if terrain else None,
                terrain_name=terrain,
                truth=Trajectory(t_ns, window["position"], rpy_to_quaternion(window["rpy"])),
                truth_channels=TRUTH_CHANNELS,
                description=f"step {step}, window {part + 1} of {WINDOWS_A_STEP}, {state}; "
                "the truth starts at its own origin",
                notes=tuple(notes),
            )
        )
    return recordings


def _signals(table: Table, *names: str) -> Array:
    """The 40 samples of some signals in every window, (windows, 40, signals)."""
    columns = [_stack(table, *(f"{name}_{i}" for i in range(WINDOW_SAMPLES))) for name in names]
    return np.stack(columns, axis=-1)


def _part_of_step(begins: Mask) -> int:
    """Windows since the command changed; a log that begins inside a step counts from its start."""
    before = np.flatnonzero(begins)
    return min(len(begins) - 1 - int(before[-1]) if before.size else len(begins) - 1, WINDOWS_A_STEP - 1)


def _command_of_window(t_ns: TimesNs, sides: Array, conventions: Conventions) -> Command | None:
    """The commanded wheel rates (40, 2) as a twist, by the geometry that the robot's own driver uses."""
    radius, track = conventions.wheel_radius_m, conventions.track_m
    if radius is None or track is None:
        return None
    left, right = sides.T * radius
    return Command(t_ns, (left + right) / 2.0, (right - left) / track)


def _against_the_wheels(signals: dict[str, Array], conventions: Conventions) -> list[str]:
    """A note where the yaw rate turns against the wheels: 2 s are too short to see it in one window."""
    left, right = signals["sides"].mean(axis=1).T
    turn, rate = right - left, conventions.gyro_z_sign * signals["rate"][:, :, 0].mean(axis=1)
    if len(turn) < 8 or not turn.std() > 0.0 or not rate.std() > 0.0:
        return []
    r = float(np.corrcoef(turn, rate)[0, 1])
    if r > -0.5:
        return []
    return [
        f"imu: over the {len(turn)} windows the yaw rate turns against the wheels (r {r:.2f}): "
        "its sign is wrong in this file"
    ]


def _of_folder(name: str, conventions: Conventions) -> tuple[str, list[str]]:
    """Terrain by the folder's name, "" where the catalogue has it or the name has none; and notes."""
    words, notes = name.split("_"), []
    if words[0] != ROBOT and len(words) > 3:
        notes.append(f"the folder's name does not begin with {ROBOT}: the geometry may be another robot's")
    terrain = next((GROUNDS[word] for word in words if word in GROUNDS), "")
    if conventions.terrain or not terrain:
        return "", notes
    return terrain, [*notes, f"terrain: {terrain} by the folder's name"]


ALLOWED = {
    f"{module}.{name}"
    for modules, names in {
        "pandas pandas.core.frame": "DataFrame",
        "pandas.core.internals pandas.core.internals.managers": "BlockManager",
        "pandas.core.internals.blocks": "new_block",
        "pandas._libs.internals": "_unpickle_block",
        "pandas.core.indexes.base": "_new_Index",
        "pandas pandas.core.indexes.base": "Index",
        "pandas pandas.core.indexes.range": "RangeIndex",
        "pandas.core.indexes.numeric": "Int64Index",
        "pandas.arrays pandas.core.arrays.string_": "StringArray",
        "pandas.arrays pandas.core.arrays.string_arrow": "ArrowStringArray",
        "pandas pandas.core.arrays.string_": "StringDtype",
        "pandas._libs.arrays": "__pyx_unpickle_NDArrayBacked",
        "pyarrow.lib": "_restore_array py_buffer type_for_alias chunked_array",
        "numpy": "dtype ndarray",
        "numpy.core.numeric numpy._core.numeric": "_frombuffer",
        "numpy.core.multiarray numpy._core.multiarray": "_reconstruct scalar",
        "functools": "partial",
        "builtins": "bytearray slice",
    }.items()
    for module in modules.split()
    for name in names.split()
}
"""What pandas of any version pickles a DataFrame of numbers and texts with."""


def read_table(data: bytes) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a pickled DataFrame by name: numbers, or objects that are texts or numbers.

    Raises:
        DataError: the pickle asks for anything but a DataFrame, or is cut off or garbled.
    """
    import pandas as pd
    from pandas.compat.pickle_compat import Unpickler  # type: ignore[import-not-found]

    class Frames(Unpickler):
        """The reader behind `pd.read_pickle`, which takes frames of older versions of pandas, too."""

        def find_class(self, module: str, name: str) -> Any:
            if f"{module}.{name}" not in ALLOWED:
                raise DataError(
                    f"the pickle asks for {shown(f'{module}.{name}')}, which no table needs",
                    remedy="do not trust this file",
                )
            return super().find_class(module, name)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of modules that have moved
            frame = Frames(io.BytesIO(data)).load()
        if not isinstance(frame, pd.DataFrame):
            raise DataError("the pickle holds no DataFrame", remedy="pickle a pandas DataFrame")
        if not frame.columns.is_unique or not all(isinstance(name, str) for name in frame.columns):
            raise ValueError("columns without names of their own")
        return {
            str(name): np.asarray(column.to_numpy(None if isinstance(column.dtype, np.dtype) else object))
            for name, column in frame.items()
        }
    except DataError:
        raise
    except Exception as error:  # of unknown origin: whatever the parser raises
        why = f": {shown(str(error))}" if str(error) else ""
        raise DataError(
            f"the pickle cannot be read{why}", remedy="copy it again; it holds no plain DataFrame"
        ) from None


def numbers(column: NDArray[Any]) -> NDArray[np.float64]:
    """A column (N,) of numbers, or of texts that are numbers; an empty text or None is NaN.

    Raises:
        ValueError: a cell is something else, or beyond `limits.LARGEST`.
    """
    if column.dtype == object:
        cells = [np.nan if cell is None or cell == "" else cell for cell in column.tolist()]
        if not all(isinstance(cell, str | float | int) for cell in cells):
            raise ValueError("a cell is no number")
        values = np.array([float(cell) for cell in cells])
    else:
        values = column.astype(float)
        values[np.isnan(values)] = np.nan  # a signalling NaN, which only broken files have, warns when used
    if (np.abs(values) > limits.LARGEST).any():
        raise ValueError(f"a number beyond {limits.LARGEST:g}")
    return values
