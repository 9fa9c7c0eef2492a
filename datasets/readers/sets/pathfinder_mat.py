"""Drives of West Virginia University's Pathfinder rover, as MATLAB v7.3 workspaces."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError, errors_of
from terrafusion.datasets.core.frames import geodetic_to_enu
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.sets.matlab_hdf5 import MatlabFile, is_hdf5, opened, variables
from terrafusion.datasets.readers.sets.pathfinder_fixes import (
    fix_class_and_sigma,
    seconds_to_ns,
    times_by_rows,
    times_in_file,
)

NEEDED = {"tTimu", "tTodom", "Ax", "Ay", "Az", "Gx", "Gy", "Gz", "frontLeftVel", "rearRightVel"}
WHEELS = ("frontLeft", "frontRight", "rearLeft", "rearRight")
NAMES = ("front_left", "front_right", "rear_left", "rear_right")
DEAD_RECKONING = ("lin_x", "lin_y", "ang_z", "Pos_x", "Pos_y", "Pos_z", "Orien_z")
LARGEST_DISAGREEMENT_M = 0.1
"""Between the file's ENU positions and those made of its latitudes; 2 cm is the ellipsoid's doing at 2 km."""


def claims(path: Path, head: bytes) -> bool:
    """Whether it is a MATLAB v7.3 file with the rover's variables, or one that cannot be opened."""
    if not is_hdf5(head) or not path.is_file():
        return False
    names = variables(path)
    return path.suffix == ".mat" if names is None else names >= NEEDED


def read(request: Request) -> list[Recording]:
    """The one drive of a workspace.

    Raises:
        DataError: the file is broken, a variable is missing, has other rows than its clock or
            claims an impossible size, or time runs backwards.
    """
    with errors_of(request.path), opened(request.path) as file:
        return [_recording(file, request)]


def _recording(file: MatlabFile, request: Request) -> Recording:
    t_imu, t_wheels = _clock(file, "tTimu"), _clock(file, "tTodom")
    wheels = Wheels(
        seconds_to_ns(t_wheels),
        _columns(file, [f"{name}Vel" for name in WHEELS], len(t_wheels), "tTodom"),
        NAMES,
        "radps",
        _columns(file, [f"{name}Pos" for name in WHEELS], len(t_wheels), "tTodom")
        if all(file.has(f"{name}Pos") for name in WHEELS)
        else None,
    )
    imu = Imu(
        seconds_to_ns(t_imu),
        _columns(file, ["Gx", "Gy", "Gz"], len(t_imu), "tTimu"),
        _columns(file, ["Ax", "Ay", "Az"], len(t_imu), "tTimu"),
    )
    recording = Recording(
        name=request.path.stem,
        start_ns=max(int(min(imu.t_ns[0], wheels.t_ns[0])), 0),  # no recording starts before 1970
        wheels=wheels,
        imu=imu,
        description="the rover's own dead reckoning is left out",
        notes=_left_out(file),
    )
    return _with_fixes(recording, file, request, t_wheels)


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


def _left_out(file: MatlabFile) -> tuple[str, ...]:
    found = [name for name in DEAD_RECKONING if file.has(name)]
    if not found:
        return ()
    return (f"{', '.join(found)}: the rover's own dead reckoning in its odom frame, no truth; left out",)


def _with_fixes(recording: Recording, file: MatlabFile, request: Request, t_wheels: Array) -> Recording:
    """The recording with the fixes, their times from the file or, failing that, by the wheels."""
    if not file.has("llhGPS") and not file.has("ENUGPS"):
        return recording
    enu_m, datum, notes = _positions(file)
    placed = times_in_file(file, len(enu_m), t_wheels)
    if placed is None:
        wheels = recording.wheels
        assert wheels is not None
        late_s = request.conventions.lag_s.get("wheels", 0.0)
        placed = times_by_rows(enu_m, t_wheels, np.abs(wheels.speed).mean(axis=1), late_s)
    t_s, how = placed
    recording = recording.with_notes(*notes, *how)
    if t_s is None:
        return recording
    fix, sigma_m, why = fix_class_and_sigma(file, enu_m)
    gnss = Gnss(seconds_to_ns(t_s), enu_m, sigma_m, np.full(len(enu_m), fix, dtype=np.uint8))
    return dataclasses.replace(recording, gnss=gnss, datum=datum).with_notes(why)


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
