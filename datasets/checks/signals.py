"""Signals that a sensor cannot have produced: held values, stuck or dead axes, missing cells."""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks.finding import (
    CheckContext,
    Finding,
    Repair,
    changed,
    once,
    with_fields,
    without_rows,
)
from terrafusion.datasets.checks.motion import ANY_RADIUS_M, runs, yaw_rates
from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Channel, Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.conventions import true_updates
from terrafusion.datasets.core.lag import held_rows
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.wrapped_angles import sampled_apart

MEASURED = {
    "wheels": ("speed",),
    "imu": ("gyro_radps", "accel_mps2"),
    "gnss": ("enu_m",),
    "motor": ("current_a",),
    "truth": ("position_m",),
}
"""Fields (N, k) with what a channel measured; a command may be constant."""
HELD_SHARE, LEAST_UPDATES = 0.5, 10
STUCK_S, STUCK_ZERO_S, STUCK_ROWS = 2.0, 5.0, 20
"""A value that stays for this time, and this many updates, is stuck; wheels may stand for a while."""
CLIPPED_ROWS = 10
"""A value at the end of the range that occurs this often elsewhere is the sensor's limit."""
LIVELY = 0.1
"""Standard deviation of the other axes over their usual one above which they move."""
LEAST_TURN_RADPS, LEAST_EXTENT_M, STILL_SHARE = 0.05, 5.0, 0.02
LEAST_STUCK_RADPS = 1e-3
"""A smaller rate that is constant throughout stands for a missing axis."""
ROLLED_OVER = 2.0
"""rad; no robot drives on after it has turned so far about x or y."""
MISSING_SHARE = 0.05
LONGEST_RUNS = 20


@dataclass(frozen=True)
class SensorAxes:
    """Axes of one sensor: `values` (N, k) of a channel's field `field`."""

    channel: str
    field: str
    names: tuple[str, ...]
    t_ns: TimesNs
    values: Array

    def known(self) -> list[int]:
        """Axes that the log has."""
        return [k for k in range(self.values.shape[1]) if np.isfinite(self.values[:, k]).any()]


def sensors_of(recording: Recording) -> list[SensorAxes]:
    """Gyro, accelerometer and wheels, where present."""
    found = []
    imu, wheels = recording.imu, recording.wheels
    if imu is not None and len(imu):
        for sensor, field in (("gyro", "gyro_radps"), ("accel", "accel_mps2")):
            names = tuple(f"{sensor} {axis}" for axis in "xyz")
            found.append(SensorAxes("imu", field, names, imu.t_ns, getattr(imu, field)))
    if wheels is not None and len(wheels):
        names = tuple(name.replace("_", " ") for name in wheels.names)
        found.append(SensorAxes("wheels", "speed", names, wheels.t_ns, wheels.speed))
    return found


LARGE_M = 1.0
"""Positions spread with the length of a drive: who goes a tenth of this in a second, moves."""


def check_held(context: CheckContext) -> Iterator[Finding]:
    """Values repeated between true samples: the rate of the log is not the rate of the sensor."""
    for name, channel in context.recording.channels().items():
        values = _measured(channel)
        share, run = _held_share(channel.t_ns, values, LARGE_M if name == "gnss" else np.inf)
        rows = held_rows(values)
        if share <= HELD_SHARE or rows == 1:  # runs of varying length are those of a coarse signal
            continue
        yield Finding(
            "held-values", "warning", name,
            "values are held",
            f"{share:.0%} of the samples repeat the one before while the signal changes; "
            f"a new value comes every {run:.1f} samples",
            f"keep the true updates: the first row of each run, and every {rows} rows where nothing changes",
            changed(name, functools.partial(_true_rows, rows)),
        )  # fmt: skip


def _true_rows(rows: int, channel: Channel) -> Channel:
    return channel.select(true_updates(_measured(channel), rows))


def _measured(channel: Channel) -> Array:
    """What a channel measured (N, k), without the axes that it lacks; (N, 0) for other channels."""
    fields = MEASURED[channel.name] if channel.name in ("imu", "wheels", "gnss") else ()
    values = np.hstack([np.zeros((len(channel), 0)), *(getattr(channel, field) for field in fields)])
    return np.asarray(values[:, np.isfinite(values).any(axis=0)])


def _held_share(t_ns: TimesNs, values: Array, large: float) -> tuple[float, float]:
    """Share of repeats among samples inside a change, and the mean run length there.

    Changes are counted from a tenth of the spread of the values on, or of `large`, where that is smaller.
    """
    values = np.nan_to_num(values)
    if len(values) < 50 or not values.size:
        return 0.0, 1.0
    period = max(float(np.median(np.diff(t_ns))) * 1e-9, 1e-4)
    reach = int(np.clip(round(0.5 / period), 3, 500))
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    spread = np.minimum(spread, large)
    across = np.abs(values[2 * reach :] - values[: -2 * reach])
    changing = np.any(across > 0.1 * np.where(spread > 0, spread, np.inf), axis=1)
    same = np.all(values[reach:-reach] == values[reach - 1 : -reach - 1], axis=1)
    if changing.sum() < 20 or (~same[changing]).sum() < LEAST_UPDATES:
        return 0.0, 1.0
    share = float(same[changing].mean())
    return share, 1.0 / max(1.0 - share, 1e-3)


def check_stuck(context: CheckContext) -> Iterator[Finding]:
    """Axes that keep one value while the others of their sensor move."""
    stuck: dict[str, list[tuple[SensorAxes, Mask]]] = {}
    for sensor, mask in stuck_sensors(context):
        if mask.any():
            stuck.setdefault(sensor.channel, []).append((sensor, mask))
    for channel, found in stuck.items():
        names, evidence = [], []
        for sensor, mask in found:
            for k in np.flatnonzero(mask.any(axis=0)).tolist():
                rows = np.flatnonzero(mask[:, k])
                first, last = (context.since_start_s(sensor.t_ns[row]) for row in (rows[0], rows[-1]))
                value = sensor.values[rows[0], k]
                names.append(sensor.names[k])
                evidence.append(f"{sensor.names[k]} is {value:.4g} from {first:.2f} to {last:.2f} s")
        yield Finding(
            "stuck", "error", channel,
            f"{' and '.join(names)} {'keeps' if len(names) == 1 else 'keep'} one value",
            "; ".join(evidence) + "; the other axes move meanwhile",
            "leave these rows out" if channel == "wheels" else "empty these cells: their values are unknown",
            without_cells([(sensor.field, mask) for sensor, mask in found], channel),
        )  # fmt: skip


@once
def stuck_sensors(context: CheckContext) -> list[tuple[SensorAxes, Mask]]:
    """The sensors, each with the mask of `stuck_cells`."""
    return [(sensor, stuck_cells(sensor)) for sensor in sensors_of(context.recording)]


def without_stuck(context: CheckContext) -> Recording:
    """The recording with the cells of stuck axes empty."""
    recording = context.recording
    for sensor, mask in stuck_sensors(context):
        if mask.any():
            emptied = {sensor.field: np.where(mask, np.nan, sensor.values)}
            recording = with_fields(recording, sensor.channel, **emptied)
    return recording


def stuck_cells(sensor: SensorAxes) -> Mask:
    """Mask (N, k) of the cells of stuck axes."""
    mask = np.zeros(sensor.values.shape, dtype=bool)
    known = sensor.known()
    if len(known) < 2 or len(sensor.values) < 2 * STUCK_ROWS:
        return mask
    keep = np.flatnonzero(true_updates(sensor.values[:, known], held_rows(sensor.values[:, known])))
    t_s, values = (sensor.t_ns[keep] - sensor.t_ns[0]) * 1e-9, sensor.values[keep]
    same = values[1:] == values[:-1]
    usual = _spreads(values)
    moving = [k for k in known if same[:, k].mean() < 0.5]
    constant = [k for k in known if same[:, k].all()]
    for k in known:
        others = [o for o in moving if o != k]
        if k in constant:
            mask[:, k] = _is_stuck_throughout(sensor, k, constant, others)
            continue
        for first, last in _longest_runs(same[:, k]):
            long = t_s[last] - t_s[first] >= (STUCK_S if values[first, k] else STUCK_ZERO_S)
            if not long or last - first < STUCK_ROWS or not others or _is_clipped(values[:, k], first, last):
                continue
            rest = np.delete(same[:, k], slice(first, last))
            within = _spreads(values[first : last + 1, others]) > LIVELY * usual[others]
            changes = same[first:last][:, others].mean(axis=0) < 0.5
            if rest.size and rest.mean() < 0.5 and (within & changes).any():
                end = keep[last + 1] if last + 1 < len(keep) else len(mask)
                mask[keep[first] : end, k] = True
    return mask


def _is_clipped(values: Array, first: int, last: int) -> bool:
    """Whether a run is at the end of a range that the signal reaches at other times too."""
    value, known = values[first], values[np.isfinite(values)]
    elsewhere = int((known == value).sum()) - (last - first + 1)
    return elsewhere >= CLIPPED_ROWS and value in (known.min(), known.max())


def _spreads(values: Array) -> Array:
    """Standard deviations of the known values of each column; 0 where there is none."""
    known = np.isfinite(values)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, values, 0.0).sum(axis=0) / count
    return np.asarray(np.sqrt(np.where(known, (values - mean) ** 2, 0.0).sum(axis=0) / count))


def _is_stuck_throughout(sensor: SensorAxes, k: int, constant: list[int], moving: list[int]) -> bool:
    """Whether a constant axis is stuck: one of three, and not one that planar logs leave out.

    A gyro axis that turns at one rate throughout is stuck, too, where another axis is alive, or where x and y
    would have rolled the robot over.
    """
    if sensor.channel == "wheels":
        return False
    turning = abs(float(sensor.values[0, k])) if sensor.field == "gyro_radps" else 0.0
    if turning > LEAST_STUCK_RADPS:
        seconds = float(sensor.t_ns[-1] - sensor.t_ns[0]) * 1e-9
        return bool(moving) or (k < 2 and turning * seconds > ROLLED_OVER)
    if len(sensor.known()) < 3:
        return False
    return len(constant) == 1 and len(moving) == 2 and not (sensor.field == "accel_mps2" and k == 2)


def _longest_runs(same: Mask) -> list[tuple[int, int]]:
    """First and last row of the longest runs of equal values, in order of time."""
    begins, ends = runs(same)
    longest = np.sort(np.argsort(begins - ends, kind="stable")[:LONGEST_RUNS])
    return [(int(begins[i]), int(ends[i])) for i in longest]


def without_cells(cells: list[tuple[str, Mask]], channel: str) -> Repair:
    """A repair that empties cells of an IMU, or drops such rows of the wheels."""
    if channel == "wheels":
        return without_rows(channel, np.logical_or.reduce([mask.any(axis=1) for _, mask in cells]))

    def emptied(imu: Imu) -> Imu:
        values = {field: np.where(mask, np.nan, getattr(imu, field)) for field, mask in cells}
        return dataclasses.replace(imu, **values)

    return changed(channel, emptied)


def check_dead(context: CheckContext) -> Iterator[Finding]:
    """Wheels that stand while the robot moves, a gyro that is constant while it turns."""
    recording = context.recording
    imu, wheels = recording.imu, recording.wheels
    standing = wheels is not None and not np.nan_to_num(wheels.speed).any()
    side = "" if wheels is None or standing else _dead_side(wheels)
    extent_m = _extent_m(recording) if standing or side else 0.0
    if side and extent_m > LEAST_EXTENT_M:
        yield Finding(
            "dead", "error", "wheels",
            f"the {side} side stands throughout",
            f"its every speed is zero while the other side rolls and the robot covers {extent_m:.0f} m",
            "record both sides; is a joint or an encoder named wrongly, or broken?",
        )  # fmt: skip
    if wheels is not None and len(wheels) >= STUCK_ROWS and standing and extent_m > LEAST_EXTENT_M:
        yield Finding(
            "dead", "error", "wheels",
            "the wheels stand throughout",
            f"every speed is zero while the robot covers {extent_m:.0f} m",
            "leave the wheels out",
            lambda recording: dataclasses.replace(recording, wheels=None),
        )  # fmt: skip
    if imu is None or len(imu) < STUCK_ROWS or np.isnan(imu.gyro_radps[:, 2]).all():
        return
    constant = [bool((v[1:] == v[:-1]).all()) for v in imu.gyro_radps.T if np.isfinite(v).any()]
    lively = [bool((v[1:] != v[:-1]).mean() > 0.5) for v in imu.accel_mps2.T if np.isfinite(v).any()]
    still = standing and extent_m <= LEAST_EXTENT_M
    shaking = (len(lively) == 3 and all(lively)) or _stops_turning(recording)
    if all(constant) and not still and (shaking or _turn_radps(context) > LEAST_TURN_RADPS):
        yield Finding(
            "dead", "error", "imu",
            "the gyro is constant",
            f"gyro z is {imu.gyro_radps[0, 2]:g} rad/s throughout, while the robot drives",
            "leave the gyro out",
            without_cells([("gyro_radps", np.ones((len(imu), 3), dtype=bool))], "imu"),
        )  # fmt: skip


def _dead_side(wheels: Wheels) -> str:
    """The side whose every speed is zero while the other one rolls; "" without."""
    if len(wheels) < STUCK_ROWS or not wheels.has_sides():
        return ""
    rolls = np.nan_to_num(wheels.side_speeds_mps(1.0)).any(axis=0)
    return "" if rolls.all() else ("left", "right")[int(np.argmin(rolls))]


def _stops_turning(recording: Recording) -> bool:
    """Whether gyro z turns at a constant rate while the wheels stand for a while."""
    imu, wheels = recording.imu, recording.wheels
    if imu is None or wheels is None or abs(float(imu.gyro_radps[0, 2])) < LEAST_TURN_RADPS:
        return False
    return float((wheels.speed == 0.0).all(axis=1).mean()) > STILL_SHARE


def _extent_m(recording: Recording) -> float:
    """Diagonal of the box about the fixes or the truth, where it is far above their sigma; else 0."""
    extents = [0.0]
    gnss, truth = recording.gnss, recording.truth
    if gnss is not None:
        sigma = gnss.sigma_enu_m[:, :2]
        noise = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else np.inf
        diagonal = _diagonal_m(gnss.enu_m)
        extents.append(diagonal if diagonal > 10.0 * noise else 0.0)
    if truth is not None:
        extents.append(_diagonal_m(truth.position_m))
    return max(extents)


def _diagonal_m(position_m: Array) -> float:
    known = position_m[np.isfinite(position_m[:, :2]).all(axis=1), :2]
    return float(np.hypot(*np.ptp(known, axis=0))) if len(known) else 0.0


def _turn_radps(context: CheckContext) -> float:
    """Root mean square yaw rate of truth, or of wheels on a track of 1 m; 0 where neither has one."""
    rates = yaw_rates(context.recording, context.wheel_radius_m() or ANY_RADIUS_M)
    known = [rates[name][1] for name in ("truth", "wheels") if name in rates]
    return float(np.sqrt(np.nanmean(known[0] ** 2))) if known else 0.0


def check_missing(context: CheckContext) -> Iterator[Finding]:
    """Empty cells in columns that have values."""
    for name, channel in context.recording.channels().items():
        if name not in ("command", "wheels", "imu", "motor", "gnss") or len(channel) < STUCK_ROWS:
            continue
        if isinstance(channel, Wheels) and sampled_apart(channel):
            continue  # see wheels.check_apart
        columns = {c: np.isnan(v) for c, v in channel.columns().items() if v.dtype.kind == "f"}
        if isinstance(channel, Gnss):
            columns = {c: columns[c] & (channel.fix > Fix.NONE) for c in ("east_m", "north_m")}
        share = {column: float(empty.mean()) for column, empty in columns.items() if not empty.all()}
        if not share or max(share.values()) <= MISSING_SHARE:
            continue
        worst = max(share, key=lambda column: share[column])
        empty = np.all([columns[column] for column in share], axis=0)
        whole_rows = empty.mean() >= max(share.values())
        yield Finding(
            "missing-values", "warning", name,
            f"{share[worst]:.0%} of {worst} is missing",
            f"{sum(value > 0 for value in share.values())} of {len(share)} columns have empty cells",
            "leave the empty rows out" if whole_rows else "expect larger uncertainty there",
            without_rows(name, empty) if whole_rows else None,
        )  # fmt: skip
