"""A recording prepared for the fit: input of the twin, ground over time, windows and their start poses.

The start pose of a window is a guess from dead reckoning aligned to the positions of the log.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.inputs import DT_S, MOVING_RADPS, Commanded, twin_input
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed, observe
from terrafusion.twin.model.motion import plane_rotation
from terrafusion.twin.model.vehicle import VehicleParams

START_S = 1.0
"""The first second of a log that starts on the move, or of the motion on a slope, is not compared: how soil,
brakes and motors shared the load is not known."""
LEAST_ROWS = 4
"""A channel with fewer rows is left out."""
AROUND_S = 15.0
"""The heading at a window's start is that of the track this long before and after."""
LEAST_SPREAD = 5.0
"""A track gives a heading when it spreads over this many sigma of its positions."""
LATEST_S, UNEXPLAINED = 1.0, 0.4
"""Delays of the wheels up to the first are tried; the best one counts where it leaves less than this share of
the squared difference between commands and wheels."""


@dataclass(frozen=True, eq=False)
class PreparedLog:
    """One run as the fit uses it; times in seconds from the first input, on a grid of `inputs.DT_S`.

    Attributes:
        sides: (N + 1, 2) wheel speeds of left and right, rad/s, before any dead time.
        follows: whether the twin's wheels follow measured ones.
        labels, borders: grounds in the order driven, and the times (K - 1,) between them.
        windows: (W, 2) first and last grid sample of each window; each starts where the one before ends.
        start: (W, 3) x, y, yaw in the plane at each window's start, a guess from the data.
        observed: the channels.
        posed: whether the log determines the heading.
        notes: what was assumed, in sentences.
        input_step_s: time between two commands, between which a change may lie anywhere; 0 where the wheels
            are followed.
        commanded: what `sides` come from; None for measured speeds and simulated drives.
    """

    name: str
    sides: Array
    follows: bool
    labels: tuple[str, ...]
    borders: Array
    windows: NDArray[np.int64]
    start: Array
    observed: tuple[Observed, ...]
    posed: bool
    notes: tuple[str, ...]
    input_step_s: float = 0.0
    commanded: Commanded | None = None

    def driven_by(self, vehicle: VehicleParams) -> Self:
        """The log with the commands within the limits of a twin."""
        if self.commanded is None:
            return self
        return dataclasses.replace(self, sides=self.commanded.sides(vehicle))

    def lateness_s(self, dead_time_s: float) -> float | None:
        """By how much longer than the dead time the wheels follow the commands; None where no delay explains
        most of what commands and wheels differ by."""
        names = ("wheel_left_radps", "wheel_right_radps")
        sides = [(o, self.sides[:, names.index(o.channel)]) for o in self.observed if o.channel in names]
        if self.follows or len(sides) < len(names):
            return None
        grid, lags = DT_S * np.arange(len(self.sides)), np.arange(0.0, LATEST_S, 2.0 * DT_S)
        middles = [0.5 * (o.begin_s + o.end_s) - dead_time_s for o, _ in sides]
        left = [
            sum(
                float(np.sum((np.interp(t_s - lag, grid, side) - o.value) ** 2))
                for t_s, (o, side) in zip(middles, sides, strict=True)
            )
            for lag in lags
        ]
        best = int(np.argmin(left))
        return float(lags[best]) if left[best] < UNEXPLAINED * left[0] else None

    def seconds(self) -> float:
        """Length of what is compared, s."""
        return float(self.windows[-1, 1] - self.windows[0, 0]) * DT_S

    def samples(self, every: int = 1) -> NDArray[np.int64]:
        """Each n-th grid sample of all windows in turn; a border belongs to both."""
        return np.concatenate([np.arange(first, last + 1, every) for first, last in self.windows])

    def first_samples(self) -> NDArray[np.int64]:
        """Index (W + 1,) of each window's first sample among those of all windows."""
        return np.cumsum(np.append(0, np.diff(self.windows, axis=1).ravel() + 1))


def prepare(
    recording: Recording,
    model: Model,
    *,
    source: str = "auto",
    truth: bool = False,
    window_s: float = 10.0,
    ground: str | None = None,
    channels: tuple[str, ...] | None = None,
) -> PreparedLog:
    """The log, prepared.

    Args:
        source: one of `inputs.SOURCES`.
        truth: use the reference pose as a measurement.
        ground: name of the ground all along; None: the log's own labels.
        channels: use only these, by name or beginning of a name.

    Raises:
        DataError: no input, or nothing to compare the twin with.
    """
    given = twin_input(recording, model.vehicle, source)
    notes = list(given.notes)
    observed = observe(
        recording, model.vehicle, given.start_ns, wheels=given.commanded is not None, truth=truth
    )
    if channels is not None:
        observed = tuple(o for o in observed if o.channel.startswith(channels))
    ends = [float(o.end_s[-1]) for o in observed]
    end_s = min(given.end_s(), max(ends, default=0.0))
    windows = split_windows(_begin_s(given.sides, model.slope_rad), end_s, window_s)
    named = [o.channel for o in observed]
    within = (_within(o, windows, given.gaps) for o in observed)
    observed = tuple(o for o in within if len(o.value) >= LEAST_ROWS)
    if lost := [name for name in named if name not in {o.channel for o in observed}]:
        notes.append(f"left out, with less than {LEAST_ROWS} rows while the twin drives: {', '.join(lost)}")
    if not observed:
        raise DataError(
            "nothing in the log can be compared with the twin",
            file=recording.name,
            remedy="it needs wheels, an IMU, GNSS or motor currents beside what drives the twin",
        )
    labels, borders = grounds(recording, given.start_ns) if ground is None else ((ground,), np.zeros(0))
    at_s: Array = windows[:, 0].astype(float) * DT_S
    start, posed = window_starts(recording, model, given.start_ns, at_s, window_s, truth=truth)
    if model.slope_rad > 0.0 and not posed:
        notes.append("on a slope, and nothing in the log determines the heading: taken as 0 at the start")
    return PreparedLog(
        recording.name, given.sides, given.commanded is None, labels, borders, windows, start, observed,
        posed, tuple(notes), given.step_s, given.commanded,
    )  # fmt: skip


def _begin_s(sides: Array, slope_rad: float) -> float:
    """Time from which the log is compared."""
    moving = np.abs(sides).max(axis=1) > MOVING_RADPS
    if moving[0]:
        return START_S
    return START_S + float(np.argmax(moving)) * DT_S if slope_rad > 0.0 and moving.any() else 0.0


def grounds(recording: Recording, start_ns: int) -> tuple[tuple[str, ...], Array]:
    """Grounds in the order driven, and the times between them in seconds from `start_ns`."""
    terrain = recording.terrain
    if terrain is None or not len(terrain):
        return (recording.terrain_name,), np.zeros(0)
    label = np.asarray(terrain.label, dtype=str)
    change = np.flatnonzero(label[1:] != label[:-1]) + 1
    middle = (
        terrain.t_ns[change - 1] - start_ns + (terrain.t_ns[change] - terrain.t_ns[change - 1]) // 2
    ) * 1e-9
    return (str(label[0]), *(str(x) for x in label[change])), np.asarray(middle)


def split_windows(begin_s: float, end_s: float, window_s: float) -> NDArray[np.int64]:
    """First and last grid sample (W, 2) of the windows; a remainder of half the length is one, too."""
    first, last, size = round(begin_s / DT_S), int(end_s / DT_S + 1e-6), max(2, round(window_s / DT_S))
    edges = np.arange(first, max(last, first) + 1, size)
    if len(edges) == 1 or last - edges[-1] >= size // 2:
        edges = np.append(edges, last)
    return np.stack([edges[:-1], np.maximum(edges[1:], edges[:-1])], axis=1)


def _within(observed: Observed, windows: NDArray[np.int64], gaps: Array) -> Observed:
    """The rows that lie in one window each and touch no gap of the input."""
    starts, stops = windows[:, 0] * DT_S - 1e-6, windows[:, 1] * DT_S + 1e-6
    k = np.clip(window_of(observed, windows), 0, len(windows) - 1)
    inside = (observed.begin_s >= starts[k]) & (observed.end_s <= stops[k])
    for begin, end in gaps:
        inside &= (observed.end_s < begin) | (observed.begin_s > end)
    return observed.select(inside)


def window_of(observed: Observed, windows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (n,) of the window in which each row begins; an instant on a border belongs to the later one,
    a mean over an interval to the one the interval lies in."""
    middle = 0.5 * (observed.begin_s + observed.end_s)
    return np.searchsorted(windows[:, 0] * DT_S, middle + 1e-9, side="right") - 1


def window_starts(
    recording: Recording, model: Model, start_ns: int, at_s: Array, window_s: float, *, truth: bool
) -> tuple[Array, bool]:
    """x, y, yaw (W, 3) in the plane at the times `at_s` (W,), and whether the log determines the heading.

    Wheels and gyro give a path up to a rotation and a translation; positions around each window (or those of
    the whole log, where the robot moves too little there) give these two. Without positions a reference yaw
    is used.
    """
    rows = {o.channel: o for o in observe(recording, model.vehicle, start_ns, wheels=True, truth=truth)}
    end_s = max([float(at_s[-1]), *(float(o.end_s[-1]) for o in rows.values())]) + window_s
    grid: Array = DT_S * np.arange(math.ceil(end_s / DT_S) + 1.0)
    yaw, path = _dead_reckoned(rows, model, grid)
    out = np.zeros((len(at_s), 3))
    out[:, 2] = np.interp(at_s, grid, yaw)
    pair = next(((rows[e], rows[n]) for e, n in _PAIRS if e in rows and n in rows), None)
    if pair is not None and len(pair[0].value) == len(pair[1].value):
        t_s = pair[0].end_s
        fixes = np.stack([pair[0].value, pair[1].value], axis=1)
        fixes = fixes @ np.linalg.inv(plane_rotation(model.slope_rad, model.aspect_rad)[:2, :2]).T
        reckoned = np.stack([np.interp(t_s, grid, path[:, i]) for i in range(2)], axis=1)
        sigma = float(np.median(pair[0].sigma))
        overall = _turn(reckoned, fixes, sigma)
        for k, t in enumerate(at_s):
            near = (t_s > t - AROUND_S) & (t_s < t + window_s + AROUND_S)
            turn = _turn(reckoned[near], fixes[near], sigma)
            out[k, 2] += (turn if turn is not None else overall) or 0.0
        out[:, :2] = np.stack([np.interp(at_s, t_s, fixes[:, i]) for i in range(2)], axis=1)
        if overall is not None:
            return out, True
    if "truth_yaw_rad" in rows:
        seen = rows["truth_yaw_rad"]
        out[:, 2] = np.interp(at_s, seen.end_s, seen.value)
        return out, True
    return out, False


_PAIRS = (("truth_east_m", "truth_north_m"), ("gnss_east_m", "gnss_north_m"))


def _dead_reckoned(rows: Mapping[str, Observed], model: Model, grid: Array) -> tuple[Array, Array]:
    """Yaw (N,) and path (N, 2) from wheels and gyro, starting at zero."""

    def series(name: str) -> Array | None:
        row = rows.get(name)
        return None if row is None else np.interp(grid, 0.5 * (row.begin_s + row.end_s), row.value)

    odometry = model.vehicle.odometry
    left, right, mean = series("wheel_left_radps"), series("wheel_right_radps"), series("wheel_mean_radps")
    rate = series("yaw_rate_radps")
    speed = np.zeros_like(grid)
    if left is not None and right is not None:
        speed = 0.5 * odometry.wheel_radius_m * (left + right)
        if rate is None:
            rate = odometry.wheel_radius_m * (right - left) / odometry.track_m
    elif mean is not None:
        speed = odometry.wheel_radius_m * mean
    yaw = DT_S * np.cumsum(rate) if rate is not None else np.zeros_like(grid)
    path = DT_S * np.cumsum(speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
    return yaw, path


def _turn(reckoned: Array, fixes: Array, sigma: float) -> float | None:
    """Angle that rotates the first path (n, 2) onto the second (least squares); None for short paths."""
    if len(fixes) < 4:
        return None
    a, b = reckoned - reckoned.mean(axis=0), fixes - fixes.mean(axis=0)
    if math.sqrt(min(float((a**2).sum()), float((b**2).sum())) / len(a)) < LEAST_SPREAD * sigma:
        return None
    return math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
