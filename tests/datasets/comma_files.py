"""A segment in the form of comma2k19: a car on a circle to the left."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pymap3d

from terrafusion.datasets.core.frames import matrix_to_quaternion, quaternion_to_matrix, rpy_to_quaternion

DATUM = (47.0, 8.0, 400.0)
GPS_WEEK, GPS_S, UTC_S = 2012, 404_106.5, 1_533_226_488.5
BOOT_S, SECONDS = 1000.0, 12.0
SPEED_MPS, RATE_RADPS = 10.0, 0.1
RATIO, WHEELBASE_M = 15.0, 2.7


def write_segment(folder: Path) -> Path:
    """Write it; the frames' clock is the device's, the receiver's messages come 0.2 s late."""
    t = np.arange(0.0, SECONDS, 0.02)
    n = len(t)
    steer = np.degrees(np.arctan(RATE_RADPS * WHEELBASE_M / SPEED_MPS)) * RATIO
    _signal(folder, "CAN/wheel_speed", t, np.full((n, 4), SPEED_MPS))
    _signal(folder, "CAN/steering_angle", t, np.full(n, steer))
    _signal(folder, "IMU/gyro", t, np.tile([0.0, 0.0, -RATE_RADPS], (n, 1)))
    _signal(folder, "IMU/accelerometer", t, np.tile([0.0, -SPEED_MPS * RATE_RADPS, -9.81], (n, 1)))
    coarse = t[::5]
    yaw, place = _path(coarse)
    lat, lon, up = pymap3d.enu2geodetic(*place.T, *DATUM)
    bearing = 90.0 - np.degrees(yaw)
    utc = (UTC_S + coarse) * 1e3
    fixes = np.stack([lat, lon, np.full(len(coarse), SPEED_MPS), utc, up, bearing], axis=1)
    _signal(folder, "GNSS/live_gnss_ublox", coarse + 0.2, fixes)
    pose = folder / "global_pose"
    pose.mkdir()
    ecef = np.stack(pymap3d.enu2ecef(*place.T, *DATUM), axis=1)
    R_enu_body = quaternion_to_matrix(rpy_to_quaternion(np.stack([0 * yaw, 0 * yaw, yaw], axis=1)))
    R_ecef_enu = np.array([pymap3d.enu2ecefv(*axis, *DATUM[:2]) for axis in np.eye(3)]).T
    q = matrix_to_quaternion(R_ecef_enu @ R_enu_body @ np.diag([1.0, -1.0, -1.0]))
    arrays = {
        "frame_times": BOOT_S + coarse,
        "frame_gps_times": np.stack([np.full(len(coarse), GPS_WEEK), GPS_S + coarse], axis=1),
        "frame_positions": ecef,
        "frame_orientations": q[:, [3, 0, 1, 2]],
    }
    for name, values in arrays.items():
        _save(pose / name, values)
    return folder


def _path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    yaw, radius = RATE_RADPS * t, SPEED_MPS / RATE_RADPS
    return yaw, np.stack([radius * np.sin(yaw), radius * (1.0 - np.cos(yaw)), 0.0 * t], axis=1)


def _signal(folder: Path, name: str, t: np.ndarray, value: np.ndarray) -> None:
    place = folder / "processed_log" / name
    place.mkdir(parents=True)
    _save(place / "t", BOOT_S + t)
    _save(place / "value", value)


def _save(path: Path, values: np.ndarray) -> None:
    with path.open("wb") as file:
        np.save(file, values)
