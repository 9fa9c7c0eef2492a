"""Changes of mounting, scale, clock and rate, and how a user tells the estimator of each.

A change is made in the log's channels; what the robot did, its noise and its reference stay. `told` is the
changed log with the number stated where a user can state it (geometry of the vehicle); None where no file
has a place for it, or where the log shows it itself, as a rate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.fusion.benchmark.field_logs import reference_of
from tests.studies.fault_injection.faults import (
    late_fixes,
    moved_antenna,
    scaled_left,
    scaled_wheels,
    turned_imu,
)
from tests.studies.opponents.drives import as_unknown, vehicle_of

Array = NDArray[np.float64]
Put = Callable[[Recording], Recording]

ANTENNA_M, GYRO, LATE_S, WHEELS, SIDE = 0.35, 1.03, 1.5, 0.08, 0.03
ANGLES_DEG = (20.0, 90.0, 180.0)
RATES_HZ = (10.0, 5.0, 1.0)


@dataclass(frozen=True)
class Change:
    """A change by name, and the same with the number told."""

    name: str
    put: Put
    told: Put | None = None


def antenna_moved(recording: Recording) -> Recording:
    """The antenna sits further forward; by the true heading where the log has one."""
    truth, gnss = recording.truth, recording.gnss
    if gnss is None:
        raise DataError("has no GNSS", file=recording.name)
    if truth is None or reference_of(recording) != "truth" or not _has_heading(recording):
        return moved_antenna(recording, vehicle_of(recording, None), ANTENNA_M)
    forward = Rotation.from_quat(truth.quaternion).apply([ANTENNA_M, 0.0, 0.0])
    at = np.array([np.interp(gnss.t_ns, truth.t_ns, forward[:, i]) for i in range(3)]).T
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=gnss.enu_m + at))


def _has_heading(recording: Recording) -> bool:
    listed = set(recording.truth_channels)
    return not listed or bool(listed & {"yaw", "orientation"})


def antenna_told(recording: Recording) -> Recording:
    """The changed antenna, and its place in the vehicle's geometry."""
    x, y, z = _antenna(recording)
    return _with(antenna_moved(recording), antenna_m=(x + ANTENNA_M, y, z))


def gyro_scaled(recording: Recording) -> Recording:
    """All axes of the gyro read more."""
    imu = _imu(recording)
    return dataclasses.replace(recording, imu=dataclasses.replace(imu, gyro_radps=imu.gyro_radps * GYRO))


def wheels_told(recording: Recording) -> Recording:
    """Wheels that read too much, and the smaller radius that makes up for it.

    Raises:
        DataError: the log has speeds in m/s, for which no radius is used.
    """
    if recording.wheels is None or recording.wheels.unit != "radps":
        raise DataError("has wheel speeds in m/s", file=recording.name)
    radius = vehicle_of(recording, None).rig().wheel_radius_m / (1.0 + WHEELS)
    return _with(_wheels_scaled(recording), wheel_radius_m=radius)


def _wheels_scaled(recording: Recording) -> Recording:
    return scaled_wheels(recording, vehicle_of(recording, None), WHEELS)


def track_unknown(recording: Recording) -> Recording:
    """Wheel radius and antenna alone are known."""
    known = vehicle_of(recording, None).rig()
    alone = Overrides(wheel_radius_m=known.wheel_radius_m, antenna_m=_antenna(recording))
    return dataclasses.replace(recording, vehicle=None, overrides=alone)


def track_told(recording: Recording) -> Recording:
    """Wheel radius, antenna and track are known."""
    return _with(as_unknown(recording), antenna_m=_antenna(recording))


def slower(recording: Recording, rate_hz: float) -> Recording:
    """Wheels and IMU as means over intervals, stamped at their middle; one fix of each interval is kept.

    Streams that are slower already stay as they are.
    """
    imu, wheels, gnss = _imu(recording), recording.wheels, recording.gnss
    if wheels is None or gnss is None:
        raise DataError("has no wheels or no GNSS", file=recording.name)
    step_ns = round(1e9 / rate_hz)
    if _faster(imu.t_ns, step_ns):
        t, (gyro, accel) = _means(imu.t_ns, step_ns, imu.gyro_radps, imu.accel_mps2)
        imu = Imu(t, gyro, accel)
    if _faster(wheels.t_ns, step_ns):
        t, (speed,) = _means(wheels.t_ns, step_ns, wheels.speed)
        wheels = Wheels(t, speed, wheels.names, wheels.unit)
    if _faster(gnss.t_ns, step_ns):
        slot = (gnss.t_ns - gnss.t_ns[0]) // step_ns
        gnss = gnss.select(np.unique(slot, return_index=True)[1])
    return dataclasses.replace(recording, imu=imu, wheels=wheels, gnss=gnss)


def _faster(t_ns: NDArray[np.int64], step_ns: int) -> bool:
    return float(np.median(np.diff(t_ns))) < 0.75 * step_ns


def _means(t_ns: NDArray[np.int64], step_ns: int, *values: Array) -> tuple[NDArray[np.int64], list[Array]]:
    """Times (M,) of the middles of intervals with samples, and the means of values (N, k) in each."""
    slot = (t_ns - t_ns[0]) // step_ns
    kept, first, count = np.unique(slot, return_index=True, return_counts=True)
    middle = t_ns[0] + kept * step_ns + step_ns // 2
    return middle, [np.add.reduceat(v, first, axis=0) / count[:, None] for v in values]


def _antenna(recording: Recording) -> tuple[float, float, float]:
    x, y, z = vehicle_of(recording, None).rig().sensors.gnss.antenna_m
    return x, y, z


def _with(recording: Recording, **geometry: object) -> Recording:
    overrides = dataclasses.replace(recording.overrides, **geometry)  # type: ignore[arg-type]
    return dataclasses.replace(recording, overrides=overrides)


def _imu(recording: Recording) -> Imu:
    if recording.imu is None:
        raise DataError("has no IMU", file=recording.name)
    return recording.imu


def _turned(angle_deg: float) -> Put:
    return lambda recording: turned_imu(recording, vehicle_of(recording, None), angle_deg)


def _slower(rate_hz: float) -> Put:
    return lambda recording: slower(recording, rate_hz)


CHANGES = (
    Change("antenna .35 m off", antenna_moved, antenna_told),
    Change("gyro x 1.03", gyro_scaled),
    Change("GNSS 1.5 s late", lambda r: late_fixes(r, vehicle_of(r, None), LATE_S)),
    Change("wheels +8 %", _wheels_scaled, wheels_told),
    Change("left side +3 %", lambda r: scaled_left(r, vehicle_of(r, None), SIDE)),
    *(Change(f"IMU turned {angle:g} deg", _turned(angle)) for angle in ANGLES_DEG),
    *(Change(f"rates cut to {rate:g} Hz", _slower(rate)) for rate in RATES_HZ),
    Change("track unknown", track_unknown, track_told),
)
