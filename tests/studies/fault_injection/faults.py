"""Known changes put into recordings: what a diagnosis of real logs is to name.

Each change is made in the log's own channels, on noise, ground and faults as they are in the field. It is
made as it would come about there: wheel counts are lost by chance, a late fix keeps its values, a turned IMU
mixes its axes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Gnss, Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import window_starts
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.model.vehicle import VehicleParams, with_overrides

Array = NDArray[np.float64]

HEADING_EVERY_S = 1.0
"""The heading by which an antenna is moved is found this often."""

Change = Callable[[Recording, VehicleParams, float], Recording]


@dataclass(frozen=True)
class Injection:
    """One kind of change.

    Attributes:
        name: for tables.
        channel: that it is put into.
        size: at severity 1, in `unit`.
        named: effects that are a right answer: the change itself and what only a tape measure tells from it.
        estimates: by catalogue parameter, the size put in for one unit of it.
        change: makes it.
    """

    name: str
    channel: str
    size: float
    unit: str
    named: tuple[str, ...]
    estimates: Mapping[str, float]
    change: Change

    def into(self, recording: Recording, vehicle: VehicleParams, severity: float) -> Recording:
        """The recording with the change in it.

        Raises:
            DataError: it does not have the channel.
        """
        return self.change(recording, vehicle, severity * self.size)


def _wheels(recording: Recording) -> Wheels:
    if recording.wheels is None or not len(recording.wheels):
        raise DataError("has no wheel speeds", file=recording.name, remedy="choose another change")
    return recording.wheels


def _imu(recording: Recording) -> Imu:
    if recording.imu is None or not len(recording.imu):
        raise DataError("has no IMU", file=recording.name, remedy="choose another change")
    return recording.imu


def _gnss(recording: Recording) -> Gnss:
    if recording.gnss is None or not len(recording.gnss):
        raise DataError("has no GNSS", file=recording.name, remedy="choose another change")
    return recording.gnss


def scaled_wheels(recording: Recording, vehicle: VehicleParams, share: float) -> Recording:
    """All wheel readings times 1 + share."""
    return _scaled(recording, np.full(len(_wheels(recording).names), 1.0 + share))


def scaled_left(recording: Recording, vehicle: VehicleParams, share: float) -> Recording:
    """The left wheels' readings times 1 + share.

    Raises:
        DataError: the log has one speed for both sides.
    """
    wheels = _wheels(recording)
    if not wheels.has_sides():
        raise DataError("has one wheel speed for both sides", file=recording.name, remedy="scale both")
    return _scaled(recording, np.array([1.0 + share * name.endswith("left") for name in wheels.names]))


def _scaled(recording: Recording, factor: Array) -> Recording:
    wheels = _wheels(recording)
    angle = None if wheels.angle_rad is None else wheels.angle_rad * factor
    changed = dataclasses.replace(wheels, speed=wheels.speed * factor, angle_rad=angle)
    return dataclasses.replace(recording, wheels=changed)


def lost_counts(recording: Recording, vehicle: VehicleParams, share: float, seed: int = 0) -> Recording:
    """Every count of every wheel is lost with this probability, independently of all others."""
    wheels, rng = _wheels(recording), np.random.default_rng(seed)
    quantum = vehicle.sensors.wheels.quantum_rad
    if wheels.unit == "mps":
        quantum *= vehicle.odometry.wheel_radius_m
    apart_s = np.diff(wheels.t_ns, prepend=wheels.t_ns[0]) * 1e-9
    turned = np.nan_to_num(wheels.speed * apart_s[:, None])
    counts = np.abs(turned / quantum).round().astype(np.int64)
    lost = np.sign(turned) * quantum * rng.binomial(counts, share)
    with np.errstate(invalid="ignore", divide="ignore"):
        kept = np.where(np.abs(turned) > 0.0, 1.0 - lost / turned, 1.0)
    angle = None if wheels.angle_rad is None else wheels.angle_rad - np.cumsum(lost, axis=0)
    changed = dataclasses.replace(wheels, speed=wheels.speed * kept, angle_rad=angle)
    return dataclasses.replace(recording, wheels=changed)


def late_fixes(recording: Recording, vehicle: VehicleParams, delay_s: float) -> Recording:
    """Every fix is stamped this much later."""
    gnss = _gnss(recording)
    return dataclasses.replace(
        recording, gnss=dataclasses.replace(gnss, t_ns=gnss.t_ns + round(delay_s * 1e9))
    )


def late_imu(recording: Recording, vehicle: VehicleParams, delay_s: float) -> Recording:
    """Every reading of the IMU is stamped this much later."""
    imu = _imu(recording)
    return dataclasses.replace(recording, imu=dataclasses.replace(imu, t_ns=imu.t_ns + round(delay_s * 1e9)))


def turned_imu(recording: Recording, vehicle: VehicleParams, angle_deg: float) -> Recording:
    """The IMU sits turned to the left by this angle."""
    imu, angle = _imu(recording), math.radians(angle_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    R = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    changed = dataclasses.replace(
        imu, gyro_radps=_mixed(imu.gyro_radps, R), accel_mps2=_mixed(imu.accel_mps2, R)
    )
    return dataclasses.replace(recording, imu=changed)


def _mixed(values: Array, R: Array) -> Array:
    """Readings (N, 3) in turned axes; an axis the log lacks (all NaN) does not spoil the others."""
    absent = np.isnan(values).all(axis=0)
    out = np.where(absent, 0.0, values) @ R.T
    out[:, absent] = np.nan
    return out


def biased_gyro(recording: Recording, vehicle: VehicleParams, bias_radps: float) -> Recording:
    """The yaw rate reads this much more."""
    imu = _imu(recording)
    changed = dataclasses.replace(imu, gyro_radps=imu.gyro_radps + np.array([0.0, 0.0, bias_radps]))
    return dataclasses.replace(recording, imu=changed)


def moved_antenna(recording: Recording, vehicle: VehicleParams, forward_m: float) -> Recording:
    """The antenna sits this much further forward, along the heading that wheels, gyro and track tell.

    Raises:
        DataError: the log does not tell its heading.
    """
    gnss = _gnss(recording)
    t_s = (gnss.t_ns - recording.start_ns) * 1e-9
    at_s = np.arange(float(t_s[0]), float(t_s[-1]) + HEADING_EVERY_S, HEADING_EVERY_S)
    model = Model(with_overrides(vehicle, recording.overrides), {})
    start, known = window_starts(recording, model, recording.start_ns, at_s, HEADING_EVERY_S, truth=False)
    if not known:
        raise DataError("does not tell its heading", file=recording.name, remedy="choose another change")
    yaw = np.interp(t_s, at_s, np.unwrap(start[:, 2]))
    ahead = forward_m * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=gnss.enu_m + ahead))


def pose_as_gnss(recording: Recording, sigma_m: float) -> Recording:
    """The log's reference positions (motion capture, lidar) in the place of GNSS, as measurements.

    Raises:
        DataError: the log has no reference position.
    """
    truth = recording.truth
    if truth is None or not len(truth) or "position" not in recording.truth_channels:
        raise DataError("has no reference position", file=recording.name, remedy="leave its poses unused")
    n = len(truth)
    gnss = Gnss(truth.t_ns, truth.position_m, np.full((n, 3), sigma_m), np.full(n, 4, dtype=np.uint8))
    return dataclasses.replace(recording, gnss=gnss, truth=None, truth_channels=())


ALIKE = ("encoder_scale", "wheel_radius", "encoder_dropout")
"""A tape measure tells a wheel's radius from its encoder's scale, no log does."""
_READS = {
    "encoder_scale/reading": 1.0, "encoder_scale/in_loop": 1.0, "encoder_dropout/share": -1.0,
    "wheel_radius/scale": -1.0,
}  # fmt: skip

INJECTIONS = (
    Injection("wheels scaled", "wheels", 0.03, "", ALIKE, _READS, scaled_wheels),
    Injection(
        "left wheel scaled", "wheels", 0.03, "", ("wheel_radius_asymmetry",),
        {"wheel_radius_asymmetry/left": -1.0, "wheel_radius_asymmetry/sides": -1.0}, scaled_left,
    ),
    Injection(
        "counts lost", "wheels", 0.03, "", ALIKE, {k: -v for k, v in _READS.items()}, lost_counts
    ),
    Injection(
        "GNSS late", "gnss", 0.2, "s", ("gnss_latency",), {"gnss_latency/both": 1.0}, late_fixes
    ),
    Injection(
        "antenna moved", "gnss", 0.3, "m", ("gnss_lever_arm",), {"gnss_lever_arm/offset/x": 1.0},
        moved_antenna,
    ),
    Injection(
        "IMU turned", "imu", 3.0, "deg", ("imu_yaw_misalignment",),
        {f"imu_yaw_misalignment/{form}": math.degrees(1.0) for form in ("rotation", "cross_axis")},
        turned_imu,
    ),
    Injection(
        "gyro biased", "imu", 0.005, "rad/s", ("gyro_bias",),
        {"gyro_bias/constant": 1.0, "gyro_bias/warm_up": 1.0}, biased_gyro,
    ),
    Injection("IMU late", "imu", 0.1, "s", ("imu_time_offset",), {"imu_time_offset/shift": 1.0}, late_imu),
)  # fmt: skip
