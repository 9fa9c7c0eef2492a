"""The pose at the start of each window, laid onto the fixes by what the twin itself has driven.

The guess that a log comes with turns a path from wheels and gyro onto the fixes. Where wheels or gyro are at
fault the guess is off by tenths of a radian, and what is linear in the pose does not take that up: a gyro's
bias would show in positions that it has no part in. A run on level ground turns and shifts as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.log import PreparedLog, window_of

Array = NDArray[np.float64]

PAIRS = (("gnss_east_m", "gnss_north_m"), ("gnss_v_e_mps", "gnss_v_n_mps"))
"""East and north of positions (which shift, too) and of velocities."""
TURN_SIGMA = 0.5
"""1 sigma of the guess's heading, rad (assumed): a window in which the robot stands keeps it."""


def turns(log: PreparedLog, values: Sequence[Array]) -> Array:
    """Angles (W,) by which predicted tracks, a channel each of `log.observed`, turn onto those observed.

    Least squares over rotation and shift of every window (Umeyama 1991, without scale), positions and
    velocities together.
    """
    cross, dot = np.zeros(len(log.windows)), np.full(len(log.windows), TURN_SIGMA**-2.0)
    for shifts, seen, told, of, sigma in _tracks(log, values):
        for k in range(len(log.windows)):
            a, b = told[of == k], seen[of == k]
            if shifts and len(a):
                a, b = a - a.mean(axis=0), b - b.mean(axis=0)
            cross[k] += float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / sigma**2
            dot[k] += float(np.sum(a * b)) / sigma**2
    return np.arctan2(cross, dot)


def settled(log: PreparedLog, values: Sequence[Array]) -> list[Array]:
    """Predicted channels, the track of every window turned and shifted onto the one observed."""
    out, angles = list(values), turns(log, values)
    at = {o.channel: i for i, o in enumerate(log.observed)}
    for shifts, seen, told, of, _ in _tracks(log, values):
        turned = np.empty_like(told)
        for k, angle in enumerate(angles):
            mine = of == k
            turned[mine] = told[mine] @ _rotation(angle).T
            if shifts and mine.any():
                turned[mine] += (seen[mine] - turned[mine]).mean(axis=0)
        for column, channel in enumerate(PAIRS[0 if shifts else 1]):
            out[at[channel]] = turned[:, column]
    return out


def settled_start(log: PreparedLog, values: Sequence[Array], start: Array) -> Array:
    """Poses (W, 3) at the windows' starts from which the predicted tracks would lie on those observed, for
    predictions from the poses `start`."""
    out, angles = start.copy(), turns(log, values)
    out[:, 2] += angles
    for shifts, seen, told, of, _ in _tracks(log, values):
        for k in np.unique(of) if shifts else ():
            middle = told[of == k].mean(axis=0)
            out[k, :2] = seen[of == k].mean(axis=0) + _rotation(angles[k]) @ (start[k, :2] - middle)
    return out


def _rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _tracks(
    log: PreparedLog, values: Sequence[Array]
) -> list[tuple[bool, Array, Array, NDArray[np.int64], float]]:
    """Of positions and velocities, where the log has them: whether they shift, observed and predicted
    (n, 2), the window of each row and their sigma."""
    at = {o.channel: i for i, o in enumerate(log.observed)}
    out = []
    for pair in PAIRS:
        if not all(channel in at for channel in pair):
            continue
        rows = [at[channel] for channel in pair]
        first = log.observed[rows[0]]
        seen = np.stack([log.observed[i].value for i in rows], axis=1)
        told = np.stack([values[i] for i in rows], axis=1)
        of = window_of(first, log.windows)
        out.append((pair == PAIRS[0], seen, told, of, float(np.median(first.sigma))))
    return out
