"""What the fixes alone say of the motion, beside wheels and gyro: for the input doctor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.recording import Gnss, Imu, Wheels

Array = NDArray[np.float64]

WINDOWS_S = (1.0, 2.0, 4.0, 8.0)
"""Lengths of the chords whose course is compared; the shortest that the noise allows is taken."""

STRIDES = 4
"""Chords a window: they overlap."""


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


def course_correlation(gnss: Gnss, imu: Imu) -> float | None:
    """Correlation of the changes of course by the fixes and by gyro z, each over one window.

    A chord counts where it is longer than 1 m and than five sigma of a fix. Changes near half a turn
    are left out: there the robot reverses. None where fewer than eight windows count, or on a straight drive.
    """
    rate = imu.gyro_radps[:, 2]
    turning = np.isfinite(rate)
    fixed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0)
    if turning.sum() < 20 or fixed.sum() < 20:
        return None
    origin = max(int(gnss.t_ns[fixed][0]), int(imu.t_ns[turning][0]))
    t, enu = (gnss.t_ns[fixed] - origin) * 1e-9, gnss.enu_m[fixed, :2]
    t_gyro, rate = (imu.t_ns[turning] - origin) * 1e-9, rate[turning]
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_gyro)
    yaw = np.concatenate([[0.0], np.cumsum(steps)])
    sigma = gnss.sigma_enu_m[fixed, :2]
    shortest = max(1.0, 5.0 * float(np.nanmedian(sigma))) if np.isfinite(sigma).any() else 1.0
    for window_s in WINDOWS_S:
        grid = np.arange(0.0, min(t[-1], t_gyro[-1]), window_s / STRIDES)
        if len(grid) < 12 * STRIDES:
            return None
        place = np.stack([np.interp(grid, t, enu[:, k]) for k in range(2)], axis=1)
        chord = place[STRIDES:] - place[:-STRIDES]
        long = np.hypot(chord[:, 0], chord[:, 1]) > shortest
        course = np.arctan2(chord[:, 1], chord[:, 0])
        by_fixes = np.angle(np.exp(1j * (course[STRIDES:] - course[:-STRIDES])))
        heading = np.interp(grid[: len(chord)] + 0.5 * window_s, t_gyro, yaw)
        by_gyro = heading[STRIDES:] - heading[:-STRIDES]
        use = long[STRIDES:] & long[:-STRIDES] & (np.abs(by_fixes) < 2.5) & (np.abs(by_gyro) < 2.5)
        a, b = by_fixes[use], by_gyro[use]
        if use.sum() >= 8 * STRIDES and min(a.std(), b.std()) > 0.1:
            return float(np.corrcoef(a, b)[0, 1])
    return None
