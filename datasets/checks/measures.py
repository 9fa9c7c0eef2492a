"""Quantities measured between the channels of a log: gravity, lags, scales, path lengths, update rates.

Several recordings of one robot are pooled: windows of 2 s rarely suffice alone.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.delays import opposed
from terrafusion.datasets.checks.finding import CheckContext, with_fields
from terrafusion.datasets.checks.imu import nearest_axis
from terrafusion.datasets.checks.motion import far_lag, near_lag
from terrafusion.datasets.checks.outliers import check_magnitude
from terrafusion.datasets.checks.path import (
    MeasuredPath,
    PathFits,
    dead_reckoned,
    fit_windows,
    is_straight,
    path_by,
    scale_of,
)
from terrafusion.datasets.checks.signals import MEASURED
from terrafusion.datasets.checks.timing import is_gap
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.conventions import true_updates
from terrafusion.datasets.core.lag import held_rows
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

LEAST_SPREAD_M = 0.1
"""Least root mean square distance from its centre of a recording too short for windows."""
LAG_PAIRS = {
    "yaw rate": (("imu", "wheels"), ("imu", "truth"), ("command", "wheels")),
    "speed": (("wheels", "gnss"), ("wheels", "truth"), ("command", "wheels")),
}
"""By quantity: channels whose signals are compared in time."""
LEAST_R, LEAST_TRACK_R = 0.5, 0.8
"""A lag, and a track, at a lower correlation is noise and is not reported."""
RULER_SIGMAS = 3.0
"""The path of the fixes is measured in steps of so many sigmas, so that noise at rest adds nothing."""
HELD = 0.8
"""A channel whose values change at less than this share of its rate is held."""


@dataclass(frozen=True)
class Gravity:
    """Mean specific force in the log's axes, the axis it lies nearest to, and the angle between."""

    mean_mps2: tuple[float, float, float]
    size_mps2: float
    axis: str
    tilt_deg: float


@dataclass(frozen=True)
class YawFit:
    """Gyro z against the wheels: correlation of half-second means, and the track that makes them equal.

    The effective track (difference of side speeds over yaw rate) of a robot that skids is wider than
    the geometric one. None where the wheel radius is unknown. A lag is removed first.
    """

    r: float
    effective_track_m: float | None
    seconds: float


@dataclass(frozen=True)
class SpeedRatio:
    """Path over ground over path by wheels and gyro, its 95 % interval, and the number of stretches."""

    ratio: float
    low: float
    high: float
    stretches: int


@dataclass(frozen=True)
class PairLag:
    """`later` shows a quantity `seconds` after `earlier` (95 % interval), at correlation `r`."""

    quantity: str
    earlier: str
    later: str
    seconds: float
    low_s: float
    high_s: float
    r: float


@dataclass(frozen=True)
class SigmaRange:
    """Horizontal 1 sigma that the receiver reports, m."""

    min: float
    median: float
    max: float


@dataclass(frozen=True)
class UpdateRate:
    """Rows a second of a channel that holds its values, and new values a second."""

    rate_hz: float
    update_hz: float


@dataclass(frozen=True)
class Measures:
    """All of them; None or empty where the log does not allow it.

    `speed_ratio` and `path_m` are by channel ("gnss", "truth", "wheels"); `lags` are measured in
    one recording only.
    """

    gravity: Gravity | None = None
    yaw: YawFit | None = None
    speed_ratio: dict[str, SpeedRatio] = field(default_factory=dict)
    lags: tuple[PairLag, ...] = ()
    path_m: dict[str, float] = field(default_factory=dict)
    sigma_m: SigmaRange | None = None
    held: dict[str, UpdateRate] = field(default_factory=dict)


def measure(recordings: Sequence[Recording], rig: Rig | None = None) -> Measures:
    """Measure one recording, or several of one robot pooled.

    Args:
        recordings: one at least.
        rig: geometry of the robot; without it and without a wheel radius of the log, wheel rates
            in rad/s are not converted to speeds.
    """
    contexts = [CheckContext(recording, rig) for recording in recordings]
    contexts = [context for context in contexts if not list(check_magnitude(context))]
    if not contexts:
        return Measures()  # impossible numbers are not computed with
    lags = tuple(_lags(contexts[0])) if len(recordings) == 1 else ()
    aligned = [_aligned(context, lags) for context in contexts]
    return Measures(
        gravity=_gravity(contexts),
        yaw=_yaw(aligned),
        speed_ratio=_speed_ratios(aligned),
        lags=lags,
        path_m=_paths(contexts),
        sigma_m=_sigma(contexts),
        held=_held(contexts),
    )


def _gravity(contexts: Sequence[CheckContext]) -> Gravity | None:
    imus = [context.recording.imu for context in contexts]
    readings = [imu.accel_mps2 for imu in imus if imu is not None and imu.has_accel()]
    if not readings:
        return None
    mean = np.nanmean(np.concatenate(readings), axis=0)
    size = float(np.linalg.norm(mean))
    if not size > 0.0:
        return None
    tilt = np.degrees(np.arccos(np.clip(np.abs(mean).max() / size, 0.0, 1.0)))
    x, y, z = mean.tolist()
    return Gravity((x, y, z), size, nearest_axis(mean), float(tilt))


def _yaw(contexts: Sequence[CheckContext]) -> YawFit | None:
    pairs = [pair for context in contexts if (pair := _yaw_pair(context)) is not None]
    if not pairs:
        return None
    difference, rate = (np.concatenate([pair[k] for pair in pairs]) for k in range(2))
    if len(difference) < motion.LEAST_WINDOWS or not min(difference.std(), rate.std()) > 0.0:
        return None
    covariance = np.cov(difference, rate)
    r = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    metric = all(context.wheel_radius_m() is not None for context in contexts)
    track = float(covariance[0, 1] / covariance[1, 1]) if metric and abs(r) > LEAST_TRACK_R else None
    return YawFit(r, track, len(difference) * motion.WINDOW_S)


def _yaw_pair(context: CheckContext) -> tuple[Array, Array] | None:
    """Half-second means of right minus left wheel speed and of gyro z, each (N,)."""
    angles = motion.yaw_angles(context)
    if "wheels" not in angles or "gyro" not in angles:
        return None
    wheels, gyro = angles["wheels"], angles["gyro"]
    start, end = motion.common_span(wheels, gyro)
    grid = np.arange(start, end + 1e-9, motion.WINDOW_S)
    return (wheels.rates(grid), gyro.rates(grid)) if len(grid) > 1 else None


def _speed_ratios(contexts: Sequence[CheckContext]) -> dict[str, SpeedRatio]:
    found: dict[str, SpeedRatio] = {}
    for source in ("gnss", "truth"):
        paths = [(context, path_by(context.recording, source)) for context in contexts]
        fits = [fit_windows(c, path) or _whole(c, path) for c, path in paths if path is not None]
        parts = [fit for fit in fits if fit is not None]
        if not parts:
            continue
        names = [f.name for f in dataclasses.fields(PathFits)]
        pooled = PathFits(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
        scale = scale_of(pooled, source)
        if scale is not None:
            found[source] = SpeedRatio(scale.ratio, scale.low, scale.high, scale.windows)
    return found


def _whole(context: CheckContext, measured: MeasuredPath) -> PathFits | None:
    """A recording too short for windows as one window; see `path.fit_windows`."""
    reckoned = dead_reckoned(context)
    if reckoned is None:
        return None
    t, _, path = reckoned
    inside = (measured.t_s >= t[0]) & (measured.t_s <= t[-1])
    n = int(inside.sum())
    if n < 3:
        return None
    p, g = np.interp(measured.t_s[inside], t, path), measured.place[inside]
    p, g = p - p.mean(), g - g.mean()
    pp, gg, pg = np.vdot(p, p).real, np.vdot(g, g).real, abs(np.vdot(p, g))
    if min(pp, gg) <= n * max(LEAST_SPREAD_M, 3.0 * measured.sigma_m) ** 2:
        return None
    straight = is_straight(context, p, g)
    fit = (pg / pp, pg / np.sqrt(pp * gg), pp, np.sqrt(gg / pp), np.nan, straight)  # too few for a scatter
    return PathFits(*(np.array([value]) for value in fit))


def _lags(context: CheckContext) -> Iterator[PairLag]:
    """Lags between the channels of `LAG_PAIRS` that are there."""
    for quantity, pairs in LAG_PAIRS.items():
        for (one, other), signals in motion.signal_pairs(context, {quantity: pairs}).items():
            # A command is followed with a delay: far off there is only the next step that is like it.
            lag = (near_lag if one == "command" else far_lag)(*signals)
            if lag is None or lag.r < LEAST_R or opposed(lag, *signals):
                continue
            late, low, high = float(lag.seconds), float(lag.low_s), float(lag.high_s)
            if late >= 0.0:
                yield PairLag(quantity, one, other, late, low, high, lag.r)
            else:
                yield PairLag(quantity, other, one, -late, -high, -low, lag.r)


def _aligned(context: CheckContext, lags: Sequence[PairLag]) -> CheckContext:
    """The context with the wheels' times shifted onto the clock that their lag was measured against."""
    wheels = context.recording.wheels
    measured = (lag for lag in lags if "wheels" in (lag.earlier, lag.later) and lag.earlier != "command")
    lag = next(measured, None)
    if wheels is None or lag is None:
        return context
    late_ns = round((lag.seconds if lag.later == "wheels" else -lag.seconds) * 1e9)
    shifted = with_fields(context.recording, "wheels", t_ns=wheels.t_ns - late_ns)
    return dataclasses.replace(context, recording=shifted)


def _paths(contexts: Sequence[CheckContext]) -> dict[str, float]:
    """Path lengths by channel, summed over the recordings."""
    total: Counter[str] = Counter()
    for context in contexts:
        total.update(dict(_path_lengths(context)))
    return dict(total)


def _path_lengths(context: CheckContext) -> Iterator[tuple[str, float]]:
    recording, radius = context.recording, context.wheel_radius_m()
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth
    if wheels is not None and radius is not None and len(wheels) > 1:
        v = np.nan_to_num(np.abs(wheels.side_speeds_mps(radius).mean(axis=1)))
        dt = np.diff(wheels.t_ns) * 1e-9
        dt[is_gap(wheels.t_ns)] = 0.0  # how far it went there is unknown
        yield "wheels", float(np.sum(0.5 * (v[1:] + v[:-1]) * dt))
    if gnss is not None:
        yield "gnss", _ruler_path_m(gnss.enu_m, max(0.5, RULER_SIGMAS * (motion.typical_sigma(gnss) or 1.0)))
    if truth is not None and np.isfinite(truth.position_m[:, 0]).any():
        yield "truth", _ruler_path_m(truth.position_m, 0.1)


def _ruler_path_m(position_m: Array, ruler_m: float) -> float:
    """Length of the path in steps longer than the ruler."""
    points = position_m[np.isfinite(position_m[:, :2]).all(axis=1), :2].tolist()
    if not points:
        return 0.0
    (x, y), length, step = points[0], 0.0, 0.0
    for east, north in points[1:]:
        step = float(np.hypot(east - x, north - y))
        if step > ruler_m:
            x, y, length, step = east, north, length + step, 0.0
    return length + step


def _sigma(contexts: Sequence[CheckContext]) -> SigmaRange | None:
    sigmas = [p.recording.gnss.sigma_enu_m[:, :2].ravel() for p in contexts if p.recording.gnss is not None]
    known = np.concatenate([np.zeros(0), *sigmas])
    known = known[np.isfinite(known)]
    return SigmaRange(float(known.min()), float(np.median(known)), float(known.max())) if known.size else None


def _held(contexts: Sequence[CheckContext]) -> dict[str, UpdateRate]:
    """Channels that hold their values, by the median over the recordings."""
    rates: dict[str, list[tuple[float, float]]] = {}
    for context in contexts:
        for name, fields in MEASURED.items():
            channel = getattr(context.recording, name)
            if channel is None:
                continue
            t_ns, values = channel.t_ns, np.hstack([getattr(channel, field) for field in fields])
            span_s = float(t_ns[-1] - t_ns[0]) * 1e-9 if len(t_ns) > 1 else 0.0
            rows = held_rows(values)
            if span_s > 0.0 and rows > 1:
                updates = int(true_updates(values, rows).sum())
                rates.setdefault(name, []).append(((len(t_ns) - 1) / span_s, (updates - 1) / span_s))
    found = {name: UpdateRate(*np.median(np.array(pairs), axis=0).tolist()) for name, pairs in rates.items()}
    return {name: one for name, one in found.items() if one.update_hz < HELD * one.rate_hz}
