"""Start pose of each window: a guess from dead reckoning aligned to the positions of the log."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed, observe
from terrafusion.twin.model.motion import plane_rotation

AROUND_S = 15.0
"""The heading at a window's start is that of the track this long before and after."""
LEAST_SPREAD = 5.0
"""A track gives a heading when it spreads over this many sigma of its positions."""


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
