"""Tracks that turn as the gyro measured.

A twin that turns a few per cent more than the robot is soon off its heading, and its track then errs by more
than derivatives can tell. So the fixes are predicted with the twin's way along the robot's measured heading:
each step of the track is turned by what gyro and twin have turned apart since the window began, as far as the
gyro's noise is small. What the twin turns wrongly shows in the gyro alone, what the gyro measures wrongly in
the fixes. Nothing is lost: the map from gyro and fixes to these has an inverse.
"""

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.data.poses import EAST_NORTH, tracks, window_index
from terrafusion.twin.gap.data.samples import Indices, interpolated

GYRO = "yaw_rate_radps"
UNSURE_RAD = 0.05
"""1 sigma of the angle that the gyro's noise makes in a window at which half of what it shows is used
(assumed)."""
NORMAL_MEDIAN = 0.455  # median square of a standard normal deviate


def turned_apart(log: PreparedLog, values: Sequence[Array], at: int) -> Array:
    """Angle (n,), rad, by which the robot has turned further than predicted since its window began, at the
    samples of channel `at`; zero without a gyro. `values` is one array a channel."""
    gyro = _gyro(log)
    if gyro is None:
        return np.zeros(len(log.observed[at].value))
    return _integral(log, gyro, at, (log.observed[gyro].value - values[gyro])[:, None])[:, 0]


def as_measured(log: PreparedLog, values: Sequence[Array], channels: Sequence[Array]) -> list[Array]:
    """Channels (n, ...), their tracks turned as the gyro measured; `values` (n,) are what is predicted."""
    out = list(channels)
    for pair, east, north, _ in tracks(log):
        turn = np.exp(1j * turned_apart(log, values, east)).reshape(-1, *[1] * (channels[east].ndim - 1))
        track = channels[east] + 1j * channels[north]
        if pair == EAST_NORTH[1]:
            track = turn * track
        else:
            track = track + _sums(log, east, (_between(turn) - 1.0) * _steps(track))
        out[east], out[north] = track.real, track.imag
    return out


def with_heading_errors(log: PreparedLog, values: Sequence[Array], columns: Sequence[Array]) -> list[Array]:
    """Columns (n, k) of all channels, to those of the tracks added what a gyro that shows its own does to
    `values` (n,), which are turned as measured."""
    gyro, out = _gyro(log), list(columns)
    if gyro is None:
        return out
    for pair, east, north, _ in tracks(log):
        angle = _integral(log, gyro, east, columns[gyro])
        track = (values[east] + 1j * values[north])[:, None]
        moved = angle * track if pair == EAST_NORTH[1] else _sums(log, east, _between(angle) * _steps(track))
        out[east], out[north] = columns[east] + moved.imag, columns[north] - moved.real
    return out


def _gyro(log: PreparedLog) -> int | None:
    return next((i for i, o in enumerate(log.observed) if o.channel == GYRO), None)


def _integral(log: PreparedLog, gyro: int, at: int, rates: Array) -> Array:
    """Integral (n, k) of the gyro's rates (m, k) from each window's start to the samples of a channel."""
    rate, fix = log.observed[gyro], log.observed[at]
    of_rate, of_fix = window_index(log, gyro), window_index(log, at)
    out = np.zeros((len(fix.value), rates.shape[1]), dtype=rates.dtype)
    for k in np.unique(of_fix):
        mine, there = np.flatnonzero(of_rate == k), np.flatnonzero(of_fix == k)
        if len(mine):
            # A rate holds from its sample's begin to the next one's.
            edges = np.append(rate.begin_s[mine], rate.end_s[mine[-1]])
            angle = _trust(rate, mine) * np.cumsum(np.diff(edges)[:, None] * rates[mine], axis=0)
            angle = np.vstack([np.zeros_like(angle[:1]), angle])
            out[there] = interpolated(fix.end_s[there], edges, angle)
    return out


def _trust(rate: Observed, rows: Indices) -> float:
    """Share of the gyro's angle in a window that is used; successive samples (`rows`) differ by its noise."""
    if len(rows) < 3:
        return 1.0
    variance = 0.5 * float(np.median(np.square(np.diff(rate.value[rows])))) / NORMAL_MEDIAN
    walk = variance * rate.slot_s * float(rate.end_s[rows[-1]] - rate.begin_s[rows[0]])
    return 1.0 / (1.0 + walk / UNSURE_RAD**2)


def _steps(track: Array) -> Array:
    """Steps (n, ...) to each sample of a track from the one before; none to the first."""
    return np.diff(track, axis=0, prepend=track[:1])


def _between(values: Array) -> Array:
    """Mean (n, ...) of each sample and the one before."""
    return np.asarray(0.5 * (values + np.concatenate([values[:1], values[:-1]])))


def _sums(log: PreparedLog, channel: int, steps: Array) -> Array:
    """Sums (n, ...) of steps from each window's first sample on, whose own does not count."""
    window, out = window_index(log, channel), np.zeros_like(steps)
    for k in np.unique(window):
        mine = np.flatnonzero(window == k)
        out[mine[1:]] = np.cumsum(steps[mine[1:]], axis=0)
    return out
