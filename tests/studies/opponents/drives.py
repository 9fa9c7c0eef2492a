"""Drives on which outages are scored: field logs with fixes, and with fixes made from their truth.

A name is a recording of the catalogue or a path; `NAME@rtk` and `NAME@consumer` ask for made fixes, which a
log with truth and without GNSS gets in both kinds by default.
"""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.readers import open_recordings
from terrafusion.fusion.benchmark.field_logs import reference_of
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.library import is_named
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.field_runs import catalogued, read_runs

Array = NDArray[np.float64]

LEAST_FIXES = 10


@dataclass(frozen=True)
class Receiver:
    """Fixes made from truth: rate, white and slowly varying noise, reported sigma (m) and fix class.

    The slow part is a Gauss-Markov process with `slow_s` as time constant, as multipath and atmosphere are.
    """

    rate_hz: float
    white_m: float
    slow_m: float
    slow_s: float
    sigma_m: float
    fix: Fix


RECEIVERS = {
    "rtk": Receiver(5.0, 0.015, 0.0, 1.0, 0.02, Fix.FIXED),
    "consumer": Receiver(1.0, 0.4, 1.2, 60.0, 1.5, Fix.SINGLE),
}
"""Assumed: orders of magnitude of data sheets of RTK receivers and of single-point receivers in the open."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive with fixes: `log` groups the runs of one file; `fixes` is "log", "rtk" or "consumer"."""

    log: str
    fixes: str
    recording: Recording

    @property
    def name(self) -> str:
        """Log and kind of fixes."""
        return self.log if self.fixes == "log" else f"{self.log}@{self.fixes}"

    @property
    def set_name(self) -> str:
        """The set: robots, grounds and receivers of one set are alike."""
        return self.log.partition("/")[0]


def default_logs() -> list[str]:
    """Recordings of the catalogue at hand that have wheels, IMU and a reference."""
    names = []
    for name in catalogued():
        try:
            runs, _ = read_runs(name)
        except DataError:
            continue
        if any(usable(run) for run in runs):
            names.append(name)
    return names


def usable(recording: Recording) -> bool:
    """Whether a recording has what all estimators need, and fixes or a truth."""
    imu, wheels = recording.imu, recording.wheels
    if imu is None or wheels is None or not np.isfinite(imu.gyro_radps[:, 2]).any():
        return False
    if recording.gnss is not None:
        return len(recording.gnss) >= LEAST_FIXES
    return reference_of(recording) == "truth"


@functools.lru_cache(maxsize=64)
def drives_of(name: str) -> tuple[Drive, ...]:
    """The drives of a log, each with fixes.

    Raises:
        DataError: no run of the log can be scored.
    """
    name, _, wanted = name.partition("@")
    path = Path(name)
    if path.exists():
        runs, label = open_recordings(name), f"{path.resolve().parent.name}/{path.stem}"
    else:
        runs, label = read_runs(name)[0], name
    drives = [drive for run in runs if usable(run) for drive in _with_fixes(label, run, wanted)]
    if not drives:
        raise DataError("has no wheels, yaw rate and reference", file=name, remedy="choose another log")
    return tuple(drives)


def _with_fixes(log: str, run: Recording, wanted: str) -> list[Drive]:
    if run.gnss is not None and not wanted:
        return [Drive(log, "log", run)]
    return [Drive(log, kind, made(run, kind)) for kind in ([wanted] if wanted else RECEIVERS)]


def made(recording: Recording, kind: str) -> Recording:
    """The recording with fixes made from its truth; the same noise whenever it is made again.

    The antenna of a truth of the body is at the body's origin.

    Raises:
        DataError: no position in the truth, or no such receiver.
    """
    truth, receiver = recording.truth, RECEIVERS.get(kind)
    if receiver is None:
        raise DataError(f"'{kind}' is no receiver", remedy=f"choose from {', '.join(RECEIVERS)}")
    if truth is None or reference_of(recording) != "truth":
        raise DataError("has no true position to make fixes from", file=recording.name)
    known = np.flatnonzero(np.isfinite(truth.position_m[:, :2]).all(axis=1))
    slot = ((truth.t_ns[known] - truth.t_ns[known[0]]) * 1e-9 * receiver.rate_hz + 1e-6).astype(np.int64)
    rows = known[np.unique(slot, return_index=True)[1]]
    rng = np.random.default_rng(zlib.crc32(f"{recording.name} {kind}".encode()))
    noise = receiver.white_m * rng.normal(size=(len(rows), 3))
    noise += _slow(rng, truth.t_ns[rows].astype(np.float64) * 1e-9, receiver)
    scale = np.array([1.0, 1.0, 2.0])
    fixes = Gnss(
        truth.t_ns[rows],
        truth.position_m[rows] + scale * noise,
        np.tile(receiver.sigma_m * scale, (len(rows), 1)),
        np.full(len(rows), receiver.fix, dtype=np.uint8),
    )
    overrides = recording.overrides
    if recording.truth_frame == "base":
        overrides = dataclasses.replace(overrides, antenna_m=(0.0, 0.0, 0.0))
    return dataclasses.replace(recording, gnss=fixes, overrides=overrides)


def _slow(rng: np.random.Generator, t_s: Array, receiver: Receiver) -> Array:
    """Gauss-Markov noise (N, 3) at times (N,)."""
    out = np.zeros((len(t_s), 3))
    if receiver.slow_m == 0.0:
        return out
    out[0] = receiver.slow_m * rng.normal(size=3)
    for i, dt in enumerate(np.diff(t_s), start=1):
        keep = float(np.exp(-dt / receiver.slow_s))
        out[i] = keep * out[i - 1] + receiver.slow_m * np.sqrt(1.0 - keep**2) * rng.normal(size=3)
    return out


def as_unknown(recording: Recording) -> Recording:
    """The recording of a robot without a vehicle file: wheel radius and track are all that is known of it."""
    rig, name = vehicle_of(recording, None).rig(), recording.vehicle
    named = name is not None and is_named("vehicles", name)
    track = rig.track_m if named else recording.overrides.track_m
    known = Overrides(wheel_radius_m=rig.wheel_radius_m, track_m=track)
    return dataclasses.replace(recording, vehicle=None, overrides=known)


def vehicle_of(recording: Recording, vehicle: str | None) -> VehicleParams:
    """The vehicle asked for, else that of the log."""
    return choose_vehicle(recording, vehicle)[0]


def longest(drives: Sequence[Drive], most: int) -> list[Drive]:
    """At most `most` drives of each log and kind of fixes, the longest ones, in their order."""
    kept = []
    for name in dict.fromkeys(drive.name for drive in drives):
        mine = [drive for drive in drives if drive.name == name]
        chosen = sorted(mine, key=lambda d: -d.recording.duration_s())[:most]
        kept += [drive for drive in mine if any(drive is c for c in chosen)]
    return kept


def all_drives(names: Sequence[str]) -> list[Drive]:
    """Drives of many logs."""
    return [drive for name in names for drive in drives_of(name)]
