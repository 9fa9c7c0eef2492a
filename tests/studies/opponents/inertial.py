"""What the three-dimensional opponents share: six IMU axes, the start, and where the antenna sits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.opponents import ekf
from tests.studies.opponents.protocol import Streams, streams_of

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81
LEVEL_S = 1.0
"""Time over which the specific force gives roll and pitch at the start."""
LEVEL_SIGMA_RAD, HEADING_SIGMA_RAD = 0.05, 0.5
ABSENT_ACCEL = 1.0
"""Noise density of an accelerometer that is not there, m/s2/sqrt(Hz): it reads gravity alone."""


@dataclass(frozen=True, eq=False)
class Inertial:
    """Inputs of an inertial estimator; all times are s from the start of the recording.

    Attributes:
        imu_s, gyro_radps, accel_mps2: (N,), (N, 3), (N, 3); axes that the log lacks read rest.
        has_accel: whether the accelerometer is the log's own.
        fixes: (M, 5) time, x, y, z, sigma.
        antenna_m: (3,) from the body's origin.
        point_m: (3,) of the body that the reference is of.
        start: x, y, heading at the first fix.
        level: roll and pitch at the start.
    """

    streams: Streams
    imu_s: Array
    gyro_radps: Array
    accel_mps2: Array
    has_accel: bool
    fixes: Array
    antenna_m: Array
    point_m: Array
    start: Array
    level: tuple[float, float]

    @classmethod
    def of(cls, recording: Recording, vehicle: VehicleParams) -> Inertial | None:
        """The inputs of a recording; None where its streams are too short."""
        streams = streams_of(recording, vehicle)
        if streams is None:
            return None
        imu, gnss = recording.imu, recording.gnss
        assert imu is not None
        assert gnss is not None
        known = np.isfinite(imu.gyro_radps[:, 2])
        gyro, accel = np.nan_to_num(imu.gyro_radps[known]), imu.accel_mps2[known]
        has_accel = imu.has_accel() and imu.has_gyro()
        if not has_accel:
            gyro[:, :2], accel = 0.0, np.tile([0.0, 0.0, GRAVITY_MPS2], (len(gyro), 1))
        t: Array = np.asarray((imu.t_ns[known] - recording.start_ns) * 1e-9, dtype=float)
        antenna = np.array(vehicle.rig().sensors.gnss.antenna_m, dtype=float)
        of_antenna = streams.reference.shape[0] == len(streams.fixes) or recording.truth_frame == "antenna"
        z, tz = gnss.enu_m[:, 2], (gnss.t_ns - recording.start_ns) * 1e-9
        height = (
            np.interp(streams.fixes[:, 0], tz[np.isfinite(z)], z[np.isfinite(z)])
            if np.isfinite(z).any()
            else 0.0
        )
        f = streams.fixes
        fixes = np.column_stack([f[:, :3], np.broadcast_to(height, len(f)), f[:, 3]])
        still = (t >= f[0, 0]) & (t <= f[0, 0] + LEVEL_S) & np.isfinite(accel).all(axis=1)
        level = _level(accel[still].mean(axis=0)) if has_accel and still.any() else (0.0, 0.0)
        return cls(
            streams, t, gyro, np.nan_to_num(accel), has_accel, fixes, antenna,
            antenna if of_antenna else np.zeros(3), ekf.start(streams)[0][:3], level,
        )  # fmt: skip

    def speed_at(self, t: float) -> float:
        """Speed of the wheels at a time."""
        return float(np.interp(t, self.streams.t_s, self.streams.v_mps))


def _level(force: Array) -> tuple[float, float]:
    """Roll and pitch by a specific force (3,) at rest."""
    return float(np.arctan2(force[1], force[2])), float(np.arctan2(-force[0], np.hypot(force[1], force[2])))
