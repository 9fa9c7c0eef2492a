"""Times, fix class and sigmas of the fixes in a Pathfinder workspace, which come in several ways."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.gnss_time import GPS_EPOCH_S, WEEK_S, gps_to_unix_ns
from terrafusion.datasets.core.lag import lag_between
from terrafusion.datasets.readers.sets.matlab_hdf5 import MatlabFile

UNIX_SINCE_S = 1e9
"""Times beyond this are unix seconds, smaller ones seconds of the GPS week."""
NEAR_S = 3600.0
"""Fixes of one drive with the wheels lie no farther off."""
LEAST_R = 0.7
SMOOTH_M = 0.1
"""99 % of the second differences of 10 Hz carrier-phase fixes stay below: 0.066 m; of single points 1.8 m."""
SIGMA_FIXED_M, SIGMA_SINGLE_M = (0.01, 0.01, 0.02), (2.5, 2.5, 5.0)
"""East, north, up, where the file has none: what receivers' data sheets promise."""

Placed = tuple[Array | None, list[str]]


def seconds_to_ns(seconds: Array) -> NDArray[np.int64]:
    """Unix seconds (N,) as int64 nanoseconds, to the resolution of the double."""
    whole = np.floor(seconds)
    return whole.astype(np.int64) * 10**9 + np.rint((seconds - whole) * 1e9).astype(np.int64)


def times_in_file(file: MatlabFile, rows: int, t_wheels: Array) -> Placed | None:
    """Unix seconds (N,) of the fixes from the file's own clock, with how; None where it has none."""
    for table in file.tables():
        time = table.get("time", np.zeros(0))
        if len(time) == rows > 1 and (np.diff(time) > 0.0).all() and time[0] >= 0.0 and time[-1] < WEEK_S:
            t_s = _of_week(time, float(t_wheels[0]))
            if abs(t_s[0] - t_wheels[0]) < NEAR_S:
                return t_s, [_of_table(t_s, t_wheels)]
    if file.has("tTGPS"):
        t_s = file.vector("tTGPS")
        if len(t_s) == rows and np.isfinite(t_s).all() and t_s.min(initial=np.inf) > UNIX_SINCE_S:
            return t_s, ["gnss: times are those of receipt (tTGPS)"]
    return None


def _of_table(t_s: Array, t_wheels: Array) -> str:
    """How far the rows are from those of the wheels, which they look like."""
    missing = round((t_s[-1] - t_s[0]) / float(np.median(np.diff(t_s)))) + 1 - len(t_s)
    return (
        "gnss: times are GPS seconds of the week from the file's table, leap seconds taken off; "
        f"{missing} epochs are missing, so that row i lies {t_s[0] - t_wheels[0]:+.2f} s from wheel row i "
        f"at the start and {t_s[-1] - t_wheels[min(len(t_s), len(t_wheels)) - 1]:+.2f} s at the end"
    )


def _of_week(seconds: Array, near_unix_s: float) -> Array:
    """Unix seconds of GPS seconds of the week, in the week of `near_unix_s`."""
    week = round((near_unix_s - GPS_EPOCH_S - float(seconds[0])) / WEEK_S)
    gps_ns = np.rint(seconds * 1e9).astype(np.int64) + week * WEEK_S * 10**9
    return np.asarray(gps_to_unix_ns(gps_ns), dtype=float) * 1e-9


def times_by_rows(enu_m: Array, t_wheels: Array, speed: Array, wheels_late_s: float) -> Placed:
    """Times by the wheels' rows: fix i goes with wheel row i up to a constant shift, by the speeds.

    `wheels_late_s` is by how much the wheels' own times are late; fixes are put on the true clock.
    """
    if len(t_wheels) < 2 or len(enu_m) < 2:
        return None, ["gnss: no times in the file; left out"]
    period = float(np.median(np.diff(t_wheels)))
    extra = t_wheels[-1] + period * np.arange(1, max(len(enu_m) - len(t_wheels), 0) + 1)
    t_s = np.concatenate([t_wheels, extra])[: len(enu_m)]
    steps = np.hypot(*np.diff(enu_m[:, :2], axis=0).T) / np.diff(t_s)
    lag = lag_between(t_wheels - t_s[0], speed, (t_s[1:] + t_s[:-1]) / 2.0 - t_s[0], steps)
    if lag is None or lag.r < LEAST_R:
        return None, ["gnss: no times in the file, and its speed does not follow the wheels; left out"]
    return t_s - lag.seconds - wheels_late_s, [
        f"gnss: no times in the file; fix i goes with wheel row i, {-lag.seconds:+.2f} s "
        f"({-lag.high_s:+.2f} to {-lag.low_s:+.2f}, 95 %) by their speeds (r {lag.r:.2f})"
    ]


def fix_class_and_sigma(file: MatlabFile, enu_m: Array) -> tuple[Fix, Array, str]:
    """Fix class, sigma (N, 3) east, north, up, and why."""
    names = ("LonSigma", "LatSigma", "HeightSigma")
    if all(file.has(name) for name in names):
        sigma = np.stack([file.vector(name) for name in names], axis=-1)
        if len(sigma) == len(enu_m):
            size = float(np.nanmedian(sigma[:, :2])) if np.isfinite(sigma[:, :2]).any() else np.inf
            fix = next(fix for fix, limit in _CLASSES if size < limit)
            return fix, sigma, f"gnss: taken for {fix.name.lower()} by its sigmas (median {size:.2f} m)"
    bends = np.hypot(*np.diff(enu_m[:, :2], 2, axis=0).T)
    roughness = float(np.nanpercentile(bends, 99)) if np.isfinite(bends).any() else np.inf
    fix, level = (Fix.FIXED, SIGMA_FIXED_M) if roughness < SMOOTH_M else (Fix.SINGLE, SIGMA_SINGLE_M)
    why = (
        f"gnss: no sigmas in the file; taken for {fix.name.lower()}, {level[0]:g} m horizontally and "
        f"{level[2]:g} m in height, because 99 % of the second differences stay below {roughness:.2f} m"
    )
    return fix, np.tile(level, (len(enu_m), 1)), why


_CLASSES = ((Fix.FIXED, 0.05), (Fix.FLOAT, 0.5), (Fix.DGPS, 1.0), (Fix.SINGLE, np.inf))
"""Fix class by the median horizontal sigma below, m; infinite sigmas are single points."""
