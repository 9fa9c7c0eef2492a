"""Signals that a sensor cannot have made: held values, axes that are stuck or dead, missing cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, Finding, Repair
from terrafusion.datasets.checks.yaw_sources import yaw_rates
from terrafusion.datasets.core.channels import Channel, Imu, Wheels
from terrafusion.datasets.core.conventions import true_updates
from terrafusion.datasets.core.lag import held_rows
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
TimesNs = NDArray[np.int64]

HELD_SHARE, LEAST_UPDATES = 0.5, 10
STUCK_S, STUCK_ZERO_S, STUCK_ROWS = 2.0, 5.0, 20
"""A value that stays for so long, and so many updates, is stuck; wheels may well stand a while."""
CLIPPED_ROWS = 10
"""A value at the end of the range that is met so often elsewhere is the end of the sensor's."""
LIVELY = 0.1
"""Spread of the other axes beside their usual one from which on they move."""
LEAST_TURN_RADPS, LEAST_EXTENT_M = 0.05, 5.0
MISSING_SHARE = 0.05


@dataclass(frozen=True)
class Group:
    """Axes of one sensor: `values` (N, k) in the field `field` of a channel."""

    channel: str
    field: str
    names: tuple[str, ...]
    t_ns: TimesNs
    values: Array

    def known(self) -> list[int]:
        """Axes that the log has."""
        return [k for k in range(self.values.shape[1]) if np.isfinite(self.values[:, k]).any()]


def groups_of(recording: Recording) -> list[Group]:
    """Gyro, accelerometer and wheels, where they are there."""
    found = []
    imu, wheels = recording.imu, recording.wheels
    if imu is not None and len(imu):
        found.append(Group("imu", "gyro_radps", ("gyro x", "gyro y", "gyro z"), imu.t_ns, imu.gyro_radps))
        found.append(Group("imu", "accel_mps2", ("accel x", "accel y", "accel z"), imu.t_ns, imu.accel_mps2))
    if wheels is not None and len(wheels):
        names = tuple(name.replace("_", " ") for name in wheels.names)
        found.append(Group("wheels", "speed", names, wheels.t_ns, wheels.speed))
    return found


def check_held(context: CheckContext) -> Iterator[Finding]:
    """Values repeated between true samples: the rate of the log is not the rate of the sensor."""
    for name, channel in context.recording.channels().items():
        values = _sensed(channel)
        share, run = _held_share(channel.t_ns, values)
        rows = held_rows(values)
        if share <= HELD_SHARE or rows == 1:  # runs of any length are those of a coarse signal
            continue

        def repair(recording: Recording, name: str = name, rows: int = rows) -> Recording:
            channel = getattr(recording, name)
            return dataclasses.replace(
                recording, **{name: channel.select(true_updates(_sensed(channel), rows))}
            )

        yield Finding(
            "held-values",
            "warning",
            name,
            "values are held",
            f"{share:.0%} of the samples repeat the one before while the signal changes; "
            f"a new value comes every {run:.1f} samples",
            "keep the true updates: the first row of each run, and every so many rows where nothing changes",
            repair,
        )


def _sensed(channel: Channel) -> Array:
    """What a channel measured (N, k), without the axes that it lacks; none for other channels."""
    values = np.zeros((len(channel), 0))
    if isinstance(channel, Imu):
        values = np.hstack([channel.gyro_radps, channel.accel_mps2])
    elif isinstance(channel, Wheels):
        values = channel.speed
    elif channel.name == "gnss":
        values = getattr(channel, "enu_m", values)
    return np.asarray(values[:, np.isfinite(values).any(axis=0)])


def _held_share(t_ns: TimesNs, values: Array) -> tuple[float, float]:
    """Share of repeats among samples inside a change, and the mean run length there."""
    values = np.nan_to_num(values)
    if len(values) < 50 or not values.size:
        return 0.0, 1.0
    period = max(float(np.median(np.diff(t_ns))) * 1e-9, 1e-4)
    reach = int(np.clip(round(0.5 / period), 3, 500))
    spread = np.percentile(values, 95, axis=0) - np.percentile(values, 5, axis=0)
    across = np.abs(values[2 * reach :] - values[: -2 * reach])
    changing = np.any(across > 0.1 * np.where(spread > 0, spread, np.inf), axis=1)
    same = np.all(values[reach:-reach] == values[reach - 1 : -reach - 1], axis=1)
    if changing.sum() < 20 or (~same[changing]).sum() < LEAST_UPDATES:
        return 0.0, 1.0
    share = float(same[changing].mean())
    return share, 1.0 / max(1.0 - share, 1e-3)


def check_stuck(context: CheckContext) -> Iterator[Finding]:
    """Axes that keep one value while the others of their sensor move."""
    stuck: dict[str, list[tuple[Group, Mask]]] = {}
    for group in groups_of(context.recording):
        mask = stuck_cells(group)
        if mask.any():
            stuck.setdefault(group.channel, []).append((group, mask))
    for channel, found in stuck.items():
        said = [
            _told(context, group, mask, k)
            for group, mask in found
            for k in np.flatnonzero(mask.any(axis=0)).tolist()
        ]
        yield Finding(
            "stuck",
            "error",
            channel,
            f"{' and '.join(name for name, _ in said)} {'keeps' if len(said) == 1 else 'keep'} one value",
            "; ".join(evidence for _, evidence in said) + "; the other axes move meanwhile",
            "leave these rows out" if channel == "wheels" else "empty these cells: nobody knows what it was",
            _without([(group.field, mask) for group, mask in found], channel),
        )


def _told(context: CheckContext, group: Group, mask: Mask, k: int) -> tuple[str, str]:
    rows = np.flatnonzero(mask[:, k])
    first, last = (context.since_start_s(group.t_ns[row]) for row in (rows[0], rows[-1]))
    return group.names[
        k
    ], f"{group.names[k]} is {group.values[rows[0], k]:.4g} from {first:.2f} to {last:.2f} s"


def without_stuck(recording: Recording) -> Recording:
    """The recording with the cells of stuck axes empty."""
    for group in groups_of(recording):
        mask = stuck_cells(group)
        if mask.any():
            channel = getattr(recording, group.channel)
            emptied = dataclasses.replace(channel, **{group.field: np.where(mask, np.nan, group.values)})
            recording = dataclasses.replace(recording, **{group.channel: emptied})
    return recording


def stuck_cells(group: Group) -> Mask:
    """Mask (N, k) of the cells of stuck axes."""
    mask = np.zeros(group.values.shape, dtype=bool)
    known = group.known()
    if len(known) < 2 or len(group.values) < 2 * STUCK_ROWS:
        return mask
    keep = np.flatnonzero(true_updates(group.values[:, known], held_rows(group.values[:, known])))
    t_s, values = (group.t_ns[keep] - group.t_ns[0]) * 1e-9, group.values[keep]
    same = values[1:] == values[:-1]
    usual = _spreads(values)
    moving = [k for k in known if same[:, k].mean() < 0.5]
    whole = [k for k in known if same[:, k].all()]
    for k in known:
        others = [o for o in moving if o != k]
        if k in whole:
            mask[:, k] = _is_odd(group, k, whole, others)
            continue
        for first, last in _runs(same[:, k]):
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
    """Whether a run stands at the end of a range that the signal reaches at other times too."""
    value, known = values[first], values[np.isfinite(values)]
    elsewhere = int((known == value).sum()) - (last - first + 1)
    return elsewhere >= CLIPPED_ROWS and value in (known.min(), known.max())


def _spreads(values: Array) -> Array:
    """Standard deviations of the known values of each column; 0 where there is none."""
    known = np.isfinite(values)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, values, 0.0).sum(axis=0) / count
    return np.asarray(np.sqrt(np.where(known, (values - mean) ** 2, 0.0).sum(axis=0) / count))


def _is_odd(group: Group, k: int, whole: list[int], moving: list[int]) -> bool:
    """Whether an axis that is constant all along is stuck: of three one, which no planar log leaves out."""
    if group.channel == "wheels" or len(group.known()) < 3:
        return False
    return len(whole) == 1 and len(moving) == 2 and not (group.field == "accel_mps2" and k == 2)


def _runs(same: Mask) -> list[tuple[int, int]]:
    """First and last row of the longest runs of equal values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    longest = np.sort(np.argsort(begins - ends, kind="stable")[:20])
    return [(int(begins[i]), int(ends[i])) for i in longest]


def _without(cells: list[tuple[str, Mask]], channel: str) -> Repair:
    """A repair that empties cells of an IMU, and leaves out such rows of the wheels."""

    def repair(recording: Recording) -> Recording:
        before = getattr(recording, channel)
        if channel == "wheels":
            return dataclasses.replace(recording, wheels=before.select(~cells[0][1].any(axis=1)))
        emptied = {field: np.where(mask, np.nan, getattr(before, field)) for field, mask in cells}
        return dataclasses.replace(recording, **{channel: dataclasses.replace(before, **emptied)})

    return repair


def check_dead(context: CheckContext) -> Iterator[Finding]:
    """Sensors that say nothing all along while the robot moves."""
    recording = context.recording
    imu, wheels = recording.imu, recording.wheels
    if wheels is not None and len(wheels) >= STUCK_ROWS and not np.nan_to_num(wheels.speed).any():
        extent_m = _extent_m(recording)
        if extent_m > LEAST_EXTENT_M:
            yield Finding(
                "dead",
                "error",
                "wheels",
                "the wheels stand all along",
                f"every speed is zero on a way over {extent_m:.0f} m",
                "leave the wheels out",
                lambda recording: dataclasses.replace(recording, wheels=None),
            )
    if imu is None or len(imu) < STUCK_ROWS or np.isnan(imu.gyro_radps[:, 2]).all():
        return
    constant = [bool((v[1:] == v[:-1]).all()) for v in imu.gyro_radps.T if np.isfinite(v).any()]
    lively = [bool((v[1:] != v[:-1]).mean() > 0.5) for v in imu.accel_mps2.T if np.isfinite(v).any()]
    turn = _turn_radps(context)
    still = (
        wheels is not None
        and not np.nan_to_num(wheels.speed).any()
        and _extent_m(recording) <= LEAST_EXTENT_M
    )
    if all(constant) and not still and (turn > LEAST_TURN_RADPS or (len(lively) == 3 and all(lively))):
        yield Finding(
            "dead",
            "error",
            "imu",
            "the gyro says nothing",
            f"gyro z is {imu.gyro_radps[0, 2]:g} rad/s all along, while the robot drives",
            "leave the gyro out",
            _without([("gyro_radps", np.ones((len(imu), 3), dtype=bool))], "imu"),
        )


def _extent_m(recording: Recording) -> float:
    """Diagonal of the box about the fixes or the truth, where it is far above their sigma; else 0."""
    extents = [0.0]
    gnss, truth = recording.gnss, recording.truth
    if gnss is not None:
        sigma = gnss.sigma_enu_m[:, :2]
        noise = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else np.inf
        extents.append(_diagonal_m(gnss.enu_m) if _diagonal_m(gnss.enu_m) > 10.0 * noise else 0.0)
    if truth is not None:
        extents.append(_diagonal_m(truth.position_m))
    return max(extents)


def _diagonal_m(position_m: Array) -> float:
    known = position_m[np.isfinite(position_m[:, :2]).all(axis=1), :2]
    return float(np.hypot(*np.ptp(known, axis=0))) if len(known) else 0.0


def _turn_radps(context: CheckContext) -> float:
    """Root mean square of the yaw rate that truth, or wheels on a track of 1 m, tell; 0 where none does."""
    accounts = yaw_rates(context.recording, context.wheel_radius_m() or 0.15)
    told = [accounts[name][1] for name in ("truth", "wheels") if name in accounts]
    return float(np.sqrt(np.nanmean(told[0] ** 2))) if told else 0.0


def check_missing(context: CheckContext) -> Iterator[Finding]:
    """Cells without a number in columns that have some."""
    for name, channel in context.recording.channels().items():
        if name not in ("command", "wheels", "imu", "motor") or len(channel) < STUCK_ROWS:
            continue
        columns = {c: np.isnan(v) for c, v in channel.columns().items() if v.dtype.kind == "f"}
        share = {column: float(empty.mean()) for column, empty in columns.items() if not empty.all()}
        if not share or max(share.values()) <= MISSING_SHARE:
            continue
        worst = max(share, key=lambda column: share[column])
        empty = np.all([columns[column] for column in share], axis=0)
        whole_rows = empty.mean() >= max(share.values())

        def repair(recording: Recording, name: str = name, empty: Mask = empty) -> Recording:
            return dataclasses.replace(recording, **{name: getattr(recording, name).select(~empty)})

        yield Finding(
            "missing-values",
            "warning",
            name,
            f"{share[worst]:.0%} of {worst} is missing",
            f"{sum(value > 0 for value in share.values())} of {len(share)} columns have empty cells",
            "leave the empty rows out"
            if whole_rows
            else "expect larger uncertainty there: nobody knows them",
            repair if whole_rows else None,
        )
