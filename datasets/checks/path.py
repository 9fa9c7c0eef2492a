"""The dead-reckoned path (wheels and gyro) compared with measured positions (GNSS, truth).

Over windows of some metres the dead-reckoned path is rotated, scaled and shifted onto the positions by
least squares, in the plane as complex numbers with one factor for scale and rotation. The scale shows
slip, a wrong radius and wrong units.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import CheckContext, once
from terrafusion.datasets.core.arrays import Array, Complex
from terrafusion.datasets.core.bootstrap import percentile_interval, resampled_rows
from terrafusion.datasets.core.recording import Recording

SHORTEST_M, SIGMAS, LONGEST_S = 6.0, 20.0, 60.0
"""A window spans this path of the wheels and this many sigma, where the run is long enough, but at most
this time, since the gyro drifts."""
LEAST_FIXES, LEAST_WINDOWS = 5, 5
LEAST_COHERENCE = 0.9
"""Correlation of the two paths in a window below which its scale is not used."""
MOST_BEND_RAD = 0.3
"""Without a gyro the dead-reckoned path is straight: a stretch that bends by so much is 0.4 % longer than its
chord."""
SHIFTS, SHIFT_STEPS, SMALL, ALIKE_FIXES = np.array([0.5, 0.5, 0.5]), 5, 1e-3, 10
"""1 sigma of the antenna's place (m) and of the fixes' delay (s, assumed), steps to find them, steps of
derivatives, and fixes in a row whose errors are alike."""
WHEEL_UNITS = (5e-4, 50.0)
"""From speeds in mm/s to speeds mistaken for rates; beyond these the positions have another unit."""
BENDS = 6.0
"""Variance of the second difference of white noise over its own."""


@dataclass(frozen=True)
class MeasuredPath:
    """Positions `place` (N,), east + i north, m, at `t_s` since the start; their 1 sigma `sigma_m`."""

    source: str
    t_s: Array
    place: Complex
    sigma_m: float


@dataclass(frozen=True)
class PathFits:
    """The fit of each window, (N,) each.

    Attributes:
        scale: measured path over dead-reckoned path.
        coherence: correlation of the two.
        weight: spread of the dead-reckoned path, m2, summed over the fixes.
        span_ratio: spread of the measured path over that of the dead-reckoned one, whatever their shapes.
        scatter_m: 1 sigma of a position along one axis, from second differences of the residuals:
            slow errors do not count.
        straight: whether the dead-reckoned path has the bends of the measured one.
    """

    scale: Array
    coherence: Array
    weight: Array
    span_ratio: Array
    scatter_m: Array
    straight: NDArray[np.bool_]


@dataclass(frozen=True)
class PathScale:
    """Measured path over dead-reckoned path, its 95 % interval, number of windows, source of positions."""

    ratio: float
    low: float
    high: float
    windows: int
    source: str


def measured_paths(recording: Recording) -> list[MeasuredPath]:
    """Positions by GNSS and by the truth, where there are enough."""
    found, start = [], recording.start_ns
    gnss, truth = recording.gnss, recording.truth
    if gnss is not None:
        known = np.asarray(np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0))
        t_s = motion.seconds(gnss.t_ns[known], start)
        found.append(
            MeasuredPath("gnss", t_s, motion.on_plane(gnss.enu_m[known]), motion.typical_sigma(gnss))
        )
    if truth is not None and len(truth):
        known = np.asarray(np.isfinite(truth.position_m[:, :2]).all(axis=1))
        t_s = motion.seconds(truth.t_ns[known], start)
        found.append(MeasuredPath("truth", t_s, motion.on_plane(truth.position_m[known]), 0.0))
    return [path for path in found if len(path.t_s) >= 2 * LEAST_FIXES]


def path_by(recording: Recording, source: str) -> MeasuredPath | None:
    """Positions by one source, "gnss" or "truth"; None where it has too few."""
    return next((path for path in measured_paths(recording) if path.source == source), None)


def driven_and_turned(
    context: CheckContext, *, metric: bool = False
) -> tuple[Array, Array, Array | None] | None:
    """Times (N,) s, speed (N,) m/s by the wheels and angle turned (N,) rad, None without a gyro.

    None where the wheels or, if `metric`, their radius are unknown, or where wheels and gyro hardly overlap.
    """
    driven, yaw = motion.wheel_speed(context, metric=metric), motion.gyro_angle(context.recording)
    if driven is None:
        return None
    t, v = driven
    if yaw is not None:
        within = (t >= yaw.t_s[0]) & (t <= yaw.t_s[-1])
        t, v = t[within], v[within]
    return (t, v, None if yaw is None else np.interp(t, yaw.t_s, yaw.value)) if len(t) >= 10 else None


def dead_reckoned(context: CheckContext, point_m: complex = 0j) -> tuple[Array, Array, Complex] | None:
    """The path of a point of the body (forward + i left, m) by wheels and gyro z; straight without a gyro.

    Returns:
        Times (N,) s since the start, distance rolled (N,) m, and positions (N,) m, east + i north, of
        a robot that starts eastwards; None where wheels or their radius are unknown.
    """
    driven = driven_and_turned(context, metric=True)
    if driven is None:
        return None
    t, v, turned = driven
    ahead = np.exp(1j * (np.zeros(len(t)) if turned is None else turned))
    return t, motion.cumulative(t, v, unsigned=True), motion.cumulative(t, v * ahead) + point_m * ahead


def fit_windows(context: CheckContext, measured: MeasuredPath | None) -> PathFits | None:
    """Fit the dead-reckoned path to the positions window by window; None where too few are usable."""
    if measured is None:
        return None
    reckoned = dead_reckoned(context, antenna(context) if measured.source == "gnss" else 0j)
    if reckoned is None:
        return None
    t, rolled, path = reckoned
    inside = (measured.t_s >= t[0]) & (measured.t_s <= t[-1])
    t_fix, g = measured.t_s[inside], measured.place[inside]
    if len(t_fix) < 2 * LEAST_FIXES:
        return None
    distance = rolled * _crude_scale(rolled, t_fix, g)
    longest_m = max(SHORTEST_M, float(distance[-1]) / (LEAST_WINDOWS + 1))
    length_m = float(np.clip(SIGMAS * measured.sigma_m, SHORTEST_M, longest_m))
    passed = np.maximum(np.diff(distance) / length_m, np.diff(t) / LONGEST_S)
    window = np.interp(t_fix, t, np.concatenate([[0.0], np.cumsum(passed)])).astype(int)

    def reckoned_at(shift: Array) -> Complex:
        """Positions (N,) of the antenna `shift[:2]` further forward and left, as many seconds late."""
        at = t_fix - shift[2]
        p = np.interp(at, t, path)
        return p if yaw is None else p + complex(*shift[:2]) * np.exp(1j * np.interp(at, yaw.t_s, yaw.value))

    yaw, shift = motion.gyro_angle(context.recording), np.zeros(3)
    if measured.source == "gnss" and yaw is not None:
        for _ in range(SHIFT_STEPS):
            p = reckoned_at(shift)
            columns = [(reckoned_at(shift + step) - p) / SMALL for step in SMALL * np.eye(3)]
            shift = shift + _shift_left(window, p, columns, g)
    return _fit(context, window, reckoned_at(shift), g, max(1.0, 3.0 * measured.sigma_m))


def _shift_left(window: NDArray[np.int64], p: Complex, columns: Sequence[Complex], g: Complex) -> Array:
    """By how much a point of the body (forward, left, m) and a delay (s) must change for the path of the
    fixes, with its derivatives `columns`, each (N,): that of an antenna is longer in turns.

    By least squares beside the fit of each window, from a prior of `SHIFTS`.
    """
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    n = np.diff(np.append(starts, len(window)))

    def summed(values: Complex) -> Complex:
        return np.asarray(np.repeat(np.add.reduceat(values, starts), n))

    count = np.repeat(n, n)
    p, g, *columns = (values - summed(values) / count for values in (p, g, *columns))
    power = np.maximum(summed(np.abs(p) ** 2).real, 1e-9)
    factor = summed(np.conj(p) * g) / power
    coherent = np.abs(factor) * np.sqrt(power) > LEAST_COHERENCE * np.sqrt(summed(np.abs(g) ** 2).real)
    C = np.array([factor * (column - summed(np.conj(p) * column) / power * p) for column in columns])
    C, left = C[:, coherent], (g - factor * p)[coherent]
    noise = float(np.mean(np.abs(left) ** 2)) * ALIKE_FIXES if coherent.any() else 1.0
    H = (C.conj() @ C.T).real + np.diag(noise / SHIFTS**2 + 1e-12)
    return np.asarray(np.linalg.solve(H, (C.conj() @ left).real))


def _crude_scale(rolled: Array, t_fix: Array, g: Complex) -> float:
    """Measured path over distance rolled, if it may be a unit: windows are the same in any unit."""
    grid = np.arange(t_fix[0], t_fix[-1], 5.0)
    total = float(rolled[-1])
    if len(grid) < 2 or total <= 0.0:
        return 1.0
    ratio = float(np.abs(np.diff(np.interp(grid, t_fix, g))).sum()) / total
    return ratio if WHEEL_UNITS[0] < ratio < WHEEL_UNITS[1] else 1.0


def antenna(context: CheckContext) -> complex:
    """Position of the antenna in the body, forward + i left, m; 0 where unknown."""
    rig = context.rig
    arm = context.recording.overrides.antenna_m or (rig.sensors.gnss.antenna_m if rig else None)
    return complex(arm[0], arm[1]) if arm is not None else 0j


def _fit(
    context: CheckContext, window: NDArray[np.int64], p: Complex, g: Complex, least_spread_m: float
) -> PathFits | None:
    """The fits in the windows in which the robot moves enough; `window` (N,) rises."""
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
    residual = g - np.repeat(pg / np.where(pp > 0.0, pp, 1.0), n) * p
    bend = np.zeros(len(residual))
    bend[1:-1] = np.abs(residual[2:] - 2.0 * residual[1:-1] + residual[:-2]) ** 2
    rows = [slice(start, start + count) for start, count in zip(starts[use], n[use], strict=True)]
    # The first and the last reach into other windows. The median of a square of two normal errors is ln 2
    # of its mean: few wild fixes hardly count.
    scatter = np.sqrt([np.median(bend[row][1:-1]) / (2.0 * math.log(2.0) * BENDS) for row in rows])
    straight = np.array([is_straight(context, p[row], g[row]) for row in rows])
    pp, gg, pg = pp[use], gg[use], np.abs(pg[use])
    return PathFits(pg / pp, pg / np.sqrt(pp * gg), pp, np.sqrt(gg / pp), scatter, straight)


@once
def _has_gyro(context: CheckContext) -> bool:
    return motion.gyro_angle(context.recording) is not None


def is_straight(context: CheckContext, p: Complex, g: Complex) -> bool:
    """Whether dead-reckoned positions (n,) know the bends of the measured ones: by a gyro, or as none.

    The bend is that of a parabola along the distance rolled.
    """
    if _has_gyro(context):
        return True
    along = p.real - p.real.mean()
    half = max(0.5 * float(np.ptp(along)), 1e-9)
    square, slope, _ = np.polyfit(along / half, g, 2)
    return bool(4.0 * abs(square) < MOST_BEND_RAD * abs(slope))


def scale_of(fits: PathFits, source: str) -> PathScale | None:
    """The scale over all coherent windows, with its interval by bootstrap over windows.

    None where most windows are not coherent: then slip, jumps or a wrong gyro bend one of the paths; and
    where few are straight, without a gyro.
    """
    use = (fits.coherence > LEAST_COHERENCE) & fits.straight
    if use.sum() < max(LEAST_WINDOWS, 0.5 * fits.straight.sum()):
        return None
    weight, scale = fits.weight[use], fits.scale[use]
    draws = resampled_rows(len(scale))
    drawn = (weight * scale)[draws].sum(axis=1) / weight[draws].sum(axis=1)
    low, high = percentile_interval(drawn)
    return PathScale(float(np.sum(weight * scale) / weight.sum()), low, high, int(use.sum()), source)


def scales(context: CheckContext) -> list[tuple[PathScale, PathFits]]:
    """The scale by every source of positions that allows one."""
    fits = [(fit_windows(context, path), path.source) for path in measured_paths(context.recording)]
    found = [(scale_of(fit, source), fit) for fit, source in fits if fit is not None]
    return [(scale, fit) for scale, fit in found if scale is not None]


def scatter_m(context: CheckContext) -> float | None:
    """Scatter of the fixes about the dead-reckoned path, 1 sigma along one axis, without slow errors."""
    fits = fit_windows(context, path_by(context.recording, "gnss"))
    return float(np.median(fits.scatter_m)) if fits is not None else None
