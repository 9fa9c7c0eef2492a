"""Single numbers that a sensor cannot have measured: clipped values and spikes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.signals import Group, groups_of, stuck_cells
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLIPPED_SHARE, CLIPPED_ROWS, PILE = 0.002, 10, 5.0
"""So many values are exactly the extreme one, and so many times more than on each value next to it."""
LEAST_STEPS = 50
"""Signals of fewer distinct values are too coarse to tell."""
FAR_SPIKE = 6.0
"""A spike stands so many times further out than anything near it."""
NEAR_ROWS = 12
MOST_SPIKES = 0.02
FLOORS = {"gyro_radps": (0.5, 30.0), "accel_mps2": (150.0, 0.0), "speed": (0.5, 15.0)}
"""Least size of a spike, and what a robot reaches a second at most: rad/s, m/s2 and m/s. A stone under a
wheel shakes a Husky by 100 m/s2 for one sample of 100 Hz (BorealTC)."""


def check_saturated(context: CheckContext) -> Iterator[Finding]:
    """Inertial sensors must not stand at the end of their range."""
    found = []
    for group in groups_of(context.recording):
        mask = _clipped(group) if group.channel == "imu" else np.zeros(0, dtype=bool)
        if mask.any():
            found.append((group, mask))
    if not found:
        return
    said = [
        f"{group.names[k]} {int(mask[:, k].sum())} times at {_extremes(group.values[mask[:, k], k])}"
        for group, mask in found
        for k in np.flatnonzero(mask.any(axis=0))
    ]
    yield Finding(
        "saturated",
        "warning",
        "imu",
        "values stand at the end of a range",
        f"{'; '.join(said)}; nothing lies beyond",
        "empty these cells: the true values are larger, nobody knows by how much",
        _emptied([(group.field, mask) for group, mask in found]),
    )


def _extremes(values: Array) -> str:
    return " and ".join(f"{value:.4g}" for value in np.unique(values))


def _clipped(group: Group) -> Mask:
    """Mask (N, 3) of the cells at the extreme of an axis where many are exactly there."""
    mask = np.zeros(group.values.shape, dtype=bool)
    stuck = stuck_cells(group)
    for k in group.known():
        values = np.where(stuck[:, k], np.nan, group.values[:, k])
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
    """Whether values stand at the top far more often than next to it, in a signal that is fine enough."""
    below = values[values < top]
    near, counts = (
        np.unique(below[below >= np.quantile(below, 0.9)], return_counts=True) if below.size else ((), ())
    )
    if len(near) < 5 or len(np.unique(below[:: max(len(below) // 2000, 1)])) < LEAST_STEPS:
        return False
    return count > PILE * float(np.mean(counts[-5:]))


def _emptied(cells: list[tuple[str, Mask]]) -> Repair:
    def repair(recording: Recording) -> Recording:
        assert recording.imu is not None
        emptied = {field: np.where(mask, np.nan, getattr(recording.imu, field)) for field, mask in cells}
        return dataclasses.replace(recording, imu=dataclasses.replace(recording.imu, **emptied))

    return repair


def check_spikes(context: CheckContext) -> Iterator[Finding]:
    """Single samples far from those before and after."""
    found: dict[str, Mask] = {}
    largest: dict[str, tuple[float, str, int]] = {}
    for group in groups_of(context.recording):
        if len(group.t_ns) < 4 * NEAR_ROWS:
            continue
        unit = (context.wheel_radius_m() or 0.15) if group.field == "speed" else 1.0
        least, rate = FLOORS[group.field]
        floor = max(least, rate * float(np.median(np.diff(group.t_ns))) * 1e-9) / unit
        for k in group.known():
            size = _spike_sizes(group.values[:, k], floor)
            if not size.any():
                continue
            row = int(np.argmax(size))
            found[group.channel] = found.get(group.channel, np.zeros(len(size), dtype=bool)) | (size > 0.0)
            if size[row] > largest.get(group.channel, (0.0, "", 0))[0]:
                largest[group.channel] = float(size[row]), group.names[k], row
    for channel, mask in found.items():
        if mask.mean() > MOST_SPIKES:
            continue
        size_, name, row = largest[channel]
        count = int(mask.sum())
        at_s = context.since_start_s(getattr(context.recording, channel).t_ns[row])

        def repair(recording: Recording, channel: str = channel, mask: Mask = mask) -> Recording:
            return dataclasses.replace(recording, **{channel: getattr(recording, channel).select(~mask)})

        yield Finding(
            "spikes",
            "warning",
            channel,
            f"{count} spike{'s' if count > 1 else ''} of one sample",
            f"largest {size_:.3g} off its neighbours, {name} at t = {at_s:.2f} s",
            "leave these samples out",
            repair,
        )


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
