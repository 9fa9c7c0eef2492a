"""Calibration drives of Norlab's DRIVE as pickled DataFrames: whole drives, and windows of 2 s.

A drive (`raw_dataframe.pkl`) has one row every 50 ms with what was last received on each topic; a
window file (`slip_dataset_all.pkl`) has one row a window, 40 columns a signal. A pickle is opened
where its SHA-256 is in a catalogue, and even then by `safe_pickle` only.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.catalog import CATALOG_VARIABLE, sha256_of
from terrafusion.datasets.conventions import Conventions
from terrafusion.datasets.errors import DataError, errors_of
from terrafusion.datasets.frames import rpy_to_quaternion
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.safe_pickle import numbers, read_table
from terrafusion.datasets.recording import Command, Imu, Motor, Recording, Terrain, Wheels
from terrafusion.datasets.trajectory import Trajectory

Array = NDArray[np.float64]
Table = dict[str, NDArray[Any]]

SUFFIXES = (".pkl", ".pickle")
ROBOT = "warthog"
GROUNDS = {"asphalt": "asphalt", "grass": "grass", "gravel": "gravel", "ice": "ice", "sand": "loose_sand"}
"""Ground in the folder's name -> terrain."""
WINDOW_SAMPLES, SAMPLE_NS = 40, 50_000_000
WINDOWS_A_STEP = 3
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
    if not request.trusted:
        raise DataError(
            f"a pickle can run code, and this one (SHA-256 {sha256_of(path)}) is in no catalogue",
            file=path,
            remedy=f"if you trust its source, add it to a catalogue of your own ({CATALOG_VARIABLE})",
        )
    table = read_table(path)
    try:
        with errors_of(path):
            if "ros_time" in table:
                return [_drive(path, table, request.conventions)]
            if "imu_yaw_0" in table:
                return _windows(path, table, request.conventions)
    except KeyError as error:
        raise DataError(f"column {error} is missing", file=path, remedy="give an unchanged table") from None
    except (ValueError, OverflowError) as error:
        raise DataError(f"cannot be read: {error}", file=path, remedy="give an unchanged table") from None
    raise DataError(
        "has neither the columns of a drive (ros_time) nor those of windows (imu_yaw_0)",
        file=path,
        remedy="give a raw_dataframe.pkl or a slip_dataset_all.pkl of the DRIVE data",
    )


def _drive(path: Path, table: Table, conventions: Conventions) -> Recording:
    terrain, notes = _of_folder(path.parent.name, conventions)
    t_ns = table["ros_time"]
    first = next((row for row, cell in enumerate(t_ns.tolist()) if float(cell) > 0.0), len(t_ns))
    if first == len(t_ns):
        raise DataError("no row has a time", file=path, remedy="give an unchanged table")
    if first:
        notes.append(f"the first {first} row{'s' * (first > 1)}, without a time, left out")
    table = {name: column[first:] for name, column in table.items()}
    t_ns = np.array([int(cell) for cell in table["ros_time"].tolist()], dtype=np.int64)
    imu = Imu(
        t_ns,
        _stack(table, "imu_x", "imu_y", "imu_z"),
        _stack(table, *(f"imu_acceleration_{axis}" for axis in "xyz")),
    )
    powered = _stack(table, "left_wheel_voltage", "right_wheel_voltage")
    live = _since_first(powered.any(axis=1), "wheels, motor", "the motors were on", notes)
    speed = _stack(table, "meas_left_vel", "meas_right_vel")
    current = _stack(table, "left_wheel_current", "right_wheel_current")
    return Recording(
        name=path.parent.name,
        start_ns=int(t_ns[0]),
        command=_command_of_drive(t_ns, table, notes),
        wheels=Wheels(t_ns[live], speed[live], ("left", "right"), "radps"),
        imu=imu.select(_since_first(imu.accel_mps2.any(axis=1), "imu", "its first message", notes)),
        motor=Motor(t_ns[live], current[live], powered[live]),
        terrain=_labels(int(t_ns[0]), terrain),
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


def _command_of_drive(t_ns: NDArray[np.int64], table: Table, notes: list[str]) -> Command | None:
    driving = table["calib_state"] == COMMANDING
    if not driving.any():
        notes.append("command: none, a person drove all the time")
        return None
    notes.append(
        f"command: known while the calibration driver drove ({driving.mean():.0%} of the rows); "
        "what a person commanded is not in the log"
    )
    twist = _stack(table, "cmd_vel_x", "cmd_vel_omega")[driving]
    return Command(t_ns[driving], twist[:, 0], twist[:, 1])


def _truth_of_drive(t_ns: NDArray[np.int64], table: Table, notes: list[str]) -> Trajectory:
    position = _stack(table, "icp_pos_x", "icp_pos_y", "icp_pos_z")
    quaternion = _stack(table, "icp_quat_x", "icp_quat_y", "icp_quat_z", "icp_quat_w")
    placed = position.any(axis=1) | quaternion[:, :3].any(axis=1)
    rows = _since_first(placed, "truth", "the first pose in the map", notes)
    return Trajectory(t_ns[rows], position[rows], quaternion[rows])


def _windows(path: Path, table: Table, conventions: Conventions) -> list[Recording]:
    terrain, folder_notes = _of_folder(path.parent.name, conventions)
    signals = {name: _signal(table, name) for name in ("left_wheel_vel", "right_wheel_vel", "imu_yaw")}
    notes = (
        *folder_notes,
        "windows have no absolute time: it counts from the start of the command step",
        *_against_the_wheels(signals, conventions),
    )
    accel = np.stack([_signal(table, f"imu_acceleration_{axis}") for axis in "xyz"], axis=-1)
    position = np.stack([_signal(table, f"icp_{axis}") for axis in "xyz"], axis=-1)
    rpy = np.stack([_signal(table, f"icp_{angle}") for angle in ("roll", "pitch", "yaw")], axis=-1)
    commanded = np.stack([_signal(table, "cmd_left"), _signal(table, "cmd_right")], axis=-1)
    begins = numbers(table["transitory_state_mask"]) == 1.0
    recordings = []
    for k in range(len(begins)):
        part = _part_of_step(begins, k)
        t_ns = part * WINDOW_SAMPLES * SAMPLE_NS + np.arange(WINDOW_SAMPLES, dtype=np.int64) * SAMPLE_NS
        gyro = np.full((WINDOW_SAMPLES, 3), np.nan)
        gyro[:, 2] = signals["imu_yaw"][k]
        sides = np.stack([signals["left_wheel_vel"][k], signals["right_wheel_vel"][k]], axis=-1)
        recordings.append(
            Recording(
                name=f"{path.parent.name}#{k}",
                start_ns=int(t_ns[0]),
                command=_command_of_window(t_ns, commanded[k], conventions),
                wheels=Wheels(t_ns, sides, ("left", "right"), "radps"),
                imu=Imu(t_ns, gyro, accel[k]),
                terrain=_labels(int(t_ns[0]), terrain),
                terrain_name=terrain,
                truth=Trajectory(t_ns, position[k], rpy_to_quaternion(rpy[k])),
                truth_channels=TRUTH_CHANNELS,
                description=f"step {int(begins[: k + 1].sum())}, window {part + 1} of {WINDOWS_A_STEP}, "
                f"{'the command just changed' if begins[k] else 'steady command'}; "
                "the truth starts at its own origin",
                notes=notes,
            )
        )
    return recordings


def _signal(table: Table, name: str) -> Array:
    """The 40 samples of every window, (windows, 40)."""
    return _stack(table, *(f"{name}_{i}" for i in range(WINDOW_SAMPLES)))


def _part_of_step(begins: NDArray[np.bool_], k: int) -> int:
    """Windows since the command changed; a log that begins inside a step counts from its start."""
    before = np.flatnonzero(begins[: k + 1])
    return min(k - int(before[-1]) if before.size else k, WINDOWS_A_STEP - 1)


def _command_of_window(t_ns: NDArray[np.int64], sides: Array, conventions: Conventions) -> Command | None:
    """The commanded wheel rates (40, 2) as a twist, by the geometry that the robot's own driver uses."""
    radius, track = conventions.wheel_radius_m, conventions.track_m
    if radius is None or track is None:
        return None
    left, right = sides.T * radius
    return Command(t_ns, (left + right) / 2.0, (right - left) / track)


def _against_the_wheels(signals: dict[str, Array], conventions: Conventions) -> list[str]:
    """A note where the yaw rate turns against the wheels: 2 s are too short to see it in one window."""
    turn = (signals["right_wheel_vel"] - signals["left_wheel_vel"]).mean(axis=1)
    rate = conventions.gyro_z_sign * signals["imu_yaw"].mean(axis=1)
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
    """Terrain by the folder's name, "" where the catalogue or nobody says; what to say about the name."""
    words, notes = name.split("_"), []
    if words[0] != ROBOT and len(words) > 3:
        notes.append(f"the folder's name does not begin with {ROBOT}: the geometry may be another robot's")
    terrain = next((GROUNDS[word] for word in words if word in GROUNDS), "")
    if conventions.terrain or not terrain:
        return "", notes
    return terrain, [*notes, f"terrain: {terrain} by the folder's name"]


def _labels(start_ns: int, terrain: str) -> Terrain | None:
    if not terrain:
        return None
    return Terrain(np.array([start_ns], dtype=np.int64), np.array([terrain], dtype=object))
