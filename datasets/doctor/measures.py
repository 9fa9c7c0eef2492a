"""What the channels of a log say of each other, measured: gravity, lags, scales, paths, true rates.

Nothing here judges; the checks do. Several recordings of one robot are measured as a pool: their
samples are put together, which tells of windows of 2 s what none of them tells alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.conventions import true_updates
from terrafusion.datasets.doctor.finding import Patient
from terrafusion.datasets.doctor.magnitude import check_magnitude
from terrafusion.datasets.doctor.motion import speed_ratios
from terrafusion.datasets.lag import held_rows, lag_between
from terrafusion.datasets.recording import Fix, Gnss, Recording
from terrafusion.datasets.sensors import Rig

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]
Signal = tuple[TimesNs, Array]

STRAIGHT_S = 10.0
"""Length of the stretches over which speeds are compared; shorter in recordings that are shorter."""
YAW_GRID_S = 0.5
CHORD_S = 0.5
"""Half the time over which positions are differenced to a speed."""
LAG_PAIRS = {
    "yaw rate": (("imu", "wheels"), ("imu", "truth"), ("command", "wheels")),
    "speed": (("wheels", "gnss"), ("wheels", "truth"), ("command", "wheels")),
}
"""By quantity: channels whose accounts of it are compared in time."""
LEAST_R = 0.5
"""A lag at a lower correlation is noise; it is not told."""
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
    is wider than the one it was built with. None where the wheel radius is unknown.
    """

    r: float
    effective_track_m: float | None
    seconds: float


@dataclass(frozen=True)
class Ratio:
    """Speed of the ground over speed of the wheels: median of straight stretches, its 95 % interval."""

    median: float
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
    patients = [Patient(recording, rig) for recording in recordings]
    patients = [patient for patient in patients if not list(check_magnitude(patient))]
    if not patients:
        return Measures()  # numbers beyond anything possible are not computed with
    return Measures(
        gravity=_gravity(patients),
        yaw=_yaw(patients),
        speed_ratio=_speed_ratios(patients),
        lags=tuple(_lags(patients[0])) if len(recordings) == 1 else (),
        path_m=_paths(patients),
        sigma_m=_sigma(patients),
        held=_held(patients),
    )


def _gravity(patients: Sequence[Patient]) -> Gravity | None:
    imus = [p.recording.imu for p in patients]
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


def _yaw(patients: Sequence[Patient]) -> YawFit | None:
    pairs = [pair for patient in patients if (pair := _yaw_pair(patient)) is not None]
    if not pairs:
        return None
    turn, rate = (np.concatenate([pair[k] for pair in pairs]) for k in range(2))
    known = np.isfinite(turn) & np.isfinite(rate)
    turn, rate = turn[known], rate[known]
    if len(turn) < 20 or not min(turn.std(), rate.std()) > 1e-9:
        return None
    covariance = np.cov(turn, rate)
    r = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    metric = all(patient.wheel_radius_m() is not None for patient in patients)
    track = float(covariance[0, 1] / covariance[1, 1]) if metric and abs(r) > LEAST_R else None
    return YawFit(r, track, len(turn) * YAW_GRID_S)


def _yaw_pair(patient: Patient) -> tuple[Array, Array] | None:
    """Half-second means of right less left wheel speed (m/s; rad/s without a radius) and of gyro z."""
    wheels, imu = patient.recording.wheels, patient.recording.imu
    if wheels is None or imu is None or not wheels.has_sides() or min(len(wheels), len(imu)) < 2:
        return None
    sides = wheels.side_speeds_mps(patient.wheel_radius_m() or 1.0)
    origin = max(wheels.t_ns[0], imu.t_ns[0])
    common_s = float(min(wheels.t_ns[-1], imu.t_ns[-1]) - origin) * 1e-9
    edges = np.arange(0.0, common_s + 1e-9, YAW_GRID_S)
    if len(edges) < 2:
        return None
    turn = _means(edges, (wheels.t_ns - origin) * 1e-9, sides[:, 1] - sides[:, 0])
    return turn, _means(edges, (imu.t_ns - origin) * 1e-9, imu.gyro_radps[:, 2])


def _means(edges: Array, t_s: Array, values: Array) -> Array:
    """Means of the samples between neighbouring edges, (len(edges) - 1,); NaN where there is none."""
    known = np.isfinite(values)
    counts, _ = np.histogram(t_s[known], edges)
    sums, _ = np.histogram(t_s[known], edges, weights=values[known])
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _speed_ratios(patients: Sequence[Patient]) -> dict[str, Ratio]:
    found: dict[str, Ratio] = {}
    for name, ground in (("gnss", _fixes), ("truth", _truth_as_fixes)):
        ratios = np.concatenate([np.zeros(0), *(_ratios(patient, ground) for patient in patients)])
        if len(ratios) >= 3:
            low, high = _median_interval(ratios)
            found[name] = Ratio(float(np.median(ratios)), low, high, len(ratios))
    return found


def _ratios(patient: Patient, ground: Callable[[Recording], Gnss | None]) -> Array:
    recording, radius = patient.recording, patient.wheel_radius_m()
    fixes = ground(recording)
    if recording.wheels is None or fixes is None or radius is None or len(fixes) < 2:
        return np.zeros(0)
    window_s = min(STRAIGHT_S, 0.9 * recording.duration_s())
    return speed_ratios(recording.wheels, fixes, radius, window_s)


def _fixes(recording: Recording) -> Gnss | None:
    gnss = recording.gnss
    return gnss if gnss is not None and np.isfinite(gnss.sigma_enu_m[:, :2]).any() else None


def _truth_as_fixes(recording: Recording) -> Gnss | None:
    truth = recording.truth
    if truth is None or len(truth) < 2:
        return None
    n = len(truth)
    return Gnss(truth.t_ns, truth.position_m, np.full((n, 3), 0.01), np.full(n, Fix.FIXED, dtype=np.uint8))


def _median_interval(values: Array) -> tuple[float, float]:
    """95 % interval of the median by order statistics; neighbours overlap by half and count as one."""
    ordered, n = np.sort(values), len(values)
    reach = 1.96 * 0.5 * np.sqrt(n * 2.0)
    low, high = (int(np.clip(round(0.5 * (n - 1) + s * reach), 0, n - 1)) for s in (-1, 1))
    return float(ordered[low]), float(ordered[high])


def _lags(patient: Patient) -> Iterator[PairLag]:
    """Lags between the channels of `LAG_PAIRS` that are there."""
    radius = patient.wheel_radius_m() or 1.0
    accounts = {
        "yaw rate": _yaw_rates(patient.recording, radius),
        "speed": _speeds(patient.recording, radius),
    }
    for quantity, pairs in LAG_PAIRS.items():
        signals = accounts[quantity]
        for one, other in pairs:
            if one not in signals or other not in signals:
                continue
            (t_one, a), (t_other, b) = signals[one], signals[other]
            lag = lag_between((t_one - t_one[0]) * 1e-9, a, (t_other - t_one[0]) * 1e-9, b)
            if lag is None or lag.r < LEAST_R:
                continue
            late, low, high = float(lag.seconds), float(lag.low_s), float(lag.high_s)
            if late >= 0.0:
                yield PairLag(quantity, one, other, late, low, high, lag.r)
            else:
                yield PairLag(quantity, other, one, -late, -high, -low, lag.r)


def _yaw_rates(recording: Recording, radius: float) -> dict[str, Signal]:
    """Every channel's account of the yaw rate; that of the wheels up to the track."""
    found: dict[str, Signal] = {}
    if recording.imu is not None:
        found["imu"] = recording.imu.t_ns, recording.imu.gyro_radps[:, 2]
    wheels, truth, command = recording.wheels, recording.truth, recording.command
    if wheels is not None and wheels.has_sides():
        sides = wheels.side_speeds_mps(radius)
        found["wheels"] = wheels.t_ns, sides[:, 1] - sides[:, 0]
    if truth is not None and truth.quaternion is not None and len(truth) > 2:
        found["truth"] = truth.t_ns, np.gradient(np.unwrap(truth.yaw_rad()), truth.t_ns * 1e-9)
    if command is not None:
        found["command"] = command.t_ns, command.yaw_rate_radps
    return {name: signal for name, signal in found.items() if np.isfinite(signal[1]).sum() > 1}


def _speeds(recording: Recording, radius: float) -> dict[str, Signal]:
    """Every channel's account of the speed, without sign: fixes do not know it."""
    found: dict[str, Signal] = {}
    wheels, gnss, truth, command = recording.wheels, recording.gnss, recording.truth, recording.command
    if wheels is not None:
        found["wheels"] = wheels.t_ns, np.abs(wheels.side_speeds_mps(radius).mean(axis=1))
    if gnss is not None and len(gnss) > 2:
        known = gnss.velocity_enu_mps is not None and np.isfinite(gnss.velocity_enu_mps[:, :2]).any()
        velocity = gnss.velocity_enu_mps if known else None
        by_chord = _chord_speeds(gnss.t_ns, gnss.enu_m)
        found["gnss"] = gnss.t_ns, by_chord if velocity is None else np.hypot(*velocity[:, :2].T)
    if truth is not None and len(truth) > 2:
        found["truth"] = truth.t_ns, _chord_speeds(truth.t_ns, truth.position_m)
    if command is not None:
        found["command"] = command.t_ns, np.abs(command.v_mps)
    return {name: signal for name, signal in found.items() if np.isfinite(signal[1]).sum() > 1}


def _chord_speeds(t_ns: TimesNs, position_m: Array) -> Array:
    """Speed (N,) from the places half a second before and after; NaN near the ends."""
    t = (t_ns - t_ns[0]) * 1e-9
    known = np.isfinite(position_m[:, :2]).all(axis=1)
    speed = np.full(len(t), np.nan)
    if known.sum() < 2:
        return speed
    ends = np.stack([t - CHORD_S, t + CHORD_S])
    steps = [np.diff(np.interp(ends, t[known], position_m[known, k]), axis=0)[0] for k in range(2)]
    inside = (ends[0] >= t[known][0]) & (ends[1] <= t[known][-1])
    speed[inside] = (np.hypot(*steps) / (2.0 * CHORD_S))[inside]
    return speed


def _paths(patients: Sequence[Patient]) -> dict[str, float]:
    """Lengths of path by channel, summed over the recordings."""
    total: dict[str, float] = {}
    for patient in patients:
        for name, length in _path_lengths(patient):
            total[name] = total.get(name, 0.0) + length
    return total


def _path_lengths(patient: Patient) -> Iterator[tuple[str, float]]:
    recording, radius = patient.recording, patient.wheel_radius_m()
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


def _sigma(patients: Sequence[Patient]) -> Sigma | None:
    sigmas = [p.recording.gnss.sigma_enu_m[:, :2].ravel() for p in patients if p.recording.gnss is not None]
    known = np.concatenate([np.zeros(0), *sigmas])
    known = known[np.isfinite(known)]
    if not known.size:
        return None
    return Sigma(float(known.min()), float(np.median(known)), float(known.max()))


def _held(patients: Sequence[Patient]) -> dict[str, Updates]:
    """Channels that hold their values, by the median over the recordings."""
    rates: dict[str, list[tuple[float, float]]] = {}
    for patient in patients:
        for name, t_ns, values in _sensed(patient.recording):
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
