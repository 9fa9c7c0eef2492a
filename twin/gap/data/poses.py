"""Aligns the twin's track in each window with the GNSS track.

The pose at a window's start comes from wheels and gyro and is off by tenths of a radian where these are at
fault. A linearisation about that pose would show a gyro bias in GNSS positions. On level ground the track
turns and shifts as a whole, so it is aligned with the fixes by a rigid transform instead.
"""

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.gap.data.samples import Indices, sample_map

EAST_NORTH = (("gnss_east_m", "gnss_north_m"), ("gnss_v_e_mps", "gnss_v_n_mps"))
"""Channels of positions (rotated and shifted) and of velocities (rotated only)."""
HEADING_SIGMA_RAD = 0.5  # 1 sigma of the initial heading (assumed): keeps it in a window without motion


def alignment_angles(log: PreparedLog, values: Sequence[Array]) -> Array:
    """Angles (W,), rad, that rotate predicted tracks, one array a channel of `log.observed`, onto the
    observed.

    Least squares over rotation and shift of each window (Umeyama 1991, without scale), positions and
    velocities together.
    """
    cross, dot = np.zeros(len(log.windows)), np.full(len(log.windows), HEADING_SIGMA_RAD**-2.0)
    for pair, (east, north) in _pairs(log):
        observed, predicted = _track(log, values, east, north)
        sigma = float(np.median(log.observed[east].sigma))
        for k, rows in _windows(log, east):
            a, b = predicted[rows], observed[rows]
            if pair == EAST_NORTH[0]:
                a, b = a - a.mean(axis=0), b - b.mean(axis=0)
            cross[k] += float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / sigma**2
            dot[k] += float(np.sum(a * b)) / sigma**2
    return np.arctan2(cross, dot)


def aligned_start(log: PreparedLog, values: Sequence[Array], start: Array) -> Array:
    """Poses (W, 3) at the windows' starts that align the predictions, made from the poses `start`."""
    out, angles = start.copy(), alignment_angles(log, values)
    out[:, 2] += angles
    for pair, (east, north) in _pairs(log):
        if pair == EAST_NORTH[0]:
            observed, predicted = _track(log, values, east, north)
            for k, rows in _windows(log, east):
                middle = predicted[rows].mean(axis=0)
                out[k, :2] = observed[rows].mean(axis=0) + _rotation(angles[k]) @ (start[k, :2] - middle)
    return out


def moved(log: PreparedLog, values: Sequence[Array], old: Array, new: Array) -> list[Array]:
    """Predicted channels (n,) from other poses (W, 3) at the windows' starts than the old ones: on a level
    plane a run shifts and turns as a whole."""
    about_start = _shifted(log, values, -old[:, :2])
    return _shifted(log, rotated(log, about_start, new[:, 2] - old[:, 2]), new[:, :2])


def rotated(log: PreparedLog, channels: Sequence[Array], angle: Array) -> list[Array]:
    """Channels (n, ...) with the east and north ones of each window rotated by an angle (W,)."""
    out = list(channels)
    for _, (east, north) in _pairs(log):
        a, b, at = channels[east], channels[north], angle[window_index(log, east)]
        at = at.reshape(-1, *[1] * (a.ndim - 1))
        out[east], out[north] = np.cos(at) * a - np.sin(at) * b, np.sin(at) * a + np.cos(at) * b
    return out


def window_index(log: PreparedLog, channel: int) -> Indices:
    """Number (n,) of the window of each sample of a channel."""
    return np.clip(window_of(log.observed[channel], log.windows), 0, len(log.windows) - 1)


def _shifted(log: PreparedLog, values: Sequence[Array], by: Array) -> list[Array]:
    """Channels (n,) with the positions of each window shifted by (W, 2)."""
    out = list(values)
    for pair, both in _pairs(log):
        for axis, i in enumerate(both if pair == EAST_NORTH[0] else ()):
            out[i] = out[i] + by[window_index(log, i), axis]
    return out


def _rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _pairs(log: PreparedLog) -> list[tuple[tuple[str, str], tuple[int, int]]]:
    """Of `EAST_NORTH` what the log has, with the indices of both channels."""
    index = {o.channel: i for i, o in enumerate(log.observed)}
    return [((e, n), (index[e], index[n])) for e, n in EAST_NORTH if e in index and n in index]


def _track(log: PreparedLog, values: Sequence[Array], east: int, north: int) -> tuple[Array, Array]:
    """Observed and predicted values (n, 2) of two channels."""
    observed = np.stack([log.observed[east].value, log.observed[north].value], axis=1)
    return observed, np.stack([values[east], values[north]], axis=1)


def _windows(log: PreparedLog, channel: int) -> list[tuple[int, Indices]]:
    """Windows with their samples of a channel."""
    return [(k, rows) for i, k, rows in sample_map(log).blocks if i == channel]
