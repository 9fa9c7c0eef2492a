"""Single values that a sensor cannot have measured: saturation, spikes, and what no ground robot reaches."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, without_rows
from terrafusion.datasets.checks.motion import ANY_RADIUS_M
from terrafusion.datasets.checks.signals import SensorAxes, sensors_of, stuck_sensors, without_cells
from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Recording

CLIPPED_SHARE, CLIPPED_ROWS, PILE = 0.002, 10, 5.0
"""Share and number of values exactly at the extreme, and how many times more than at the values beside it."""
LEAST_STEPS = 50
"""Signals of fewer distinct values are too coarse to decide."""
FAR_SPIKE = 6.0
"""A spike is this many times further out than anything near it."""
NEAR_ROWS = 12
MOST_SPIKES = 0.02
FLOORS = {"gyro_radps": (0.5, 30.0), "accel_mps2": (150.0, 0.0), "speed": (0.5, 15.0)}
"""Least size of a spike, and the largest change a second of a robot: rad/s, m/s2 and m/s. A stone under a
wheel shakes a Husky by 100 m/s2 for one sample of 100 Hz (BorealTC)."""


def check_saturated(context: CheckContext) -> Iterator[Finding]:
    """Inertial sensors must not reach the end of their range."""
    masks = [(s, _clipped(s, stuck)) for s, stuck in stuck_sensors(context) if s.channel == "imu"]
    found = [(sensor, mask) for sensor, mask in masks if mask.any()]
    if not found:
        return
    evidence = []
    for sensor, mask in found:
        for k in np.flatnonzero(mask.any(axis=0)).tolist():
            extremes = " and ".join(f"{value:.4g}" for value in np.unique(sensor.values[mask[:, k], k]))
            evidence.append(f"{sensor.names[k]} {int(mask[:, k].sum())} times at {extremes}")
    yield Finding(
        "saturated", "warning", "imu",
        "values stand at the end of a range",
        f"{'; '.join(evidence)}; nothing lies beyond",
        "empty these cells: the true values are larger by an unknown amount",
        without_cells([(sensor.field, mask) for sensor, mask in found], "imu"),
    )  # fmt: skip


def _clipped(sensor: SensorAxes, stuck: Mask) -> Mask:
    """Mask (N, 3) of the cells at the extreme of an axis where many are exactly there."""
    mask = np.zeros(sensor.values.shape, dtype=bool)
    for k in sensor.known():
        values = np.where(stuck[:, k], np.nan, sensor.values[:, k])
        if not np.isfinite(values).any():
            continue
        size = float(np.nanmax(np.abs(values)))
        for sign in (1.0, -1.0):
            top = float(np.nanmax(sign * values))
            at_top = sign * values == top
            count = int(at_top.sum())
            if top >= 0.5 * size and count >= max(CLIPPED_ROWS, CLIPPED_SHARE * len(values)):
                mask[:, k] |= at_top & _piles_up(sign * values, top, count)
    return mask


def _piles_up(values: Array, top: float, count: int) -> bool:
    """Whether values are at the top far more often than next to it, in a signal of fine resolution."""
    below = values[values < top]
    if not below.size:
        return False
    near, counts = np.unique(below[below >= np.quantile(below, 0.9)], return_counts=True)
    if len(near) < 5 or len(np.unique(below[:: max(len(below) // 2000, 1)])) < LEAST_STEPS:
        return False
    return count > PILE * float(np.mean(counts[-5:]))


def check_spikes(context: CheckContext) -> Iterator[Finding]:
    """Single samples far from those before and after."""
    spikes: dict[str, list[tuple[str, Array]]] = {}
    for sensor in sensors_of(context.recording):
        if len(sensor.t_ns) < 4 * NEAR_ROWS:
            continue
        unit = (context.wheel_radius_m() or ANY_RADIUS_M) if sensor.field == "speed" else 1.0
        least, rate = FLOORS[sensor.field]
        floor = max(least, rate * float(np.median(np.diff(sensor.t_ns))) * 1e-9) / unit
        for k in sensor.known():
            size = _spike_sizes(sensor.values[:, k], floor)
            if size.any():
                spikes.setdefault(sensor.channel, []).append((sensor.names[k], size))
    for channel, axes in spikes.items():
        mask = np.any([size > 0.0 for _, size in axes], axis=0)
        if mask.mean() > MOST_SPIKES:
            continue
        name, size = max(axes, key=lambda axis: float(axis[1].max()))
        row = int(np.argmax(size))
        at_s = context.since_start_s(getattr(context.recording, channel).t_ns[row])
        yield Finding(
            "spikes", "warning", channel,
            f"{counted(int(mask.sum()), 'spike')} of one sample",
            f"largest {size[row]:.3g} off its neighbours, {name} at t = {at_s:.2f} s",
            "leave these samples out",
            without_rows(channel, mask),
        )  # fmt: skip


def _spike_sizes(values: Array, floor: float) -> Array:
    """Distance (N,) of spikes from the mean of their neighbours; 0 where there is none."""
    from scipy.ndimage import maximum_filter1d

    size = np.zeros(len(values))
    known = np.flatnonzero(np.isfinite(values))
    x = values[known]
    if len(x) < 4 * NEAR_ROWS:
        return size
    off = np.zeros(len(x))
    off[1:-1] = np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]))
    if not (off > floor).any():
        return size
    window = NEAR_ROWS - 1
    near = maximum_filter1d(off, window, mode="constant")
    half = window // 2 + 2
    around = np.zeros(len(x))
    around[half:] = near[:-half]
    around[:-half] = np.maximum(around[:-half], near[half:])
    step = np.zeros(len(x))
    step[1:-1] = np.abs(x[2:] - x[:-2])
    spike = (off > floor) & (off > FAR_SPIKE * around) & (step < 0.5 * off)
    size[known[spike]] = off[spike]
    return size


ZERO_ROWS, ZERO_SHARE, ZERO_S = 10, 0.02, 0.5
"""Runs and share of rows of zeros; no robot stops and is as fast as before within this time."""
ALIKE, QUANTA = 0.3, 3.0
"""Relative difference of the rows on both sides of zeros, and their size in the smallest value, a tick's."""


def check_zeros(context: CheckContext) -> Iterator[Finding]:
    """Zeros for missing values: between rows of one speed, or of gravity."""
    by_channel: dict[str, list[SensorAxes]] = {}
    for sensor in sensors_of(context.recording):
        by_channel.setdefault(sensor.channel, []).append(sensor)
    for channel, sensors in by_channel.items():
        every = np.hstack([sensor.values[:, sensor.known()] for sensor in sensors])
        known = np.flatnonzero(np.isfinite(every).all(axis=1))
        t_ns, values = sensors[0].t_ns[known], every[known]
        if len(known) < ZERO_ROWS:
            continue
        size = np.abs(values).max(axis=1, initial=0.0)
        edges = np.flatnonzero(np.diff(size == 0.0)) + 1
        edges = edges[int(size[0] == 0.0) :]
        first, after = edges[: 2 * (len(edges) // 2)].reshape(-1, 2).T
        ends = np.stack([size[first - 1], size[after]])
        short = t_ns[after] - t_ns[first - 1] < ZERO_S * 1e9
        alike = np.ptp(ends, axis=0) < ALIKE * ends.max(axis=0)
        large = ends.min(axis=0) > QUANTA * np.abs(values[values != 0.0]).min(initial=np.inf)
        mask = np.zeros(len(every), dtype=bool)
        for begin, end in zip(first[short].tolist(), after[short].tolist(), strict=True):
            mask[known[begin:end]] = True
        if (short & alike & large).sum() < ZERO_ROWS or mask.mean() < ZERO_SHARE:
            continue
        at_s = context.since_start_s(sensors[0].t_ns[int(np.argmax(mask))])
        yield Finding(
            "zero-filled", "error", channel,
            "zeros stand for missing values",
            f"{mask.mean():.0%} of the rows, within {ZERO_S:g} s of rows alike; first at t = {at_s:.2f} s",
            "leave these rows out",
            without_rows(channel, mask),
        )  # fmt: skip


MOST_ROWS = 0.2
"""Where a larger share of the rows is impossible, the unit is wrong rather than some rows."""

LONGEST_DAYS = 30.0
"""No run lasts longer; grids over such a time would not fit into memory either."""
LIMITS = {
    "command": {"mps": 100.0, "radps": 100.0},
    "wheels": {"mps": 100.0, "radps": 1000.0},
    "imu": {"radps": 100.0, "mps2": 2000.0},
    "gnss": {"m": 2e7, "mps": 1e4},
    "motor": {"a": 1e5, "v": 1e5},
    "truth": {"m": 2e7},
}
"""Magnitudes that nothing on a ground robot reaches, by channel and unit. MEMS gyros end at 70 rad/s
(4000 deg/s), accelerometers at 2000 m/s2 (200 g); projected coordinates at 1e7 m."""
UNIT_OR_COUNTS = "is the unit right, or are these counts of the sensor, which need a scale?"


def check_magnitude(context: CheckContext) -> Iterator[Finding]:
    """Values beyond `LIMITS` and durations beyond `LONGEST_DAYS`."""
    tables = _tables(context.recording)
    for name, (t_ns, _) in tables.items():
        yield from _check_duration(context, name, t_ns)
    for name, (t_ns, columns) in tables.items():
        limits = {column: LIMITS.get(name, {}).get(column.rpartition("_")[2], np.inf) for column in columns}
        limited = {column: values for column, values in columns.items() if np.isfinite(limits[column])}
        beyond = {column: np.abs(values) > limits[column] for column, values in limited.items()}
        beyond = {column: mask for column, mask in beyond.items() if mask.any()}
        if not beyond:
            continue
        column, mask = next(iter(beyond.items()))
        rows = np.logical_or.reduce(list(beyond.values()))
        first = int(np.argmax(mask))
        few = rows.sum() < MOST_ROWS * len(rows)
        yield Finding(
            "impossible-value", "error", name,
            f"{column} is {columns[column][first]:g}, beyond anything possible",
            f"at t = {context.since_start_s(t_ns[first]):.3f} s; {int(mask.sum())} of {len(mask)} values "
            f"beyond {limits[column]:g}" + (f", {int(rows.sum())} rows in all" if len(beyond) > 1 else ""),
            "leave these rows out" if few else f"{UNIT_OR_COUNTS} too many rows are wrong to leave them out",
            without_rows(name, rows) if few else None,
        )  # fmt: skip


def _check_duration(context: CheckContext, name: str, t_ns: TimesNs) -> Iterator[Finding]:
    days = (float(t_ns[-1]) - float(t_ns[0])) * 1e-9 / 86400.0
    if days > LONGEST_DAYS:
        row = int(np.argmax(np.diff(t_ns)))
        leap_s = (float(t_ns[row + 1]) - float(t_ns[row])) * 1e-9
        yield Finding(
            "impossible-time", "error", name,
            f"its times span {days:.0f} days",
            f"longest interval {leap_s:.3g} s after t = {context.since_start_s(t_ns[row]):.3f} s",
            "is the unit of time right? have the clock repaired (--repair-clock), or split the log there",
        )  # fmt: skip


def _tables(recording: Recording) -> dict[str, tuple[TimesNs, dict[str, NDArray[Any]]]]:
    """Times and columns by channel, with the positions of the truth."""
    tables: dict[str, tuple[TimesNs, dict[str, NDArray[Any]]]] = {
        name: (channel.t_ns, channel.columns()) for name, channel in recording.channels().items()
    }
    if recording.truth is not None and len(recording.truth):
        position = dict(zip(("x_m", "y_m", "z_m"), recording.truth.position_m.T, strict=True))
        tables["truth"] = recording.truth.t_ns, position
    return tables
