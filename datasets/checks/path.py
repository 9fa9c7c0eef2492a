"""The path by wheels and gyro beside the path by positions (GNSS, truth): its scale and its shape.

Over windows of some metres the dead-reckoned path is turned, scaled and moved onto the positions by
least squares (in the plane as complex numbers, one factor for scale and turn). Slip, a wrong radius
and wrong units show in the scale; a wrong sign of the yaw rate shows where the mirrored path fits better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.yaw_signals import account, seconds, typical_sigma
from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows
from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SHORTEST_M, SIGMAS, LONGEST_S = 6.0, 20.0, 60.0
"""A window is so long that the wheels roll the first in it, and that many sigma, where the drive is long
enough; but no longer than the last, since the gyro drifts."""
LEAST_FIXES, LEAST_WINDOWS = 5, 5
LEAST_COHERENCE = 0.9
"""Correlation of the two paths in a window below which its scale means nothing."""
WHEEL_UNITS = (5e-4, 50.0)
"""From speeds in mm/s to speeds taken for rates; beyond these it is the positions that have another unit."""
BENDS = 6.0
"""Variance of the second difference of white noise over its own."""
RESAMPLES, SEED = 400, 20_240_811
ANY_RADIUS_M = 0.15
"""Where the radius is unknown and only the shape of the speed matters."""


@dataclass(frozen=True)
class Places:
    """Horizontal positions `place` (N,) east + i north, m, at `t_s` since the start; `sigma_m` of one."""

    source: str
    t_s: Array
    place: Complex
    sigma_m: float


@dataclass(frozen=True)
class Windows:
    """The fit in each window, (N,) each.

    Attributes:
        scale: true path over dead-reckoned path.
        coherence: correlation of the two.
        weight: spread of the dead-reckoned path, m2, summed over the fixes.
        span_ratio: spread of the true path over that of the dead-reckoned one, whatever their shapes.
        scatter_m: 1 sigma of a position along one axis, from second differences of what the fit leaves:
            slow errors do not count.
    """

    scale: Array
    coherence: Array
    weight: Array
    span_ratio: Array
    scatter_m: Array


@dataclass(frozen=True)
class Scale:
    """True path over dead-reckoned path, its 95 % interval, and what it was found from."""

    ratio: float
    low: float
    high: float
    windows: int
    source: str


def places(recording: Recording) -> list[Places]:
    """Positions by GNSS and by the truth, where there are any."""
    found, start = [], recording.start_ns
    gnss, truth = recording.gnss, recording.truth
    if gnss is not None:
        known = np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0)
        place = gnss.enu_m[known, 0] + 1j * gnss.enu_m[known, 1]
        found.append(Places("gnss", seconds(gnss.t_ns[known], start), place, typical_sigma(gnss)))
    if truth is not None and len(truth):
        held = np.isfinite(truth.position_m[:, :2]).all(axis=1)
        place = truth.position_m[held, 0] + 1j * truth.position_m[held, 1]
        found.append(Places("truth", seconds(truth.t_ns[held], start), place, 0.0))
    return [one for one in found if len(one.t_s) >= 2 * LEAST_FIXES]


def wheel_speed(context: CheckContext, radius_m: float | None) -> tuple[Array, Array] | None:
    """Times (N,) s since the start and mean speed (N,) m/s of both sides; None where it is not known."""
    wheels = context.recording.wheels
    if wheels is None or radius_m is None:
        return None
    speed = wheels.side_speeds_mps(radius_m).mean(axis=1)
    known = np.isfinite(speed)
    if known.sum() < 10:
        return None
    return seconds(wheels.t_ns[known], context.recording.start_ns), speed[known]


def dead_reckoned(context: CheckContext, point_m: complex = 0j) -> tuple[Array, Array, Complex] | None:
    """The way by wheels and gyro z; straight ahead without a gyro.

    Args:
        context: the recording and what is known of its wheels.
        point_m: place in the body (forward + i left) whose path is wanted.

    Returns:
        Times (N,) s since the start, way rolled (N,) m, and positions (N,) m, east + i north, of a
        robot that starts eastwards; None where wheels or their radius lack.
    """
    imu, driven = context.recording.imu, wheel_speed(context, context.wheel_radius_m())
    if driven is None:
        return None
    t, v = driven
    turned = None if imu is None else account(context.recording.start_ns, imu.t_ns, imu.gyro_radps[:, 2])
    heading = np.zeros(len(t))
    if turned is not None:
        within = (t >= turned.t_s[0]) & (t <= turned.t_s[-1])
        t, v = t[within], v[within]
        heading = np.interp(t, turned.t_s, turned.angle)
    if len(t) < 10:
        return None
    ahead = np.exp(1j * heading)
    rolled = np.concatenate([[0.0], np.cumsum(0.5 * np.abs(v[1:] + v[:-1]) * np.diff(t))])
    steps = 0.5 * (v[1:] * ahead[1:] + v[:-1] * ahead[:-1]) * np.diff(t)
    return t, rolled, np.concatenate([[0.0], np.cumsum(steps)]) + point_m * ahead


def compare(context: CheckContext, true: Places) -> Windows | None:
    """Fit the dead-reckoned path to the positions window by window; None where too few can be used."""
    reckoned = dead_reckoned(context, _antenna(context) if true.source == "gnss" else 0j)
    if reckoned is None:
        return None
    t, rolled, path = reckoned
    inside = (true.t_s >= t[0]) & (true.t_s <= t[-1])
    t_fix, g = true.t_s[inside], true.place[inside]
    if len(t_fix) < 2 * LEAST_FIXES:
        return None
    way = rolled * _crude_scale(t, rolled, t_fix, g)
    longest_m = max(SHORTEST_M, float(way[-1]) / (LEAST_WINDOWS + 1))
    length_m = float(np.clip(SIGMAS * true.sigma_m, SHORTEST_M, longest_m))
    passed = np.maximum(np.diff(way) / length_m, np.diff(t) / LONGEST_S)
    window = np.interp(t_fix, t, np.concatenate([[0.0], np.cumsum(passed)])).astype(int)
    return _fit(window, np.interp(t_fix, t, path), g, max(1.0, 3.0 * true.sigma_m))


def _crude_scale(t: Array, rolled: Array, t_fix: Array, g: Complex) -> float:
    """Way of the positions over way rolled, if it may be that of a unit: windows are the same in any unit."""
    grid = np.arange(t_fix[0], t_fix[-1], 5.0)
    total = float(rolled[-1])
    if len(grid) < 2 or total <= 0.0:
        return 1.0
    ratio = float(np.abs(np.diff(np.interp(grid, t_fix, g))).sum()) / total
    return ratio if WHEEL_UNITS[0] < ratio < WHEEL_UNITS[1] else 1.0


def _antenna(context: CheckContext) -> complex:
    rig = context.rig
    arm = context.recording.overrides.antenna_m or (rig.sensors.gnss.antenna_m if rig else None)
    return complex(arm[0], arm[1]) if arm is not None else 0j


def _fit(window: NDArray[np.int64], p: Complex, g: Complex, least_spread_m: float) -> Windows | None:
    """The fits in the windows in which the robot gets about; `window` (N,) rises."""
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    n = np.diff(np.append(starts, len(window)))
    p = p - np.repeat(np.add.reduceat(p, starts) / n, n)
    g = g - np.repeat(np.add.reduceat(g, starts) / n, n)
    pp, gg = np.add.reduceat(np.abs(p) ** 2, starts), np.add.reduceat(np.abs(g) ** 2, starts)
    pg = np.add.reduceat(np.conj(p) * g, starts)
    far = np.sqrt(np.maximum(pp, gg) / n) > least_spread_m
    use = far & (n >= LEAST_FIXES) & (pp > 0.0) & (gg > 0.0)
    if use.sum() < LEAST_WINDOWS:
        return None
    left = g - np.repeat(pg / np.where(pp > 0.0, pp, 1.0), n) * p
    bend = np.zeros(len(left))
    bend[1:-1] = np.abs(left[2:] - 2.0 * left[1:-1] + left[:-2]) ** 2
    bend[starts] = bend[starts + n - 1] = 0.0  # these reach into the neighbouring windows
    scatter = np.sqrt(np.add.reduceat(bend, starts) / (2 * BENDS) / np.maximum(n - 2, 1))
    pp, gg, pg = pp[use], gg[use], np.abs(pg[use])
    return Windows(pg / pp, pg / np.sqrt(pp * gg), pp, np.sqrt(gg / pp), scatter[use])


def scale_of(windows: Windows, source: str) -> Scale | None:
    """The scale of all coherent windows together, with its interval by bootstrap over windows.

    None where most windows are not coherent: then slip, jumps or a wrong gyro bend one of the paths.
    """
    use = windows.coherence > LEAST_COHERENCE
    if use.sum() < max(LEAST_WINDOWS, 0.5 * len(use)):
        return None
    weight, scale = windows.weight[use], windows.scale[use]
    draws = resampled_rows(len(scale), RESAMPLES, SEED)
    drawn = (weight * scale)[draws].sum(axis=1) / weight[draws].sum(axis=1)
    low, high = percentile_interval(drawn)
    return Scale(float(np.sum(weight * scale) / weight.sum()), low, high, int(use.sum()), source)


def scales(context: CheckContext) -> list[tuple[Scale, Windows]]:
    """The scale by every source of positions that allows one."""
    found = []
    for true in places(context.recording):
        windows = compare(context, true)
        scale = scale_of(windows, true.source) if windows is not None else None
        if windows is not None and scale is not None:
            found.append((scale, windows))
    return found
