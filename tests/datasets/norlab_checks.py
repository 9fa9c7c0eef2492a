"""What physics says of DRIVE recordings: correlations, ratios and lags that their conventions must meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.lag import Lag, lag_between
from terrafusion.datasets.core.recording import Recording

RADIUS_M, TRACK_M = 0.3, 1.08
START_NS = 1_722_278_749_529_941_023


def seconds(channel: object) -> np.ndarray:
    t_ns = channel.t_ns  # type: ignore[attr-defined]
    return np.asarray((t_ns - START_NS) * 1e-9)


def turn(recording: Recording) -> np.ndarray:
    """Right less left side speed, m/s."""
    assert recording.wheels is not None
    sides = recording.wheels.side_speeds_mps(RADIUS_M)
    return np.asarray(sides[:, 1] - sides[:, 0])


def means(t_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Means over the intervals of a grid."""
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    return np.asarray(np.diff(np.interp(grid, t_s, area)) / np.diff(grid))


def yaw_correlation(recordings: Sequence[Recording]) -> float:
    """Gyro z with the wheels' turning: half-second means of a drive, or means of windows."""
    if len(recordings) > 1:
        pairs = [(turn(r).mean(), r.imu.gyro_radps[:, 2].mean()) for r in recordings]  # type: ignore[union-attr]
        return float(np.corrcoef(np.array(pairs).T)[0, 1])
    (r,) = recordings
    assert r.imu is not None
    assert r.wheels is not None
    grid = np.arange(*(seconds(r.wheels)[[0, -1]]), 0.5)
    by_wheels = means(seconds(r.wheels), turn(r), grid)
    return float(np.corrcoef(by_wheels, means(seconds(r.imu), r.imu.gyro_radps[:, 2], grid))[0, 1])


def truth_rates(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mid-times, speed ahead and yaw rate between poses of the truth."""
    truth = recording.truth
    assert truth is not None
    t, yaw = seconds(truth), np.unwrap(truth.yaw_rad())
    dt, middle = np.diff(t), 0.5 * (yaw[1:] + yaw[:-1])
    step = np.diff(truth.position_m[:, :2], axis=0)
    ahead = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / dt
    return 0.5 * (t[1:] + t[:-1]), ahead, np.diff(yaw) / dt


def speeds(recording: Recording) -> tuple[float, float]:
    """Correlation, and ratio, of the speed ahead by the truth to that of the wheels: half-second means."""
    t, ahead, _ = truth_rates(recording)
    assert recording.wheels is not None
    sides = recording.wheels.side_speeds_mps(recording.overrides.wheel_radius_m or 1.0)
    grid = np.arange(max(t[0], seconds(recording.wheels)[0]), min(t[-1], seconds(recording.wheels)[-1]), 0.5)
    a, b = means(t, ahead, grid), means(seconds(recording.wheels), sides.mean(axis=1), grid)
    return float(np.corrcoef(a, b)[0, 1]), float(np.abs(a).sum() / np.abs(b).sum())


def lag_behind_gyro(recording: Recording, what: str) -> Lag:
    imu = recording.imu
    assert imu is not None
    t, _, rate = truth_rates(recording)
    other = (t, rate) if what == "truth" else (seconds(recording.wheels), turn(recording))
    lag = lag_between(seconds(imu), imu.gyro_radps[:, 2], *other)
    assert lag is not None
    return lag


def accelerations(recording: Recording) -> tuple[float, float]:
    """Correlations of accelerometer x with the change of speed, and of its y with speed times yaw rate."""
    imu, wheels = recording.imu, recording.wheels
    assert imu is not None
    assert wheels is not None
    grid = np.arange(*(seconds(wheels)[[0, -1]]), 0.5)
    v = means(seconds(wheels), wheels.side_speeds_mps(RADIUS_M).mean(axis=1), grid)
    x, y, rate = (
        means(seconds(imu), column, grid)
        for column in (imu.accel_mps2[:, 0], imu.accel_mps2[:, 1], imu.gyro_radps[:, 2])
    )
    ahead = np.corrcoef(x, np.gradient(v, 0.5))[0, 1]
    return float(ahead), float(np.corrcoef(y, v * rate)[0, 1])


def joined(recordings: Sequence[Recording]) -> Recording:
    """Windows one after the other as one recording, for checks that need more than 2 s."""
    imus, wheels = [], []
    for k, r in enumerate(recordings):
        assert r.imu is not None
        assert r.wheels is not None
        shift = k * 2_000_000_000 - r.start_ns
        imus.append((r.imu.t_ns + shift, r.imu.gyro_radps, r.imu.accel_mps2))
        wheels.append((r.wheels.t_ns + shift, r.wheels.speed))
    t, gyro, accel = (np.concatenate(part) for part in zip(*imus, strict=True))
    t_wheels, speed = (np.concatenate(part) for part in zip(*wheels, strict=True))
    order = np.argsort(t_wheels, kind="stable")
    return Recording(
        "joined",
        0,
        imu=Imu(t, gyro, accel),
        wheels=Wheels(t_wheels[order], speed[order], ("left", "right"), "radps"),
    )


def codes(recording: Recording) -> set[str]:
    return {finding.code for finding in run_checks(recording)}


def changing_share(recording: Recording, channel: str) -> float:
    """Share of rows that differ from the one before."""
    held = getattr(recording, channel)
    values = held.position_m if channel == "truth" else np.stack(list(held.columns().values()), axis=1)
    return float((np.diff(values, axis=0) != 0).any(axis=1).mean())


def yaw_errors(windows: Sequence[Recording]) -> np.ndarray:
    """Yaw over a window by the truth less that by the gyro at the same times."""
    gyro = joined(windows).imu
    assert gyro is not None
    yaw = np.concatenate([[0.0], np.cumsum(gyro.gyro_radps[1:, 2] * np.diff(gyro.t_ns) * 1e-9)])
    errors = []
    for k, w in enumerate(windows[1:], 1):
        assert w.truth is not None
        t = w.truth.t_ns[1:] + k * 2_000_000_000 - w.start_ns
        if len(t) > 2:
            by_gyro = np.diff(np.interp(t[[0, -1]].astype(float), gyro.t_ns.astype(float), yaw))[0]
            errors.append(np.diff(np.unwrap(w.truth.yaw_rad()[1:])[[0, -1]])[0] - by_gyro)
    return np.abs(np.array(errors))
