"""Yaw rate and speed of the robot as each channel reports them, integrated and compared.

Sources of yaw are gyro z, wheels (right minus left speed, m/s), truth and command; of speed wheels,
GNSS, truth and command. Each keeps its own clock. Pairs of channels that observe the same motion have a lag;
the command is not among them: the robot follows it with a delay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext, once, period_s
from terrafusion.datasets.core.arrays import Array, Complex, Mask, TimesNs
from terrafusion.datasets.core.channels import Gnss
from terrafusion.datasets.core.lag import Lag, lag_between
from terrafusion.datasets.core.recording import Recording

Signal = tuple[TimesNs, Array]

ANY_RADIUS_M = 0.15
"""Wheel radius where it is unknown and only the shape of the speed matters."""
CHORD_S = 0.5
"""Half the interval over which positions are differenced to a speed."""
WINDOW_S, TRUTH_WINDOW_S, LEAST_WINDOWS = 0.5, 1.0, 10
"""Rates are averaged over windows before they are compared; that many windows are needed."""
LEAST_RATE = 0.02
"""Standard deviation of a rate (rad/s, m/s) below which the robot drives straight: no comparison."""
SURE_R = 0.5
COURSE_CHORDS_S = (1.0, 2.0, 4.0, 8.0)
"""Lengths of the chords whose course is compared; the shortest that the noise allows is used."""
STRIDES = 4
"""Chords overlap: this many start per chord length."""


@dataclass(frozen=True)
class Integral:
    """A rate integrated from its first sample: times (N,) s since the start, values (N,)."""

    t_s: Array
    value: Array

    def rates(self, grid_s: Array) -> Array:
        """Mean rates over the intervals of the grid, (len(grid_s) - 1,)."""
        return np.asarray(np.diff(np.interp(grid_s, self.t_s, self.value)) / np.diff(grid_s))


@dataclass(frozen=True)
class Agreement:
    """Correlation `r` of two rates, slope (first over second), windows, standard deviations of both."""

    r: float
    slope: float
    windows: int
    spread: tuple[float, float]

    def is_significant(self) -> bool:
        """Whether |r| exceeds 0.5 and three standard errors (Fisher's z)."""
        z = np.arctanh(min(abs(self.r), 1.0 - 1e-9)) * np.sqrt(max(self.windows - 3, 0))
        return abs(self.r) > SURE_R and bool(z > 3.0)


def seconds(t_ns: TimesNs, start_ns: int) -> Array:
    """Times in seconds since the start of the recording."""
    return np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64)


def cumulative(t_s: Array, rate: NDArray[Any], *, unsigned: bool = False) -> NDArray[Any]:
    """Integral (N,) of a rate by the trapezoid rule, 0 at the first time; of its steps' size if unsigned."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)
    return np.concatenate([[0.0], np.cumsum(np.abs(steps) if unsigned else steps)])


def runs(mask: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First row of each run of True, and the row after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def on_plane(position_m: Array) -> Complex:
    """Horizontal positions (N, 2 or more) as complex numbers, east + i north."""
    return np.asarray(position_m[:, 0] + 1j * position_m[:, 1])


def typical_sigma(gnss: Gnss) -> float:
    """Median horizontal sigma (m) of the fixes that have one, else 0."""
    sigma = gnss.sigma_enu_m[:, :2]
    sigma = sigma[np.isfinite(sigma) & (sigma > 0.0)]
    return float(np.median(sigma)) if sigma.size else 0.0


def integral(start_ns: int, t_ns: TimesNs, rate: Array) -> Integral | None:
    """The integral of the known values of a rate; None where there are fewer than two."""
    known = np.isfinite(rate)
    if known.sum() < 2:
        return None
    t_s = seconds(t_ns[known], start_ns)
    return Integral(t_s, cumulative(t_s, rate[known]))


def gyro_angle(recording: Recording, axis: int = 2) -> Integral | None:
    """Angle turned about one gyro axis; None without a gyro."""
    imu = recording.imu
    return None if imu is None else integral(recording.start_ns, imu.t_ns, imu.gyro_radps[:, axis])


def wheel_speed(context: CheckContext, *, metric: bool = False) -> tuple[Array, Array] | None:
    """Times (N,) s since the start and mean speed (N,) m/s of both sides; None where unknown.

    An unknown wheel radius is replaced by `ANY_RADIUS_M`, or gives None if `metric`.
    """
    wheels, radius = context.recording.wheels, context.wheel_radius_m()
    if wheels is None or (metric and radius is None):
        return None
    speed = wheels.side_speeds_mps(ANY_RADIUS_M if radius is None else radius).mean(axis=1)
    known = np.isfinite(speed)
    if known.sum() < 10:
        return None
    return seconds(wheels.t_ns[known], context.recording.start_ns), speed[known]


def yaw_rates(recording: Recording, wheel_radius_m: float) -> dict[str, Signal]:
    """Yaw rate by channel, rad/s; that of the wheels is right minus left speed, m/s."""
    found: dict[str, Signal] = {}
    imu, wheels, truth, command = recording.imu, recording.wheels, recording.truth, recording.command
    if imu is not None:
        found["imu"] = imu.t_ns, imu.gyro_radps[:, 2]
    if wheels is not None and wheels.has_sides():
        sides = wheels.side_speeds_mps(wheel_radius_m)
        found["wheels"] = wheels.t_ns, sides[:, 1] - sides[:, 0]
    if truth is not None and truth.quaternion is not None:
        yaw = truth.yaw_rad()
        t_ns, yaw = truth.t_ns[np.isfinite(yaw)], yaw[np.isfinite(yaw)]
        if len(yaw) > 2:
            found["truth"] = t_ns, np.gradient(np.unwrap(yaw), (t_ns - t_ns[0]) * 1e-9)
    if command is not None:
        found["command"] = command.t_ns, command.yaw_rate_radps
    return {name: signal for name, signal in found.items() if np.isfinite(signal[1]).sum() > 1}


def speeds(recording: Recording, wheel_radius_m: float) -> dict[str, Signal]:
    """Absolute speed by channel, m/s: GNSS does not observe its sign."""
    found: dict[str, Signal] = {}
    wheels, gnss, truth, command = recording.wheels, recording.gnss, recording.truth, recording.command
    if wheels is not None:
        found["wheels"] = wheels.t_ns, np.abs(wheels.side_speeds_mps(wheel_radius_m).mean(axis=1))
    if gnss is not None and len(gnss) > 2:
        velocity = gnss.velocity_enu_mps
        measured = velocity is not None and np.isfinite(velocity[:, :2]).any()
        found["gnss"] = (
            gnss.t_ns,
            np.hypot(*np.asarray(velocity)[:, :2].T) if measured else chord_speeds(gnss.t_ns, gnss.enu_m),
        )
    if truth is not None and len(truth) > 2:
        found["truth"] = truth.t_ns, chord_speeds(truth.t_ns, truth.position_m)
    if command is not None:
        found["command"] = command.t_ns, np.abs(command.v_mps)
    return {name: signal for name, signal in found.items() if np.isfinite(signal[1]).sum() > 1}


def chord_speeds(t_ns: TimesNs, position_m: Array) -> Array:
    """Speed (N,) from the positions half a second before and after; NaN near the ends."""
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


@once
def yaw_angles(context: CheckContext) -> dict[str, Integral]:
    """Angle turned (rad; of the wheels metres, right minus left) by "gyro", "wheels", "truth", "command"."""
    start, truth = context.recording.start_ns, context.recording.truth
    rates = yaw_rates(context.recording, context.wheel_radius_m() or ANY_RADIUS_M)
    found = {
        "gyro" if name == "imu" else name: integral(start, *signal)
        for name, signal in rates.items()
        if name != "truth"
    }
    if truth is not None and truth.quaternion is not None:
        yaw = truth.yaw_rad()
        known = np.isfinite(yaw)
        if known.sum() > 1:
            found["truth"] = Integral(seconds(truth.t_ns[known], start), np.unwrap(yaw[known]))
    return {name: angle for name, angle in found.items() if angle is not None}


def common_span(a: Integral, b: Integral) -> tuple[float, float]:
    """Start and end of the time that both cover, s."""
    return max(a.t_s[0], b.t_s[0]), min(a.t_s[-1], b.t_s[-1])


def agreement(a: Integral, b: Integral, window_s: float = WINDOW_S) -> Agreement | None:
    """How two rates agree; None on a straight run, or one with few windows in common."""
    start, end = common_span(a, b)
    if not end - start >= LEAST_WINDOWS * window_s:
        return None
    grid = np.arange(start, end, window_s)
    rate_a, rate_b = a.rates(grid), b.rates(grid)
    spread = float(rate_a.std()), float(rate_b.std())
    if min(spread) < LEAST_RATE:
        return None
    r = float(np.corrcoef(rate_a, rate_b)[0, 1])
    return Agreement(r, r * spread[0] / spread[1], len(grid) - 1, spread)


def course_agreement(yaw: Integral, gnss: Gnss, start_ns: int) -> Agreement | None:
    """How the changes of a yaw angle agree with those of the course of the fixes, chord by chord.

    A chord counts where it is longer than 1 m and than five sigma of a fix. Changes near half a turn
    are excluded: there the robot reverses. None where fewer than eight chords count, or on a straight run.
    """
    fixed = np.isfinite(gnss.enu_m[:, :2]).all(axis=1) & (gnss.fix > 0)
    if fixed.sum() < 20:
        return None
    t, place = seconds(gnss.t_ns[fixed], start_ns), on_plane(gnss.enu_m[fixed])
    shortest = max(1.0, 5.0 * typical_sigma(gnss))
    start, end = max(t[0], yaw.t_s[0]), min(t[-1], yaw.t_s[-1])
    for chord_s in COURSE_CHORDS_S:
        grid = np.arange(start, end, chord_s / STRIDES)
        if len(grid) < 12 * STRIDES:
            return None
        points = np.interp(grid, t, place)
        chord = points[STRIDES:] - points[:-STRIDES]
        long = np.abs(chord) > shortest
        by_fixes = np.angle(chord[STRIDES:] * np.conj(chord[:-STRIDES]))
        heading = np.interp(grid[: len(chord)] + 0.5 * chord_s, yaw.t_s, yaw.value)
        by_yaw = heading[STRIDES:] - heading[:-STRIDES]
        use = long[STRIDES:] & long[:-STRIDES] & (np.abs(by_fixes) < 2.5) & (np.abs(by_yaw) < 2.5)
        a, b = by_yaw[use], by_fixes[use]
        if use.sum() >= 8 * STRIDES and min(a.std(), b.std()) > 0.1:
            r = float(np.corrcoef(a, b)[0, 1])
            spread = float(a.std()) / chord_s, float(b.std()) / chord_s
            return Agreement(r, r * spread[0] / spread[1], int(use.sum()) // STRIDES, spread)
    return None


Pair = tuple[str, str]
"""Two channels, the second measured against the first."""
SensorPairs = dict[Pair, tuple[Signal, Signal]]
"""Their measurements of one quantity."""

YAW_PAIRS: tuple[Pair, ...] = (("imu", "wheels"), ("truth", "imu"))
SPEED_PAIRS: tuple[Pair, ...] = (("truth", "wheels"), ("gnss", "wheels"), ("truth", "gnss"))
SENSOR_PAIRS = {"yaw rate": YAW_PAIRS, "speed": SPEED_PAIRS}
"""By the quantity in which two channels are compared."""
LEAST_R = 0.7
NEAR_S, FAR_S = 2.0, 20.0
"""Lags are searched within the first reach; where nothing correlates there, within the second."""
FAR_R = 0.87
"""Least correlation of a lag within the second reach."""


def signal_pairs(context: CheckContext, wanted: Mapping[str, Sequence[Pair]] = SENSOR_PAIRS) -> SensorPairs:
    """The signals of those pairs that the recording has."""
    radius, found = context.wheel_radius_m() or 1.0, {}
    for quantity, pairs in wanted.items():
        signals = (yaw_rates if quantity == "yaw rate" else speeds)(context.recording, radius)
        for one, other in pairs:
            if one in signals and other in signals:
                found[one, other] = signals[one], signals[other]
    return found


def near_lag(one: Signal, other: Signal, reach_s: float = NEAR_S, least_r: float = LEAST_R) -> Lag | None:
    """Lag of the second signal within the reach, where they correlate."""
    if not min(len(one[0]), len(other[0])):
        return None
    origin = one[0][0]
    t_one, t_other = (one[0] - origin) * 1e-9, (other[0] - origin) * 1e-9
    return lag_between(t_one, one[1], t_other, other[1], reach_s=reach_s, least_r=least_r)


def far_lag(one: Signal, other: Signal) -> Lag | None:
    """Lag of the second signal within the near reach, else within the far one."""
    near = near_lag(one, other)
    return near if near is not None else near_lag(one, other, FAR_S, FAR_R)


def odd_one(recording: Recording, off: set[Pair], measured: set[Pair]) -> str:
    """The channel that disagrees with most others, by share, then by number; of equals the slowest."""

    def oddness(name: str) -> tuple[float, int, float]:
        count = sum(name in pair for pair in off)
        period = period_s(getattr(recording, name).t_ns)
        return count / sum(name in pair for pair in measured), count, period

    return max(sorted({name for pair in off for name in pair}), key=oddness)


def reason(name: str, off: set[Pair]) -> str:
    """Why this channel is changed and no other, in words."""
    others = sorted(pair[0] if pair[1] == name else pair[1] for pair in off if name in pair)
    return f"it disagrees with {' and '.join(others)}" if len(others) > 1 else f"{others[0]} is not changed"
