"""Wheels whose sides are sampled at different times, brought to common times."""

import numpy as np

from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.channels import Wheels

LEAST_SAMPLES, MOST_WHOLE = 10, 0.1
"""Samples that each wheel has at least, and the largest share of rows that hold all wheels."""
GAP_PERIODS = 5.0
"""Longer gaps of one wheel, in its own periods, are not interpolated over."""


def sampled_apart(wheels: Wheels) -> bool:
    """Whether hardly a row holds all wheels, while each of them has samples."""
    known = np.isfinite(wheels.speed)
    if len(wheels.names) < 2 or not len(wheels) or known.sum(axis=0).min() < LEAST_SAMPLES:
        return False
    return bool(known.all(axis=1).mean() < MOST_WHOLE)


def paired_sides(wheels: Wheels) -> Wheels:
    """The wheels at the times of the one that is sampled most, the others interpolated between their samples.

    Rows before the first or after the last sample of a wheel, and in its gaps, are left out.
    """
    known = np.isfinite(wheels.speed)
    t_s = (wheels.t_ns - wheels.t_ns[0]) * 1e-9
    rows = np.flatnonzero(known[:, int(np.argmax(known.sum(axis=0)))])
    speed, near = _at(t_s, wheels.speed, t_s[rows])
    angle = None if wheels.angle_rad is None else _at(t_s, wheels.angle_rad, t_s[rows])[0]
    return Wheels(
        wheels.t_ns[rows][near],
        speed[near],
        wheels.names,
        wheels.unit,
        None if angle is None else angle[near],
    )


def _at(t_s: Array, values: Array, wanted_s: Array) -> tuple[Array, Mask]:
    """Columns interpolated each over its own samples, and where all of them are near one."""
    out, near = np.full((len(wanted_s), values.shape[1]), np.nan), np.ones(len(wanted_s), dtype=bool)
    for k, column in enumerate(values.T):
        own = np.isfinite(column)
        if not own.any():
            continue
        t, v = t_s[own], column[own]
        out[:, k] = np.interp(wanted_s, t, v)
        after = np.clip(np.searchsorted(t, wanted_s), 1, len(t) - 1)
        gap = t[after] - t[after - 1]
        near &= (wanted_s >= t[0]) & (wanted_s <= t[-1]) & (gap < GAP_PERIODS * float(np.median(np.diff(t))))
    return out, near
