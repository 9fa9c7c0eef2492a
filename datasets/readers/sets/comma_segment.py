"""One-minute segments of comma2k19: numpy arrays without an extension, in a folder a segment.

`processed_log/*/*/t` holds seconds since the device was switched on, `value` beside it: `CAN/wheel_speed`
(front left, front right, rear left, rear right, m/s), `CAN/steering_angle` (deg at the steering wheel,
positive to the left), `IMU/gyro` and `IMU/accelerometer` (forward, right, down), `GNSS/live_gnss_ublox`
(latitude and longitude deg, speed m/s, UTC ms, altitude m, bearing deg). `global_pose/frame_*` holds the
camera's pose: ECEF positions, orientations as quaternions w, x, y, z. Any file of a segment opens all of it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Fix, Gnss, Imu, Steering, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_from_ecef, matrix_to_quaternion, quaternion_to_matrix
from terrafusion.datasets.core.gnss_time import WEEK_S, gps_to_unix_ns
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.log_folder import META, truth_contents
from terrafusion.datasets.readers.text.fixes import Datum, Fixes, gnss_channel
from terrafusion.datasets.readers.timed_tables import new_times, row_times

MAGIC = b"\x93NUMPY"
LOG, POSE = "processed_log", "global_pose"
SIGNALS = {
    "CAN/wheel_speed": (4, "wheels"),
    "CAN/steering_angle": (1, "steering"),
    "IMU/gyro": (3, "imu"),
    "IMU/accelerometer": (3, "imu"),
    "GNSS/live_gnss_ublox": (6, "gnss"),
}
"""Columns of each signal that is read, and its channel."""
FRAMES = {"frame_times": 1, "frame_gps_times": 2, "frame_positions": 3, "frame_orientations": 4}
MAX_VALUE = 1e15
MAX_BOOT_S = 1e8
FORWARD_LEFT_UP = np.diag([1.0, -1.0, -1.0])
"""Forward, right, down turned to forward, left, up."""


@dataclass(frozen=True, eq=False)
class Signal:
    """Times (N,) in ns, as read since the device was switched on, then Unix time; and values (N, k)."""

    t_ns: TimesNs
    value: Array


def claims(path: Path, head: bytes) -> bool:
    """Whether it is a folder of a segment, or one of its arrays."""
    if path.is_dir():
        return (path / LOG).is_dir() and not (path / META).exists()
    return head.startswith(MAGIC) and _segment_of(path) is not None


def companions(path: Path) -> list[Path]:
    """The arrays that are read with this one."""
    folder = _segment_of(path)
    assert folder is not None, "claimed by its place"
    names = [f"{LOG}/{name}/{part}" for name in SIGNALS for part in ("t", "value")]
    names += [f"{POSE}/{name}" for name in FRAMES]
    return [folder / name for name in names if (folder / name).is_file()]


def read(request: Request) -> list[Recording]:
    """The one recording of a segment.

    Raises:
        DataError: an array is broken, has other rows than its times, or time runs backwards.
    """
    folder = request.path if request.path.is_dir() else _segment_of(request.path)
    assert folder is not None, "claimed by its place"
    read = {name: _signal(folder / LOG / name, size) for name, (size, _) in SIGNALS.items()}
    signals = {name: signal for name, signal in read.items() if signal is not None}
    poses = {name: _array(folder / POSE / name, size) for name, size in FRAMES.items()}
    frames = {name: values for name, values in poses.items() if values is not None}
    clock_ns, notes = _unix_less_boot(signals.get("GNSS/live_gnss_ublox"), frames)
    times = {name: row_times(request, name, signal.t_ns + clock_ns) for name, signal in signals.items()}
    found = {name: Signal(t.t_ns, signals[name].value[t.order]) for name, t in times.items()}
    gnss, datum, about_fixes = _gnss(request, found.get("GNSS/live_gnss_ublox"))
    imu, about_imu = _imu({n: signal for n, signal in found.items() if SIGNALS[n][1] == "imu"})
    truth, datum = _truth(folder, frames, clock_ns, datum)
    wheels, steering = found.get("CAN/wheel_speed"), found.get("CAN/steering_angle")
    firsts = [int(one.t_ns[0]) for one in (imu, gnss, truth, wheels, steering) if one is not None]
    if not firsts:
        remedy = f"give a folder that holds {', '.join(f'{LOG}/{name}' for name in SIGNALS)}"
        raise DataError("no array of the segment is there", file=folder, remedy=remedy)
    angle = Steering(steering.t_ns, np.radians(steering.value), ("steering_wheel",)) if steering else None
    recording = Recording(
        name=folder.resolve().name,
        start_ns=min(firsts),
        imu=imu,
        gnss=gnss,
        truth=truth,
        wheels=Wheels(wheels.t_ns, wheels.value, Wheels.LAYOUTS[1], "mps") if wheels else None,
        steering=angle,
        datum=datum,
        truth_channels=truth_contents(truth),
        truth_frame="antenna",
        clock_jumps=tuple(jump for n, t in times.items() for jump in t.jumps_of([SIGNALS[n][1]])),
        notes=(*notes, *about_fixes, *about_imu, *(note for t in times.values() for note in t.notes)),
    )
    if truth is not None:
        recording = recording.with_notes("truth: pose of the camera; taken as that of the antenna beside it")
    return [recording]


def _segment_of(path: Path) -> Path | None:
    """The segment's folder of one of its arrays."""
    return next((parent.parent for parent in path.parents if parent.name in (LOG, POSE)), None)


def _array(path: Path, columns: int) -> Array | None:
    """Rows (N, columns) of an array, None where the file is absent."""
    if not path.is_file():
        return None
    try:  # mapped, so that a header cannot claim more than the file holds
        found = np.array(np.load(path, mmap_mode="r", allow_pickle=False), dtype=float)
    except Exception:  # of an unknown origin: whatever the parser of the header raises
        raise DataError("is not a whole numpy array of numbers", file=path, remedy="copy it again") from None
    found = found[:, None] if found.ndim == 1 else found
    if found.ndim != 2 or found.shape[1] != columns or not len(found):
        what = f"has the shape {found.shape}"
        raise DataError(what, file=path, remedy=f"give an array of {columns} columns, as published")
    if (np.abs(found) > MAX_VALUE).any():
        raise DataError("holds infinite or absurd values", file=path, remedy="mark unknown values by NaN")
    return found


def _signal(folder: Path, columns: int) -> Signal | None:
    t_s, value = _array(folder / "t", 1), _array(folder / "value", columns)
    return None if t_s is None or value is None else Signal(_boot_ns(folder / "t", t_s, len(value)), value)


def _boot_ns(path: Path, t_s: Array, rows: int) -> TimesNs:
    if len(t_s) != rows:
        raise DataError(f"has {len(t_s)} times for {rows} rows", file=path, remedy="copy the segment again")
    if not (np.abs(t_s) < MAX_BOOT_S).all():
        raise DataError("holds no seconds since the start of the device", file=path, remedy="copy it again")
    return np.rint(t_s[:, 0] * 1e9).astype(np.int64)


def _unix_less_boot(gnss: Signal | None, frames: dict[str, Array]) -> tuple[np.int64, list[str]]:
    """Unix time less the device's, ns: by the camera's frames, which carry both, else by the receiver."""
    if "frame_gps_times" in frames and "frame_times" in frames:
        week, of_week = frames["frame_gps_times"][0]
        if 0.0 <= week < 1e5 and 0.0 <= of_week < WEEK_S:
            gps_ns = np.array([round(week) * WEEK_S * 10**9 + round(of_week * 1e9)])
            boot_ns = np.rint(frames["frame_times"][0, 0] * 1e9).astype(np.int64)
            notes = ["times: the device's clock is set by the GPS times of the frames"]
            return gps_to_unix_ns(gps_ns)[0] - boot_ns, notes
    utc = gnss.value[:, 3] if gnss is not None else np.zeros(0)
    if gnss is not None and _is_utc_ms(utc).any():
        held = _is_utc_ms(utc)
        late = np.median(gnss.t_ns[held] - np.rint(utc[held] * 1e6).astype(np.int64))
        notes = ["times: the device's clock is set by the receiver's UTC, which comes some 0.1 s late"]
        return np.int64(-late), notes
    return np.int64(0), ["times: no UTC in the segment; they count from the start of the device"]


def _is_utc_ms(utc: Array) -> Mask:
    return np.asarray((utc > 1e11) & (utc < 4e12))


def _gnss(request: Request, signal: Signal | None) -> tuple[Gnss | None, Datum | None, list[str]]:
    """Fixes at their own UTC; speed and bearing give the velocity."""
    if signal is None:
        return None, None, []
    held = _is_utc_ms(signal.value[:, 3])
    notes = [] if held.all() else [f"gnss: {int((~held).sum())} fixes without UTC left out"]
    rows = signal.value[held]
    if not len(rows):
        return None, None, notes
    t_ns = np.rint(rows[:, 3] * 1e6).astype(np.int64)
    times = row_times(request, "gnss", t_ns)
    latitude, longitude, speed, _, altitude, bearing = rows[times.order].T
    course = np.radians(bearing)
    velocity = np.stack([speed * np.sin(course), speed * np.cos(course), np.full(len(speed), np.nan)], axis=1)
    llh = np.stack([latitude, longitude, altitude], axis=1)
    single = np.full(len(speed), Fix.SINGLE, dtype=np.uint8)
    fixes = Fixes(times.t_ns, llh, single, velocity_enu_mps=velocity)
    gnss, datum, about = gnss_channel(request.rig, fixes)
    return gnss, datum, [*notes, "gnss: times are the fixes' own UTC", *about]


def _imu(found: dict[str, Signal]) -> tuple[Imu | None, list[str]]:
    """Rates and specific forces at the rates' times."""
    if not found:
        return None, []
    t_ns = next(iter(found.values())).t_ns
    groups, notes = [], []
    for name in ("IMU/gyro", "IMU/accelerometer"):
        signal = found.get(name, Signal(t_ns, np.full((len(t_ns), 3), np.nan)))
        values = signal.value
        if not np.array_equal(signal.t_ns, t_ns):
            notes.append(f"imu: {name} has times of its own; interpolated at those of the gyro")
            own_s, wanted_s = (signal.t_ns - t_ns[0]) * 1e-9, (t_ns - t_ns[0]) * 1e-9
            values = np.stack([np.interp(wanted_s, own_s, column) for column in values.T], axis=1)
        groups.append(values)
    return Imu(t_ns, groups[0], groups[1]), notes


def _truth(
    folder: Path, frames: dict[str, Array], clock_ns: np.int64, datum: Datum | None
) -> tuple[Trajectory | None, Datum | None]:
    """The camera's poses about `datum`, or about the first of them, which is then the datum."""
    if not {"frame_times", "frame_positions", "frame_orientations"} <= frames.keys():
        return None, datum
    position, orientation = frames["frame_positions"], frames["frame_orientations"]
    t_ns = _boot_ns(folder / POSE / "frame_times", frames["frame_times"], len(position)) + clock_ns
    norms = np.linalg.norm(orientation, axis=1)
    if len(orientation) != len(position) or not (np.abs(norms - 1.0) < 0.01).all():
        path = folder / POSE / "frame_orientations"
        raise DataError("are no unit quaternions", file=path, remedy="copy the segment again")
    enu, R_enu_ecef, datum = enu_from_ecef(position, datum)
    R_ecef_camera = quaternion_to_matrix(orientation[:, [1, 2, 3, 0]])
    quaternion = matrix_to_quaternion(R_enu_ecef @ R_ecef_camera @ FORWARD_LEFT_UP)
    once = new_times(t_ns)
    return Trajectory(t_ns[once], enu[once], quaternion[once]), datum
