"""Clock, angular rate and specific force of an MT Manager export.

The clock is UTC, the device's ticks, or packets at the update rate; rates come in one of two units.
"""

import re

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.clock import RowTimes
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


UTC = tuple(f"UTC_{part}" for part in ("Year", "Month", "Day", "Hour", "Minute", "Second", "Nano", "Valid"))
UTC_LOWEST, UTC_HIGHEST = (1980, 1, 1, 0, 0, 0, -(10**9)), (2200, 12, 31, 23, 59, 60, 10**9)
UTC_VALID_BIT = 4
"""Bit of UTC_Valid: date, time and leap seconds are known."""

TICK_NS = 100_000
"""SampleTimeFine counts at 10 kHz."""
TICK_SPAN, COUNTER_SPAN = 2**32, 2**16
SLOWEST_HZ = 1.0
"""An MTi sends no slower; longer steps mean that the ticks are not of 10 kHz."""


def clock_of(columns: TextTable, settings: dict[str, str]) -> RowTimes:
    """The best clock the export has, and the rows that have a time by it.

    UTC on every row is taken as it is. Else the ticks count from one to the next row, and the
    median of their distance to the UTC rows gives the date, where there are any.

    Raises:
        DataError: none of ticks, UTC, or a packet counter with the update rate; UTC that is no date.
    """
    utc, valid = _utc(columns)
    ticks = columns.numbers.get("SampleTimeFine")
    counter = next((columns.numbers[n] for n in ("PacketCounter", "Counter") if n in columns.numbers), None)
    if valid.all() or (valid.any() and not _known(ticks) and not _known(counter)):
        return RowTimes(utc[valid], valid, notes=_left_out(valid))
    if _known(ticks):
        assert ticks is not None
        rows = np.isfinite(ticks)
        t_ns = _unwrapped(ticks[rows], TICK_SPAN) * TICK_NS
        _check_ticks(t_ns)
        notes: tuple[str, ...] = ()
    elif _known(counter):
        assert counter is not None
        rate_hz = _update_rate(settings)
        rows = np.isfinite(counter)
        t_ns = np.rint(_unwrapped(counter[rows], COUNTER_SPAN) * (1e9 / rate_hz)).astype(np.int64)
        notes = (f"times are packet counts at the update rate of {rate_hz:g} Hz: no clock was exported",)
    else:
        raise DataError("no row has a time", remedy="export SampleTimeFine, UTC time or PacketCounter")
    t_ns, date_note = _dated(t_ns, utc[rows], valid[rows])
    return RowTimes(t_ns, rows, notes=(*notes, date_note, *_left_out(rows)))


def _known(values: Array | None) -> bool:
    return values is not None and bool(np.isfinite(values).any())


def _left_out(rows: Mask) -> tuple[str, ...]:
    return () if rows.all() else (f"{int((~rows).sum())} of {len(rows)} rows have no time; left out",)


def _utc(columns: TextTable) -> tuple[TimesNs, Mask]:
    """UTC as Unix nanoseconds (N,), and the rows (N,) that hold it."""
    parts = columns.stack(UTC)
    valid = np.asarray(np.isfinite(parts[:, :6]).all(axis=1))
    if "UTC_Valid" in columns.numbers:
        flags = np.clip(np.nan_to_num(parts[:, 7]), 0, 255).astype(np.int64)
        valid &= (flags & UTC_VALID_BIT) > 0
    t_ns = np.zeros(len(parts), dtype=np.int64)
    if not valid.any():
        return t_ns, valid
    given = np.nan_to_num(parts[valid, :7])
    in_range = np.asarray(((given >= UTC_LOWEST) & (given <= UTC_HIGHEST)).all(axis=1))
    year, month, day, hour, minute, second, nano = np.where(in_range[:, None], given, 1.0).astype(np.int64).T
    months = (year - 1970) * 12 + month - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1
    in_range &= days.astype("datetime64[D]").astype("datetime64[M]").astype(np.int64) == months
    if not in_range.all():
        i = int(np.flatnonzero(~in_range)[0])
        raise DataError(
            f"UTC '{' '.join(f'{x:g}' for x in given[i])}' is no date, in data row "
            f"{int(np.flatnonzero(valid)[i]) + 1}",
            remedy="remove that row",
        )
    t_ns[valid] = ((days * 24 + hour) * 60 + minute) * 60 * 10**9 + second * 10**9 + nano
    return t_ns, valid


def _unwrapped(counts: Array, span: int) -> NDArray[np.int64]:
    """Counts (N,) that go on where those of the file start again from zero."""
    strange = np.flatnonzero((counts < 0) | (counts >= TICK_SPAN))
    if strange.size:
        raise DataError(
            f"the counter is {counts[strange[0]]:g} in data row {int(strange[0]) + 1}",
            remedy="remove that row",
        )
    whole = counts.astype(np.int64)
    wraps = np.cumsum(np.diff(whole, prepend=whole[:1]) < -span // 2)
    return whole + wraps * span


def _check_ticks(t_ns: TimesNs) -> None:
    steps = np.diff(t_ns)
    step_s = float(np.median(steps)) * 1e-9 if steps.size else 0.0
    if step_s > 1.0 / SLOWEST_HZ:
        raise DataError(
            f"SampleTimeFine grows by {step_s * 1e4:.0f} a row: {1 / step_s:.2g} Hz, were it ticks of 10 kHz",
            remedy="if it is in microseconds (Xsens DOT), read the file with a column map",
        )


def _update_rate(settings: dict[str, str]) -> float:
    text = next((settings[k] for k in ("update rate", "sample rate", "output rate") if k in settings), "")
    number = re.match(r"\s*(\d+(?:\.\d+)?)", text)
    rate_hz = float(number[1]) if number else 0.0
    if not 0.0 < rate_hz <= 1e5:
        raise DataError(
            "there is neither SampleTimeFine nor UTC, and no `// Update Rate:` to count packets by",
            remedy="export SampleTimeFine, or add the line `// Update Rate: 100.0Hz`",
        )
    return rate_hz


def _dated(t_ns: TimesNs, utc: TimesNs, valid: Mask) -> tuple[TimesNs, str]:
    """Device times shifted to UTC where any row has it."""
    if not valid.any():
        return t_ns, "times are of the device's clock: the export holds no valid UTC"
    apart = utc[valid] - t_ns[valid]
    offset = int(np.sort(apart)[len(apart) // 2])
    spread_ms = float(apart.max() - apart.min()) * 1e-6
    return t_ns + offset, (
        f"times are of the device's clock, set to UTC by {int(valid.sum())} rows (spread {spread_ms:.3g} ms)"
    )
