"""What the fixes alone say of the motion, beside wheels and gyro: for the input doctor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.recording import Gnss, Wheels

Array = NDArray[np.float64]


def speed_ratios(wheels: Wheels, gnss: Gnss, radius: float, window_s: float = 10.0) -> Array:
    """GNSS chord over wheel distance for windows that are straight by the GNSS itself."""
    sides = wheels.side_speeds_mps(radius)
    known = np.isfinite(sides).all(axis=1)
    origin = gnss.t_ns[0]
    t_wheel = (wheels.t_ns[known] - origin) * 1e-9
    v = sides[known].mean(axis=1)
    if len(t_wheel) < 2:
        return np.zeros(0)
    distance = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t_wheel))])
    fixed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1)
    t, enu = (gnss.t_ns[fixed] - origin) * 1e-9, gnss.enu_m[fixed, :2]
    if len(t) < 2:
        return np.zeros(0)
    starts = np.arange(max(t[0], t_wheel[0]), min(t[-1], t_wheel[-1]) - window_s, window_s / 2)
    noise = float(np.nanmedian(gnss.sigma_enu_m[:, :2]))
    ratios = []
    for start in starts:
        ends = np.array([start, start + window_s / 2, start + window_s])
        a, b, c = np.stack([np.interp(ends, t, enu[:, k]) for k in range(2)], axis=1)
        rolled = float(np.diff(np.interp(ends[[0, 2]], t_wheel, distance))[0])
        chord, halves = np.linalg.norm(c - a), np.linalg.norm(b - a) + np.linalg.norm(c - b)
        if abs(rolled) > max(2.0, 3.0 * min(noise, 2.0)) and chord > 0.97 * halves:
            ratios.append(chord / abs(rolled))
    return np.array(ratios)
