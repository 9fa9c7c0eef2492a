"""Frames, rotations and geodesy of the library.

World frame: local east-north-up (ENU) at a datum on WGS-84 (REP-105 `map`).
Body frame: x forward, y left, z up (REP-103 `base_link`). Yaw is zero facing
east and grows to the left. `R_world_body` takes body vectors to the world.
Quaternions are (x, y, z, w). Tangent order of pose covariances: GTSAM's Pose3
has rotation first and is expressed in the body; ROS has translation first and
is expressed in the parent frame. `gtsam_to_ros_covariance` converts.
"""

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError

NEAREST_TO_POLE_DEG = 1e-6
"""A tenth of a metre: no direction is east there."""
GRAVITY_MPS2 = 9.80665
"""Standard gravity (3rd CGPM, 1901), m/s2."""


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """The same angles in [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad, dtype=float) + np.pi) % (2.0 * np.pi) - np.pi)


def quaternion_to_matrix(q_xyzw: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4); they are normalised first."""
    q = np.asarray(q_xyzw, dtype=float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    R = np.empty((*x.shape, 3, 3))
    for i, row in enumerate(rows):  # np.stack takes longer than all the rest
        for j, values in enumerate(row):
            R[..., i, j] = values
    return R


def matrix_to_quaternion(R: ArrayLike) -> Array:
    """Quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    matrices = np.asarray(R, dtype=float)
    flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(flat).reshape(*matrices.shape[:-2], 4)


def rpy_to_quaternion(rpy_rad: ArrayLike) -> Array:
    """Quaternions (..., 4) of fixed-axis roll, pitch, yaw (REP-103: R = Rz Ry Rx), rad."""
    half = np.asarray(rpy_rad, dtype=float) / 2.0
    cr, cp, cy = np.moveaxis(np.cos(half), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )


def turned_by(R: Array, values: Array) -> Array:
    """R @ v of vectors (N, 3), with the same bits for any N; an axis is NaN only where it depends on one."""
    missing = np.isnan(values)
    known = np.where(missing, 0.0, values)
    out = sum((known[:, i, None] * R[:, i] for i in range(3)), np.zeros_like(known))
    out[missing.astype(float) @ (np.abs(R) > 0.0).T > 0.0] = np.nan
    return np.asarray(out)


def yaw_of(q_xyzw: ArrayLike) -> Array:
    """Yaw angles (...), rad, of quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(q_xyzw, dtype=float), -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def geodetic_to_enu(lat_lon_height: ArrayLike, datum: ArrayLike) -> Array:
    """ENU positions (N, 3), m, of WGS-84 (latitude deg, longitude deg, ellipsoidal height m), (N, 3).

    Raises:
        DataError: the datum lies on a pole.
    """
    import pymap3d

    llh = np.atleast_2d(np.asarray(lat_lon_height, dtype=float))
    lat0, lon0, height0 = _off_the_poles(datum)
    return np.stack(pymap3d.geodetic2enu(llh[:, 0], llh[:, 1], llh[:, 2], lat0, lon0, height0), axis=-1)


def enu_to_geodetic(enu_m: ArrayLike, datum: ArrayLike) -> Array:
    """WGS-84 latitude, longitude (deg) and height (m), (N, 3), of ENU positions (N, 3) about `datum`.

    Raises:
        DataError: the datum lies on a pole.
    """
    import pymap3d

    enu = np.atleast_2d(np.asarray(enu_m, dtype=float))
    lat0, lon0, height0 = _off_the_poles(datum)
    return np.stack(pymap3d.enu2geodetic(enu[:, 0], enu[:, 1], enu[:, 2], lat0, lon0, height0), axis=-1)


def enu_from_ecef(
    ecef_m: ArrayLike, datum: tuple[float, float, float] | None = None
) -> tuple[Array, Array, tuple[float, float, float]]:
    """ENU positions (N, 3) of WGS-84 ECEF positions (N, 3), and the rotation (3, 3) of ECEF vectors to ENU.

    The third value is the datum: the one given, else the first position.

    Raises:
        DataError: the datum lies on a pole.
    """
    import pymap3d

    x, y, z = np.atleast_2d(np.asarray(ecef_m, dtype=float)).T
    if datum is None:
        latitude, longitude, height = (float(value) for value in pymap3d.ecef2geodetic(x[0], y[0], z[0]))
        datum = latitude, longitude, height
    east, north, up = pymap3d.ecef2enu(x, y, z, *_off_the_poles(datum))
    columns = [pymap3d.ecef2enuv(*axis, datum[0], datum[1]) for axis in np.eye(3)]
    return np.stack([east, north, up], axis=-1), np.array(columns).T, datum


def _off_the_poles(datum: ArrayLike) -> tuple[float, float, float]:
    latitude, longitude, height = (float(value) for value in np.asarray(datum, dtype=float))
    if abs(latitude) > 90.0 - NEAREST_TO_POLE_DEG:
        raise DataError(
            f"the datum lies on a pole ({latitude:.7g} deg), where no direction is east",
            channel="gnss",
            remedy="give a datum some metres away, or leave out fixes at a pole",
        )
    return latitude, longitude, height


def gtsam_to_ros_covariance(covariance: ArrayLike, R_world_body: ArrayLike) -> Array:
    """Pose covariances (..., 6, 6), rotation first in the body -> translation first in the world."""
    P = np.asarray(covariance, dtype=float)
    R = np.asarray(R_world_body, dtype=float)
    J = np.zeros(P.shape)
    J[..., :3, 3:] = R
    J[..., 3:, :3] = R
    return np.asarray(J @ P @ np.swapaxes(J, -1, -2))
