"""Errors that wheels, gyro and fixes share.

A wheel that turns faster than the twin's does moves and turns the robot, too, and a heading that is off moves
the fixes: one cause shows in three channels. What the measured wheels say of the turn rate, and wheels and
gyro of the fixes, is subtracted from these in proportion to gains that the references teach. What is left
are innovations: the error of a channel given those before it. The map is linear and has an inverse, so that
errors and sensitivities keep all they say; where wheels have noise of their own only, the gains are zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.data.samples import SampleMap, sample_map

GRID_S = 0.1  # interval at which errors are integrated
LEAST_EXPLAINED = 0.1
"""Share of a channel's squared errors that others must explain (assumed): less is chance, and would carry a
sensor's own noise over."""
WHEELS, GYRO = ("wheel_left_radps", "wheel_right_radps"), "yaw_rate_radps"
FIXES = (("gnss_east_m", "gnss_north_m"), ("gnss_v_e_mps", "gnss_v_n_mps"))


@dataclass(frozen=True)
class SharedGains:
    """How much of an error in one channel another shows.

    Attributes:
        turn: turn rate by the difference of the wheels' speeds.
        advance: speed over ground by the mean of the wheels' speeds, m.
        course: way to the side by the integral of the gyro, while the wheels turn by 1 rad, m.
    """

    turn: float = 0.0
    advance: float = 0.0
    course: float = 0.0


class ChannelNoise(dict[str, ResidualNoise]):
    """Noise by channel, of what is left without the shared errors of these gains."""

    def __init__(self, channels: Mapping[str, ResidualNoise], gains: SharedGains | None = None) -> None:
        super().__init__(channels)
        self.gains = gains or SharedGains()


_CACHE: WeakKeyDictionary[SampleMap, dict[str, Any]] = WeakKeyDictionary()


def _maps(log: PreparedLog) -> dict[str, Any]:
    """By gain, the sparse matrix (M, M) that gives what wheels and gyro show of the samples of all channels,
    for a gain of one; computed once a log, empty where wheels of both sides or gyro are missing."""
    at = sample_map(log)
    if at not in _CACHE:
        complete = {*WHEELS, GYRO} <= {o.channel for o in log.observed}
        _CACHE[at] = _maps_of(log) if complete else {}
    return _CACHE[at]


def _maps_of(log: PreparedLog) -> dict[str, Any]:
    from scipy import sparse

    values = np.concatenate([o.value for o in log.observed])
    every = sparse.identity(len(values), format="csr")
    ends = [*_ends(log), len(values)]
    own = {o.channel: every[end - len(o.value) : end] for o, end in zip(log.observed, ends, strict=True)}
    by = {o.channel: o for o in log.observed}

    def read(channel: str, at_s: Array) -> Any:
        return _interpolation(_middle_s(by[channel]), at_s) @ own[channel]

    begin_s, end_s = (log.windows * DT_S).T
    counts = np.maximum(np.round((end_s - begin_s) / GRID_S).astype(np.int64), 1).tolist()
    grid_s = np.concatenate([b + GRID_S * (np.arange(n) + 0.5) for b, n in zip(begin_s, counts, strict=True)])
    in_windows = [_integral(n) for n in counts]
    integral = sparse.block_diag(in_windows, format="csr")
    # The window's pose holds the mean.
    centred = sparse.block_diag([block - block.mean(axis=0) for block in in_windows], format="csr")
    left, right, rate = (read(channel, grid_s) for channel in (*WHEELS, GYRO))
    ahead, heading = 0.5 * (left + right), centred @ rate
    speed, yaw = ahead @ values, np.repeat(log.start[:, 2], counts) + integral @ (rate @ values)
    from_left, from_right = (read(channel, _middle_s(by[GYRO])) for channel in WHEELS)
    maps = {"turn": own[GYRO].T @ (from_right - from_left), "advance": 0.0 * every, "course": 0.0 * every}
    for pair, sums in zip(FIXES, (integral, sparse.identity(len(grid_s))), strict=True):
        axes = (np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))
        for channel, (along, across) in zip(pair, axes, strict=True):
            if channel in by:
                fixes = own[channel].T @ _interpolation(grid_s, by[channel].end_s) @ sums
                maps["advance"] += fixes @ sparse.diags(along) @ ahead
                maps["course"] += fixes @ sparse.diags(speed * across) @ heading
    return maps


def _interpolation(known_s: Array, at_s: Array) -> Any:
    """Sparse matrix (m, n): linear interpolation of n samples at m times, constant beyond the ends."""
    from scipy import sparse

    place = np.interp(at_s, known_s, np.arange(float(len(known_s))))
    low = np.minimum(place.astype(np.int64), max(len(known_s) - 2, 0))
    columns = np.stack([low, np.minimum(low + 1, len(known_s) - 1)], axis=1)
    weights = np.stack([1.0 - (place - low), place - low], axis=1)
    rows = np.repeat(np.arange(len(at_s)), 2)
    return sparse.csr_matrix((weights.ravel(), (rows, columns.ravel())), shape=(len(at_s), len(known_s)))


def _integral(count: int) -> Array:
    """Matrix (n, n): integral in time of rates every `GRID_S`, by trapezoids, from the first on."""
    out = GRID_S * (np.tri(count) - 0.5 * np.eye(count))
    out[:, 0] -= 0.5 * GRID_S
    return np.asarray(out)


def _middle_s(observed: Observed) -> Array:
    return np.asarray(0.5 * (observed.begin_s + observed.end_s))


def _ends(log: PreparedLog) -> list[int]:
    """Where one channel ends and the next begins among the samples of all."""
    return np.cumsum([len(o.value) for o in log.observed])[:-1].tolist()


def without_shared(log: PreparedLog, gains: SharedGains, columns: Sequence[Array]) -> list[Array]:
    """Columns (n, k) of all channels, one array each, without what wheels and gyro show of them."""
    maps = _maps(log) if gains != SharedGains() else {}
    if not maps:
        return list(columns)
    whole = np.concatenate(columns)
    shown = sum(gain * (maps[name] @ whole) for name, gain in vars(gains).items())
    return np.split(whole - shown, _ends(log))


def with_shared(log: PreparedLog, gains: SharedGains, columns: Sequence[Array]) -> list[Array]:
    """The columns (n, k) that `without_shared` made these of."""
    maps = _maps(log) if gains != SharedGains() else {}
    if not maps:
        return list(columns)
    whole = np.concatenate(columns)
    whole = whole + gains.turn * (maps["turn"] @ whole)  # the gyro's, which the fixes' need
    shown = gains.advance * (maps["advance"] @ whole) + gains.course * (maps["course"] @ whole)
    return np.split(whole + shown, _ends(log))


def learn_gains(errors: Iterable[tuple[PreparedLog, Sequence[Array]]]) -> SharedGains:
    """By least squares over errors of runs, one array (n,) a channel; poses of the windows take part."""
    turns, fixes = list[Array](), list[Array]()
    for log, own in errors:
        maps, whole = _maps(log), np.concatenate(own)
        table = np.column_stack([*(shown @ whole for shown in maps.values()), whole])
        for observed, rows in zip(log.observed, np.split(table, _ends(log)) if maps else (), strict=False):
            if observed.channel == GYRO:
                turns.append(rows[:, [0, -1]])
            elif observed.channel in FIXES[0]:
                fixes.append(_without_trend(rows[:, 1:], observed, log))
    turn, by_fixes = _gains(turns, 1), _gains(fixes, 2)
    return SharedGains(turn[0], *by_fixes)


def _gains(tables: Sequence[Array], count: int) -> list[float]:
    """Least squares of the last column (n,) by the `count` others; zero where they explain too little."""
    table = np.concatenate(tables) if tables else np.zeros((1, count + 1))
    by, error = table[:, :-1], table[:, -1]
    gains = np.linalg.lstsq(by, error, rcond=None)[0]
    rest = error - by @ gains
    explained = 1.0 - float(rest @ rest) / max(float(error @ error), 1e-300)
    return gains.tolist() if explained > LEAST_EXPLAINED else [0.0] * count


def _without_trend(table: Array, observed: Observed, log: PreparedLog) -> Array:
    """Columns (n, k) less a line in time in each window, which its pose could hold."""
    out, windows = table.copy(), window_of(observed, log.windows)
    for k in np.unique(windows):
        mine = windows == k
        line = np.column_stack([np.ones(mine.sum()), observed.end_s[mine]])
        out[mine] -= line @ np.linalg.lstsq(line, out[mine], rcond=None)[0]
    return out
