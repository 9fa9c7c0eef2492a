"""Surface features of a labelled log, for the ground classifier of one robot.

The detector of the estimator (`terrain.features`) has seven features that do not depend on the robot. With
labelled
logs of one robot more can be used: spectra of six vibration axes, wheels, gyro and motor current over two
seconds, as logarithms, so that speed, load and sensor gain are shifts. Missing features are NaN. Bias, tilt
and absolute heading, which would identify the place or day, are left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording

WINDOW_S = 2.0
RECENT_S = 1.0
"""Last part of a window, classified by itself: a new ground fills it twice as soon."""
HOP_S = 0.5
BANDS_HZ = ((1.5, 3.0), (3.0, 6.0), (6.0, 10.0), (10.0, 14.0), (14.0, 20.0), (20.0, 30.0), (30.0, 45.0))
AXES = ("roll", "pitch", "yaw", "x", "y", "z")
VIBRATION = tuple(f"{axis}_{low:g}_hz" for low, _ in BANDS_HZ for axis in AXES)
SHAPE = ("kurtosis_z", "kurtosis_x", "crest_z", "correlation_xz")
MOTION = ("speed", "turning", "speed_scatter")
YAW = ("yaw_lost", "yaw_scatter")
CURRENT = ("driving_current",)
SURFACE_FEATURES = VIBRATION + SHAPE + MOTION + YAW + CURRENT
GROUPS: dict[str, tuple[str, ...]] = {
    "gyro spectrum": tuple(n for n in VIBRATION if n.split("_")[0] in AXES[:3]),
    "accelerometer spectrum": tuple(n for n in VIBRATION if n.split("_")[0] in AXES[3:]),
    "spectrum above 10 Hz": tuple(n for n in VIBRATION if float(n.split("_")[1]) >= 10.0),
    "shape of the vibration": SHAPE,
    "wheel speed and turning": MOTION,
    "gyro against wheels": YAW,
    "motor current": CURRENT,
}
"""Groups of features by sensor, for ablation."""

_SPEED_FLOOR_MPS = 0.05
_POWER_FLOOR = 1e-7
_LEAST_SPAN = 0.9
_SHORTEST_SPAN = 0.8
"""Shares of a window that IMU samples, and both sensors together, must span."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals of a run from which features are computed.

    Times in s; `gyro_radps` and `accel_mps2` (n, 3) body axes, `sides_mps` (m, 2) circumferential speed
    left and right, `current_a` (k, 2).
    """

    imu_s: Array
    gyro_radps: Array
    accel_mps2: Array
    wheels_s: Array
    sides_mps: Array
    track_m: float
    current_s: Array
    current_a: Array

    def between(self, begin_s: float, end_s: float) -> "Signals":
        """The samples in (begin, end]."""

        def cut(t: Array) -> slice:
            low, high = np.searchsorted(t, [begin_s + 1e-9, end_s + 1e-9])
            return slice(int(low), int(high))

        imu, wheels, current = cut(self.imu_s), cut(self.wheels_s), cut(self.current_s)
        return Signals(
            self.imu_s[imu], self.gyro_radps[imu], self.accel_mps2[imu], self.wheels_s[wheels],
            self.sides_mps[wheels], self.track_m, self.current_s[current], self.current_a[current],
        )  # fmt: skip

    def end_s(self) -> float:
        """End of the time covered by both IMU and wheels."""
        return float(min(self.imu_s[-1], self.wheels_s[-1]))


def signals_of(recording: Recording) -> Signals:
    """The signals of a recording.

    Raises:
        DataError: no IMU, or no wheels of two sides.
    """
    from terrafusion.twin.model.choose import choose_vehicle

    imu, wheels, motor = recording.imu, recording.wheels, recording.motor
    if imu is None or wheels is None or not wheels.has_sides():
        raise DataError(f"{recording.name}: an IMU and the wheels of both sides are needed")
    rig = choose_vehicle(recording, None)[0].rig()

    def seconds(t_ns: NDArray[np.int64]) -> Array:
        return np.asarray((t_ns - recording.start_ns) * 1e-9, dtype=np.float64)

    return Signals(
        seconds(imu.t_ns), imu.gyro_radps, imu.accel_mps2, seconds(wheels.t_ns),
        wheels.side_speeds_mps(rig.wheel_radius_m), rig.track_m,
        np.empty(0) if motor is None else seconds(motor.t_ns),
        np.empty((0, 2)) if motor is None else motor.current_a,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SurfaceWindows:
    """Features every `HOP_S`.

    Attributes:
        end_s: (n,) ends of the windows.
        x: (n, d) features of the windows.
        recent: (n, d) features of the last `RECENT_S` of each.
        rolled_m: (n,) distances rolled since the previous window.
    """

    end_s: Array
    x: Array
    recent: Array
    rolled_m: Array

    def __len__(self) -> int:
        """The number of windows."""
        return len(self.end_s)

    def first(self, count: int) -> "SurfaceWindows":
        """The first `count` of them."""
        return SurfaceWindows(self.end_s[:count], self.x[:count], self.recent[:count], self.rolled_m[:count])


def surface_windows(signals: Signals) -> SurfaceWindows:
    """Features of the windows of a run."""
    begin = max(float(signals.imu_s[0]), float(signals.wheels_s[0]))
    span = signals.end_s() - begin
    # A log of one window of two seconds spans a sample less.
    count = max(int((span - WINDOW_S) / HOP_S + 1.0), int(span > _SHORTEST_SPAN * WINDOW_S))
    ends: Array = begin + WINDOW_S + HOP_S * np.arange(count, dtype=np.float64)
    x: Array = np.full((len(ends), len(SURFACE_FEATURES)), np.nan)
    recent: Array = x.copy()
    rolled: Array = np.zeros(len(ends))
    for i, end in enumerate(ends):
        window = signals.between(end - WINDOW_S, end)
        x[i] = window_features(window)
        recent[i] = window_features(window.between(end - RECENT_S, end), RECENT_S)
        if len(window.sides_mps):
            rolled[i] = float(np.abs(window.sides_mps).mean(axis=0).max()) * HOP_S
    return SurfaceWindows(ends, x, recent, rolled)


def window_features(window: Signals, length_s: float = WINDOW_S) -> Array:
    """Features (d,) of a window of `length_s` in the order of `SURFACE_FEATURES`; NaN where not observed."""
    values = dict.fromkeys(SURFACE_FEATURES, np.nan)
    n = len(window.imu_s)
    span = float(window.imu_s[-1] - window.imu_s[0]) if n > 1 else 0.0
    if n >= 16 and span > _LEAST_SPAN * length_s:
        values |= _vibration(window, (n - 1) / span)
    if len(window.sides_mps) >= 3:
        values |= _motion(window)
    return np.array([values[name] for name in SURFACE_FEATURES])


def _vibration(window: Signals, rate_hz: float) -> dict[str, float]:
    signals = np.hstack([window.gyro_radps, window.accel_mps2])
    n = len(signals)
    line = np.arange(n) - (n - 1) / 2.0
    signals = signals - signals.mean(axis=0) - line[:, None] * ((line @ signals) / (line @ line))
    taper = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    density = 2.0 * np.abs(np.fft.rfft(signals * taper[:, None], axis=0)) ** 2 / (rate_hz * (taper @ taper))
    frequency = np.arange(len(density)) * rate_hz / n
    values: dict[str, float] = {}
    for i, (low, high) in enumerate(BANDS_HZ):
        if rate_hz < 2.1 * high:
            continue
        first, end = np.searchsorted(frequency, (low, high))
        power = density[first:end].mean(axis=0) * (high - low)
        power[power == 0.0] = np.nan  # a missing channel, filled in with a constant
        levels = 0.5 * np.log10(power + _POWER_FLOOR)
        names = VIBRATION[i * len(AXES) : (i + 1) * len(AXES)]
        values |= dict(zip(names, levels.tolist(), strict=True))
    spread = signals.std(axis=0)
    if (spread[[3, 5]] > 1e-6).all():  # false for NaN, too
        x, z = signals[:, 3] / spread[3], signals[:, 5] / spread[5]
        values |= {
            "kurtosis_z": float(np.log10((z**4).mean())),
            "kurtosis_x": float(np.log10((x**4).mean())),
            "crest_z": float(np.log10(np.abs(z).max())),
            "correlation_xz": float((x * z).mean()),
        }
    return values


def _motion(window: Signals) -> dict[str, float]:
    sides = window.sides_mps
    rolling = np.abs(sides).mean(axis=0)
    wheel_rate = (sides[:, 1] - sides[:, 0]) / window.track_m
    spin = 0.5 * window.track_m * float(np.abs(wheel_rate).mean())
    values = {
        "speed": float(np.log10(rolling.max() + _SPEED_FLOOR_MPS)),
        "turning": spin / (spin + float(np.abs(sides.mean(axis=1)).mean()) + 0.02),
        "speed_scatter": float(np.log10(sides.std(axis=0).sum() + 0.01)),
    }
    gyro = window.gyro_radps[:, 2]
    if len(gyro) and np.isfinite(gyro).all():
        rate = np.interp(window.wheels_s, window.imu_s, gyro)
        by_wheels = float(np.abs(wheel_rate).mean())
        values["yaw_lost"] = (by_wheels - float(np.abs(rate).mean())) / (by_wheels + 0.1)
        values["yaw_scatter"] = float(np.log10(np.std(np.abs(rate - wheel_rate)) + 0.01))
    if len(window.current_a) >= 3:
        # Weighted by the speed of the side: the current of a standing wheel does not depend on the ground.
        current = np.abs(window.current_a).mean(axis=0)
        values["driving_current"] = float(np.log10((current @ rolling + 0.02) / (rolling.sum() + 0.02)))
    return values
