"""Angular rate and specific force of an MT Manager export, and the unit the rates are in."""

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import rpy_to_quaternion
from terrafusion.datasets.readers.delimited import TextTable

ACC, GYR = ("Acc_X", "Acc_Y", "Acc_Z"), ("Gyr_X", "Gyr_Y", "Gyr_Z")
INCREMENTS = (("VelInc_X", "VelInc_Y", "VelInc_Z"), ("OriInc_q0", "OriInc_q1", "OriInc_q2", "OriInc_q3"))
"""Velocity increments m/s and orientation increments (w, x, y, z), both of one packet's interval."""

ATTITUDES = (("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"), ("Roll", "Pitch", "Yaw"))

TOP_RATE_RADPS = 35.0
"""Just above the widest range of an MTi's gyros, 2000 deg/s."""
CHECKED_ROWS = 50_000
TURNING_RADPS = 0.05
DEG = np.pi / 180.0


def inertial(columns: TextTable, t_ns: TimesNs, settings: dict[str, str]) -> tuple[Imu | None, list[str]]:
    """The IMU channel of the rows that hold a sample (None where none does), and notes.

    Raises:
        DataError: rates beyond what an MTi measures, in an unknown unit.
    """
    gyro, accel = columns.stack(GYR), columns.stack(ACC)
    notes: list[str] = []
    period_s = float(np.median(np.diff(t_ns))) * 1e-9 if len(t_ns) > 1 else 0.0
    if np.isnan(gyro).all() and INCREMENTS[1][0] in columns.numbers and period_s > 0.0:
        gyro = _rotation_vectors(columns.stack(INCREMENTS[1])) / period_s
        notes.append(f"imu: rates are orientation increments over {period_s:g} s")
    else:
        gyro, rate_notes = _in_radps(gyro, columns, t_ns, settings)
        notes += rate_notes
    if np.isnan(accel).all() and INCREMENTS[0][0] in columns.numbers and period_s > 0.0:
        accel = columns.stack(INCREMENTS[0]) / period_s
        notes.append(f"imu: specific force is velocity increments over {period_s:g} s")
    held = np.asarray(np.isfinite(np.hstack([gyro, accel])).any(axis=1))
    if not held.any():
        return None, [*notes, "imu: no row holds a sample; the channel is absent"]
    if not held.all():
        notes.append(f"imu: {int((~held).sum())} of {len(held)} rows hold no sample; left out")
    notes.append("imu: axes are the device's, taken as x forward, y left, z up")
    return Imu(t_ns[held], gyro[held], accel[held]), notes


def _in_radps(
    gyro: Array, columns: TextTable, t_ns: TimesNs, settings: dict[str, str]
) -> tuple[Array, list[str]]:
    """Rates in rad/s: by the column's name, else by the attitude, else as documented."""
    units = {settings.get(f"unit of {name}", "") for name in GYR}
    if len(units) > 1 or not units <= {"", "deg/s", "rad/s"}:
        raise DataError(
            f"rates are in {', '.join(sorted(unit or 'no unit' for unit in units))}",
            channel="imu",
            remedy="give all three in rad/s or in deg/s",
        )
    unit = units.pop()
    if unit:
        return gyro * (DEG if unit == "deg/s" else 1.0), [f"imu: rates are in {unit}, as the header says"]
    ratio = _rate_ratio(gyro, columns, t_ns)
    if ratio is not None and 20.0 < ratio < 170.0:
        return gyro * DEG, [f"imu: rates are {ratio:.3g} times those of the attitude: taken as deg/s"]
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero((np.abs(gyro) > TOP_RATE_RADPS).any(axis=1))
    if beyond.size:
        i = int(beyond[0])
        raise DataError(
            f"a rate of {np.nanmax(np.abs(gyro[i])):g} rad/s is beyond what an MTi measures",
            channel="imu",
            time_s=float(t_ns[i] - t_ns[0]) * 1e-9,
            remedy="if the export is in deg/s, name the columns `Gyr_X [deg/s]` ... in its header",
        )
    return gyro, []


def _rate_ratio(gyro: Array, columns: TextTable, t_ns: TimesNs) -> float | None:
    """Ratio of the gyro's rate to that of the attitude; None where too little turns."""
    if all(name in columns.numbers for name in ATTITUDES[0]):
        q = columns.stack(ATTITUDES[0])[:CHECKED_ROWS, [1, 2, 3, 0]]
    elif all(name in columns.numbers for name in ATTITUDES[1]):
        q = rpy_to_quaternion(columns.stack(ATTITUDES[1])[:CHECKED_ROWS] * DEG)
    else:
        return None
    t_s, speed = (t_ns[:CHECKED_ROWS] - t_ns[0]) * 1e-9, np.linalg.norm(gyro[:CHECKED_ROWS], axis=1)
    good = np.isfinite(q).all(axis=1) & np.isfinite(speed)
    q, t_s, speed = q[good], t_s[good], speed[good]
    if len(q) < 3:
        return None
    norm = np.linalg.norm(q, axis=1)
    cosine = np.abs((q[1:] * q[:-1]).sum(axis=1)) / np.maximum(norm[1:] * norm[:-1], 1e-9)
    dt = np.diff(t_s)
    turned = 2.0 * np.arccos(np.minimum(cosine, 1.0)) / np.where(dt > 0, dt, np.inf)
    turning = turned > TURNING_RADPS
    return float(np.median(speed[1:][turning] / turned[turning])) if turning.sum() >= 10 else None


def _rotation_vectors(q_wxyz: Array) -> Array:
    """Rotation vectors (N, 3), rad, of unit quaternions (N, 4)."""
    q = np.where(q_wxyz[:, :1] < 0.0, -q_wxyz, q_wxyz)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, q[:, 0])
    return np.asarray(q[:, 1:] * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)[:, None])
