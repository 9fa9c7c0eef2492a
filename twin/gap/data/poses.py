"""Aligns the twin's track in each window with the GNSS track.

The pose at a window's start comes from wheels and gyro and is off by tenths of a radian where these are at
fault. A linearisation about that pose would show a gyro bias in GNSS positions. On level ground the track
turns and shifts as a whole, so it is aligned with the fixes by a rigid transform instead.
"""

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.log import PreparedLog
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
    for shifts, observed, predicted, windows, sigma in _tracks(log, values):
        for k, rows in windows:
            a, b = predicted[rows], observed[rows]
            if shifts:
                a, b = a - a.mean(axis=0), b - b.mean(axis=0)
            cross[k] += float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / sigma**2
            dot[k] += float(np.sum(a * b)) / sigma**2
    return np.arctan2(cross, dot)


def aligned(log: PreparedLog, values: Sequence[Array]) -> list[Array]:
    """Predicted channels with the track of each window aligned with the observed one."""
    out, angles = list(values), alignment_angles(log, values)
    index = {o.channel: i for i, o in enumerate(log.observed)}
    for shifts, observed, predicted, windows, _ in _tracks(log, values):
        turned = np.empty_like(predicted)
        for k, rows in windows:
            turned[rows] = predicted[rows] @ _rotation(angles[k]).T
            if shifts:
                turned[rows] += (observed[rows] - turned[rows]).mean(axis=0)
        for column, channel in enumerate(EAST_NORTH[0 if shifts else 1]):
            out[index[channel]] = turned[:, column]
    return out


def aligned_start(log: PreparedLog, values: Sequence[Array], start: Array) -> Array:
    """Poses (W, 3) at the windows' starts that align the predictions, made from the poses `start`."""
    out, angles = start.copy(), alignment_angles(log, values)
    out[:, 2] += angles
    for shifts, observed, predicted, windows, _ in _tracks(log, values):
        for k, rows in windows if shifts else ():
            middle = predicted[rows].mean(axis=0)
            out[k, :2] = observed[rows].mean(axis=0) + _rotation(angles[k]) @ (start[k, :2] - middle)
    return out


def _rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _tracks(
    log: PreparedLog, values: Sequence[Array]
) -> list[tuple[bool, Array, Array, list[tuple[int, Indices]], float]]:
    """Of positions and velocities that the log has: whether they shift, observed and predicted values (n, 2),
    windows with their samples, sigma."""
    index = {o.channel: i for i, o in enumerate(log.observed)}
    out = []
    for pair in EAST_NORTH:
        if not all(channel in index for channel in pair):
            continue
        both = [index[channel] for channel in pair]
        first = log.observed[both[0]]
        observed = np.stack([log.observed[i].value for i in both], axis=1)
        predicted = np.stack([values[i] for i in both], axis=1)
        windows = [(k, rows) for i, k, rows in sample_map(log).blocks if i == both[0]]
        out.append((pair == EAST_NORTH[0], observed, predicted, windows, float(np.median(first.sigma))))
    return out
