"""Errors that wheels, gyro and fixes share.

A wheel that turns faster than the twin's does moves and turns the robot, too, and a heading that is off moves
the fixes: one cause shows in three channels. What the measured wheels say of the turn rate, and wheels and
gyro of the fixes, is subtracted from these in proportion to gains that the references teach. What is left
are innovations: the error of a channel given those before it. The map is linear and has an inverse, so that
errors and sensitivities keep all they say; where wheels have noise of their own only, the gains are zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self
from weakref import WeakKeyDictionary

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.data.samples import Indices

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
    """Noise by channel, of what is left without the shared errors."""

    gains: SharedGains = SharedGains()

    @classmethod
    def of(cls, channels: dict[str, ResidualNoise], gains: SharedGains) -> ChannelNoise:
        """With these gains."""
        out = cls(channels)
        out.gains = gains
        return out


def gains_of(noise: Mapping[str, ResidualNoise]) -> SharedGains:
    """Those of the noise; none where it has none."""
    return noise.gains if isinstance(noise, ChannelNoise) else SharedGains()


@dataclass(frozen=True, eq=False)
class _Weights:
    """Linear interpolation of n samples at m places."""

    low: Indices
    high: Indices
    share: Array

    @classmethod
    def of(cls, known_s: Array, at_s: Array) -> Self:
        place = np.interp(at_s, known_s, np.arange(float(len(known_s))))
        low = np.minimum(place.astype(np.int64), max(len(known_s) - 2, 0))
        return cls(low, np.minimum(low + 1, len(known_s) - 1), place - low)

    def __call__(self, values: Array) -> Array:
        """Values (n, k) at the places, (m, k)."""
        share = self.share[:, None]
        return np.asarray((1.0 - share) * values[self.low] + share * values[self.high])


@dataclass(frozen=True, eq=False)
class _Grid:
    """Times (N,) every `GRID_S` in a log's windows: `window` (N,) of each, `first` (W,) of each window."""

    t_s: Array
    window: Indices
    first: Indices

    @classmethod
    def of(cls, log: PreparedLog) -> Self:
        begin_s, end_s = (log.windows * DT_S).T
        counts = np.maximum(np.round((end_s - begin_s) / GRID_S).astype(np.int64), 1)
        window, first = np.repeat(np.arange(len(counts)), counts), np.cumsum(counts) - counts
        return cls(begin_s[window] + GRID_S * (np.arange(len(window)) - first[window] + 0.5), window, first)

    def integral(self, rates: Array) -> Array:
        """Integral (N, k) of rates (N, k) in each window."""
        total = np.cumsum(GRID_S * rates, axis=0) - 0.5 * GRID_S * rates
        return np.asarray(total - total[self.first[self.window]])

    def centred_integral(self, rates: Array) -> Array:
        """The same less its mean in each window, which the window's pose holds."""
        total = self.integral(rates)
        counts = np.diff(np.append(self.first, len(total)))
        means = np.add.reduceat(total, self.first) / counts[:, None]
        return np.asarray(total - means[self.window])


@dataclass(frozen=True, eq=False)
class _Motion:
    """What a log tells of its motion.

    Attributes:
        along, across: (N, 2) unit vector of the heading, and its normal times the wheels' speed, rad/s, east
            and north, on the grid.
        wheels, gyro: interpolation at the grid; `turns` that of the wheels at the gyro's samples.
        fixes: by channel, interpolation of the grid at its samples.
    """

    grid: _Grid
    along: Array
    across: Array
    wheels: list[_Weights]
    gyro: _Weights
    turns: list[_Weights]
    fixes: dict[str, _Weights]


_CACHE: WeakKeyDictionary[PreparedLog, _Motion | None] = WeakKeyDictionary()


def _motion(log: PreparedLog) -> _Motion | None:
    """Computed once a log; None where wheels of both sides or gyro are missing."""
    if log not in _CACHE:
        _CACHE[log] = _motion_of(log)
    return _CACHE[log]


def _motion_of(log: PreparedLog) -> _Motion | None:
    by = {o.channel: o for o in log.observed}
    if not {*WHEELS, GYRO} <= set(by):
        return None
    grid, gyro_s = _Grid.of(log), _middle_s(by[GYRO])
    gyro = _Weights.of(gyro_s, grid.t_s)
    wheels = [_Weights.of(_middle_s(by[name]), grid.t_s) for name in WHEELS]
    turns = [_Weights.of(_middle_s(by[name]), gyro_s) for name in WHEELS]
    yaw = log.start[grid.window, 2] + grid.integral(gyro(by[GYRO].value[:, None]))[:, 0]
    speed = 0.5 * sum(w(by[name].value[:, None]) for w, name in zip(wheels, WHEELS, strict=True))
    along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    across = speed * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    fixes = {name: _Weights.of(grid.t_s, by[name].end_s) for pair in FIXES for name in pair if name in by}
    return _Motion(grid, along, across, wheels, gyro, turns, fixes)


def _middle_s(observed: Observed) -> Array:
    return np.asarray(0.5 * (observed.begin_s + observed.end_s))


def _shares(log: PreparedLog, motion: _Motion, columns: Sequence[Array]) -> Iterator[tuple[int, str, Array]]:
    """What wheels and gyro show of each channel, for gains of one: its number, the gain's name, (n, k)."""
    number = {o.channel: i for i, o in enumerate(log.observed)}
    left, right = (columns[number[name]] for name in WHEELS)
    at_left, at_right = motion.turns
    yield number[GYRO], "turn", at_right(right) - at_left(left)
    ahead = 0.5 * (motion.wheels[0](left) + motion.wheels[1](right))
    heading = motion.grid.centred_integral(motion.gyro(columns[number[GYRO]]))
    for places, pair in zip((True, False), FIXES, strict=True):
        for axis, name in enumerate(pair):
            if name not in motion.fixes:
                continue
            for gain, speed in (
                ("advance", motion.along[:, axis, None] * ahead),
                ("course", motion.across[:, axis, None] * heading),
            ):
                moved = motion.grid.integral(speed) if places else speed
                yield number[name], gain, motion.fixes[name](moved)


def without_shared(log: PreparedLog, gains: SharedGains, columns: Sequence[Array]) -> list[Array]:
    """Columns (n, k) of all channels, one array each, without what wheels and gyro show of them."""
    out, motion = list(columns), _motion(log)
    if motion is None or gains == SharedGains():
        return out
    for channel, gain, share in _shares(log, motion, columns):
        out[channel] = out[channel] - getattr(gains, gain) * share
    return out


def with_shared(log: PreparedLog, gains: SharedGains, columns: Sequence[Array]) -> list[Array]:
    """The columns (n, k) that `without_shared` made these of."""
    out, motion = list(columns), _motion(log)
    if motion is None or gains == SharedGains():
        return out
    turned = next(iter(_shares(log, motion, out)))
    out[turned[0]] = out[turned[0]] + gains.turn * turned[2]
    for channel, gain, share in _shares(log, motion, list(out)):
        if gain != "turn":
            out[channel] = out[channel] + getattr(gains, gain) * share
    return out


def learn_gains(errors: Iterable[tuple[PreparedLog, Sequence[Array]]]) -> SharedGains:
    """By least squares over errors of runs, one array (n,) a channel; poses of the windows take part."""
    turns, fixes = list[Array](), list[Array]()
    for log, own in errors:
        motion, parts = _motion(log), dict[int, dict[str, Array]]()
        columns = [e[:, None] for e in own]
        for channel, gain, share in () if motion is None else _shares(log, motion, columns):
            parts.setdefault(channel, {})[gain] = share[:, 0]
        for channel, shares in parts.items():
            table = np.column_stack([*shares.values(), own[channel]])
            if "turn" in shares:
                turns.append(table)
            elif log.observed[channel].channel in FIXES[0]:
                fixes.append(_without_trend(table, log.observed[channel], log))
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
