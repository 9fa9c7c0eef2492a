"""What the channels of a log say of each other, measured: gravity, lags, scales, paths, true rates.

Nothing here judges; the checks do. Several recordings of one robot are measured as a pool: their
samples are put together, which tells of windows of 2 s what none of them tells alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.delays import opposed
from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.path import Places, Windows, compare, dead_reckoned, places, scale_of
from terrafusion.datasets.checks.plausibility import check_magnitude
from terrafusion.datasets.checks.sensor_pairs import far_lag, near_lag
from terrafusion.datasets.checks.yaw_signals import LEAST_WINDOWS, WINDOW_S, accounts
from terrafusion.datasets.checks.yaw_sources import speeds, yaw_rates
from terrafusion.datasets.core.conventions import true_updates
from terrafusion.datasets.core.lag import held_rows
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]

LEAST_SPREAD_M = 0.1
"""Root mean square way from its middle that a recording too short for windows must go."""
LAG_PAIRS = {
    "yaw rate": (("imu", "wheels"), ("imu", "truth"), ("command", "wheels")),
    "speed": (("wheels", "gnss"), ("wheels", "truth"), ("command", "wheels")),
}
"""By quantity: channels whose accounts of it are compared in time."""
LEAST_R, LEAST_TRACK_R = 0.5, 0.8
"""A lag, and a track, at a lower correlation is noise; it is not told."""
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
    """Gyro z beside the wheels: correlation of half-second means, and the track that makes them equal.

    The effective track (left and right speed apart by track times yaw rate) of a robot that skids
    is wider than the one it was built with. None where the wheel radius is unknown. A lag is taken
    out first.
    """

    r: float
    effective_track_m: float | None
    seconds: float


@dataclass(frozen=True)
class Ratio:
    """Path over ground over path by wheels and gyro, with its 95 % interval, from so many stretches."""

    ratio: float
    low: float
    high: float
    stretches: int


@dataclass(frozen=True)
class PairLag:
    """`later` tells a quantity `seconds` after `earlier` does (95 % interval), at correlation `r`."""

    quantity: str
    earlier: str
    later: str
    seconds: float
    low_s: float
    high_s: float
    r: float


@dataclass(frozen=True)
class Sigma:
    """Horizontal 1 sigma that the receiver states, m."""

    min: float
    median: float
    max: float


@dataclass(frozen=True)
class Updates:
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
    speed_ratio: dict[str, Ratio] = field(default_factory=dict)
    lags: tuple[PairLag, ...] = ()
    path_m: dict[str, float] = field(default_factory=dict)
    sigma_m: Sigma | None = None
    held: dict[str, Updates] = field(default_factory=dict)


def measure(recordings: Sequence[Recording], rig: Rig | None = None) -> Measures:
    """Measure one recording, or several of one robot as a pool.

    Args:
        recordings: one at least.
        rig: geometry of the robot; without it and without a wheel radius of the log, wheel rates
            in rad/s are not turned into speeds.
    """
    contexts = [CheckContext(recording, rig) for recording in recordings]
    contexts = [context for context in contexts if not list(check_magnitude(context))]
    if not contexts:
        return Measures()  # numbers beyond anything possible are not computed with
    lags = tuple(_lags(contexts[0])) if len(recordings) == 1 else ()
    together = [_brought_together(context, lags) for context in contexts]
    return Measures(
        gravity=_gravity(contexts),
        yaw=_yaw(together),
        speed_ratio=_speed_ratios(together),
        lags=lags,
        path_m=_paths(contexts),
        sigma_m=_sigma(contexts),
        held=_held(contexts),
    )


def _gravity(contexts: Sequence[CheckContext]) -> Gravity | None:
    imus = [p.recording.imu for p in contexts]
    readings = [imu.accel_mps2 for imu in imus if imu is not None and imu.has_accel()]
    if not readings:
        return None
    mean = np.nanmean(np.concatenate(readings), axis=0)
    size = float(np.linalg.norm(mean))
    if not size > 0.0:
        return None
    k = int(np.argmax(np.abs(mean)))
    tilt = np.degrees(np.arccos(np.clip(abs(mean[k]) / size, 0.0, 1.0)))
    x, y, z = mean.tolist()
    return Gravity((x, y, z), size, f"{'+' if mean[k] > 0 else '-'}{'xyz'[k]}", float(tilt))


def _yaw(contexts: Sequence[CheckContext]) -> YawFit | None:
    pairs = [pair for context in contexts if (pair := _yaw_pair(context)) is not None]
    if not pairs:
        return None
    turn, rate = (np.concatenate([pair[k] for pair in pairs]) for k in range(2))
    if len(turn) < LEAST_WINDOWS or not min(turn.std(), rate.std()) > 0.0:
        return None
    covariance = np.cov(turn, rate)
    r = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    metric = all(context.wheel_radius_m() is not None for context in contexts)
    track = float(covariance[0, 1] / covariance[1, 1]) if metric and abs(r) > LEAST_TRACK_R else None
    return YawFit(r, track, len(turn) * WINDOW_S)


def _yaw_pair(context: CheckContext) -> tuple[Array, Array] | None:
    """Half-second means of right less left wheel speed and of gyro z, each (N,)."""
    known = accounts(context)
    if "wheels" not in known or "gyro" not in known:
        return None
    wheels, gyro = known["wheels"], known["gyro"]
    start, end = max(wheels.t_s[0], gyro.t_s[0]), min(wheels.t_s[-1], gyro.t_s[-1])
    grid = np.arange(start, end + 1e-9, WINDOW_S)
    return (wheels.rates(grid), gyro.rates(grid)) if len(grid) > 1 else None


def _speed_ratios(contexts: Sequence[CheckContext]) -> dict[str, Ratio]:
    found: dict[str, Ratio] = {}
    for source in ("gnss", "truth"):
        parts = [
            windows
            for context in contexts
            for true in places(context.recording)
            if true.source == source
            and (windows := compare(context, true) or _whole(context, true)) is not None
        ]
        if not parts:
            continue
        fields = (f.name for f in dataclasses.fields(Windows))
        together = Windows(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields}
        )
        scale = scale_of(together, source)
        if scale is not None:
            found[source] = Ratio(scale.ratio, scale.low, scale.high, scale.windows)
    return found


def _whole(context: CheckContext, true: Places) -> Windows | None:
    """A recording too short for windows as one window; see `path.compare`."""
    reckoned = dead_reckoned(context)
    if reckoned is None:
        return None
    t, _, path = reckoned
    inside = (true.t_s >= t[0]) & (true.t_s <= t[-1])
    n = int(inside.sum())
    if n < 3:
        return None
    p, g = np.interp(true.t_s[inside], t, path), true.place[inside]
    p, g = p - p.mean(), g - g.mean()
    pp, gg, pg = np.vdot(p, p).real, np.vdot(g, g).real, abs(np.vdot(p, g))
    if min(pp, gg) <= n * max(LEAST_SPREAD_M, 3.0 * true.sigma_m) ** 2:
        return None
    return Windows(
        scale=np.array([pg / pp]),
        coherence=np.array([pg / np.sqrt(pp * gg)]),
        weight=np.array([pp]),
        span_ratio=np.array([np.sqrt(gg / pp)]),
        scatter_m=np.array([np.nan]),  # not told by so few
    )


def _lags(context: CheckContext) -> Iterator[PairLag]:
    """Lags between the channels of `LAG_PAIRS` that are there."""
    radius = context.wheel_radius_m() or 1.0
    told = {
        "yaw rate": yaw_rates(context.recording, radius),
        "speed": speeds(context.recording, radius),
    }
    for quantity, pairs in LAG_PAIRS.items():
        signals = told[quantity]
        for one, other in pairs:
            if one not in signals or other not in signals:
                continue
            # A command is followed, not told late: far off there is only the next step that is like it.
            lag = (near_lag if one == "command" else far_lag)(signals[one], signals[other])
            if lag is None or lag.r < LEAST_R or opposed(lag, signals[one], signals[other]):
                continue
            late, low, high = float(lag.seconds), float(lag.low_s), float(lag.high_s)
            if late >= 0.0:
                yield PairLag(quantity, one, other, late, low, high, lag.r)
            else:
                yield PairLag(quantity, other, one, -late, -high, -low, lag.r)


def _brought_together(context: CheckContext, lags: Sequence[PairLag]) -> CheckContext:
    """The context with the wheels' times brought onto the clock that their lag was measured against."""
    wheels = context.recording.wheels
    lag = next(
        (lag for lag in lags if "wheels" in (lag.earlier, lag.later) and lag.earlier != "command"), None
    )
    if wheels is None or lag is None:
        return context
    late_ns = round((lag.seconds if lag.later == "wheels" else -lag.seconds) * 1e9)
    moved = dataclasses.replace(wheels, t_ns=wheels.t_ns - late_ns)
    return dataclasses.replace(context, recording=dataclasses.replace(context.recording, wheels=moved))


def _paths(contexts: Sequence[CheckContext]) -> dict[str, float]:
    """Lengths of path by channel, summed over the recordings."""
    total: dict[str, float] = {}
    for context in contexts:
        for name, length in _path_lengths(context):
            total[name] = total.get(name, 0.0) + length
    return total


def _path_lengths(context: CheckContext) -> Iterator[tuple[str, float]]:
    recording, radius = context.recording, context.wheel_radius_m()
    wheels, gnss, truth = recording.wheels, recording.gnss, recording.truth
    if wheels is not None and radius is not None and len(wheels) > 1:
        v = np.nan_to_num(np.abs(wheels.side_speeds_mps(radius).mean(axis=1)))
        yield "wheels", float(np.sum(0.5 * (v[1:] + v[:-1]) * np.diff(wheels.t_ns)) * 1e-9)
    if gnss is not None:
        sigma = gnss.sigma_enu_m[:, :2]
        sigma = sigma[np.isfinite(sigma) & (sigma > 0.0)]
        yield (
            "gnss",
            _ruler_path_m(gnss.enu_m, max(0.5, 3.0 * float(np.median(sigma)) if sigma.size else 3.0)),
        )
    if truth is not None:
        yield "truth", _ruler_path_m(truth.position_m, 0.1)


def _ruler_path_m(position_m: Array, ruler_m: float) -> float:
    """Length of the path walked in steps longer than the ruler, so that noise at rest adds nothing."""
    points = position_m[np.isfinite(position_m[:, :2]).all(axis=1), :2].tolist()
    if not points:
        return 0.0
    (x, y), length, step = points[0], 0.0, 0.0
    for east, north in points[1:]:
        step = float(np.hypot(east - x, north - y))
        if step > ruler_m:
            x, y, length, step = east, north, length + step, 0.0
    return length + step


def _sigma(contexts: Sequence[CheckContext]) -> Sigma | None:
    sigmas = [p.recording.gnss.sigma_enu_m[:, :2].ravel() for p in contexts if p.recording.gnss is not None]
    known = np.concatenate([np.zeros(0), *sigmas])
    known = known[np.isfinite(known)]
    if not known.size:
        return None
    return Sigma(float(known.min()), float(np.median(known)), float(known.max()))


def _held(contexts: Sequence[CheckContext]) -> dict[str, Updates]:
    """Channels that hold their values, by the median over the recordings."""
    rates: dict[str, list[tuple[float, float]]] = {}
    for context in contexts:
        for name, t_ns, values in _sensed(context.recording):
            span_s = float(t_ns[-1] - t_ns[0]) * 1e-9 if len(t_ns) > 1 else 0.0
            rows = held_rows(values)
            if span_s > 0.0 and rows > 1:
                updates = int(true_updates(values, rows).sum())
                rates.setdefault(name, []).append(((len(t_ns) - 1) / span_s, (updates - 1) / span_s))
    found = {}
    for name, pairs in rates.items():
        rate, update = np.median(np.array(pairs), axis=0).tolist()
        if update < HELD * rate:
            found[name] = Updates(rate, update)
    return found


def _sensed(recording: Recording) -> Iterator[tuple[str, TimesNs, Array]]:
    """What sensors told, by channel; a command may well stand still."""
    wheels, imu, gnss, motor = recording.wheels, recording.imu, recording.gnss, recording.motor
    if wheels is not None:
        yield "wheels", wheels.t_ns, wheels.speed
    if imu is not None:
        yield "imu", imu.t_ns, np.hstack([imu.gyro_radps, imu.accel_mps2])
    if gnss is not None:
        yield "gnss", gnss.t_ns, gnss.enu_m
    if motor is not None:
        yield "motor", motor.t_ns, motor.current_a
    truth = recording.truth
    if truth is not None:
        yield "truth", truth.t_ns, truth.position_m
