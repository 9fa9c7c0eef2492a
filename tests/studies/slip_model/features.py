"""Features of a second or two of wheels and IMU that need no fix, and the slip over the same time.

All are relative to the robot: ratios of what IMU and wheels say of one motion, or logarithms. The direct
evidence of slip is dynamics: in a turn the body's lateral acceleration is speed times yaw rate, and a surge
of the wheels should be one of the body. Both are fitted through the origin with a ridge, so that where the
motion shows nothing the number is 0 and its information is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.sensors import Rig

Array = NDArray[np.float64]

GRID_S, HOP_S, SPANS_S = 0.05, 0.5, (2.0, 6.0)
LABEL_S = 2.0
LEAST_ROLLED_M = 0.6
BIAS_S = 60.0
"""Time over which the mean specific force counts as bias and tilt."""
TURN_NOISE_RAD, LATERAL_NOISE, SURGE_NOISE = 0.15, 0.25, 0.25
SLIP_RANGE = (-1.0, 1.5)
NAMES = tuple(
    f"{name}_{span:g}s"
    for span in SPANS_S
    for name in (
        "speed", "turning", "yaw_slip", "yaw_known", "lateral_slip", "lateral_known", "surge_slip",
        "surge_known", "wheel_surge", "rough_z", "rough_xy", "backwards",
    )
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SlipWindows:
    """Features (n, d) at `end_s` (n,); slip (n,) over `LABEL_S`, NaN where unknown, and `rolled_m` then."""

    end_s: Array
    x: Array
    slip: Array
    rolled_m: Array


def windows_of(recording: Recording, rig: Rig) -> SlipWindows | None:
    """Windows of a recording with wheels of both sides; None where wheels or IMU are missing."""
    wheels, imu = recording.wheels, recording.imu
    if wheels is None or imu is None or len(wheels.t_ns) < 10:
        return None
    t_w, t_i = ((c.t_ns - recording.start_ns) * 1e-9 for c in (wheels, imu))
    if wheels.has_sides():
        sides = wheels.side_speeds_mps(rig.wheel_radius_m)
        speed, turn = sides.mean(axis=1), (sides[:, 1] - sides[:, 0]) / rig.track_m
    else:
        speed = wheels.speed[:, 0] * (1.0 if wheels.unit == "mps" else rig.wheel_radius_m)
        turn = np.full(len(speed), np.nan)
    begin, end = max(t_w[0], t_i[0]), min(t_w[-1], t_i[-1])
    grid = np.arange(begin, end, GRID_S)
    if len(grid) < 8.0 / GRID_S:
        return None
    accel = np.stack([_means(t_i, imu.accel_mps2[:, k], grid) for k in range(3)], axis=1)
    gyro = _means(t_i, imu.gyro_radps[:, 2], grid)
    w, wz = np.interp(grid, t_w, speed), np.interp(grid, t_w, turn)
    ends = np.arange(begin + SPANS_S[0] + GRID_S, end, HOP_S)
    x = np.hstack([_features(grid, w, wz, gyro, accel, ends, span) for span in SPANS_S])
    slip, rolled = _slip(recording, grid, w, ends)
    return SlipWindows(ends, x, slip, rolled)


def _means(t_s: Array, values: Array, grid: Array) -> Array:
    """Mean of samples around each time of the grid, by the integral of the signal."""
    if not np.isfinite(values).all():
        return np.full(len(grid), np.nan)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    low, high = (np.clip(grid + s * GRID_S, t_s[0], t_s[-1]) for s in (-0.5, 0.5))
    return np.asarray((np.interp(high, t_s, integral) - np.interp(low, t_s, integral)) / (high - low))


def _features(grid: Array, w: Array, wz: Array, gyro: Array, accel: Array, ends: Array, span: float) -> Array:
    n = round(span / GRID_S)
    rows = np.searchsorted(grid, ends)

    def total(values: Array) -> Array:
        sums = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
        return np.asarray(sums[rows] - sums[np.maximum(rows - n, 0)]) * GRID_S

    bias = np.stack([_slow(accel[:, k]) for k in range(2)], axis=1)
    surge_b, lateral_b = (accel[:, k] - bias[:, k] for k in range(2))
    smooth = np.convolve(w, np.ones(7) / 7.0, "same")
    surge_w, lateral_w = np.gradient(smooth, GRID_S), w * gyro
    moved, speed = total(w), total(np.abs(w)) / span
    turned, turned_w = total(gyro), total(wz)
    known_yaw = turned_w**2 / (turned_w**2 + TURN_NOISE_RAD**2)
    yaw = known_yaw * (1.0 - turned * turned_w / np.maximum(turned_w**2, 1e-9))
    known_l, lateral = _share(total, lateral_w, lateral_b, LATERAL_NOISE)
    known_s, surge = _share(total, surge_w, surge_b, SURGE_NOISE)
    if not np.isfinite(wz).all():
        yaw, known_yaw = 0.0 * yaw, 0.0 * known_yaw
    rate = np.sqrt(np.maximum(speed, 0.2))
    rough = [_level(total, surge_b, span), _level(total, accel[:, 2], span)]
    turning = np.abs(total(np.abs(gyro))) / (np.abs(total(np.abs(gyro))) + speed * span + 0.1)
    return np.stack([
        np.log(speed + 0.1), turning, yaw, known_yaw, lateral, known_l, surge, known_s,
        np.log(total(surge_w**2) / span + 1e-2), np.log(rough[1] / rate + 1e-2),
        np.log(rough[0] / rate + 1e-2), (moved < 0.0).astype(float),
    ], axis=1)  # fmt: skip


def _share(total: object, of_wheels: Array, of_body: Array, noise: float) -> tuple[Array, Array]:
    """Information in [0, 1) and slip times it, of a body acceleration that the wheels predict."""
    power, product = total(of_wheels**2), total(of_wheels * of_body)  # type: ignore[operator]
    if not np.isfinite(of_body).all():
        return 0.0 * power, 0.0 * power
    return power / (power + noise), np.clip((power - product) / (power + noise), -2.0, 2.0)


def _level(total: object, values: Array, span: float) -> Array:
    """RMS of what changes within a few grid steps."""
    quick = values - np.convolve(values, np.ones(5) / 5.0, "same")
    return np.sqrt(np.maximum(total(quick**2), 0.0) / span)  # type: ignore[operator]


def _slow(values: Array) -> Array:
    """Mean up to each time, forgetting over `BIAS_S`: causal, as live."""
    if not np.isfinite(values).all():
        return np.zeros(len(values))
    keep = np.exp(-GRID_S / BIAS_S)
    out, mean, weight = np.empty(len(values)), 0.0, 0.0
    for i, value in enumerate(values):
        weight = keep * weight + 1.0
        mean += (value - mean) / weight
        out[i] = mean
    return out


def _slip(recording: Recording, grid: Array, w: Array, ends: Array) -> tuple[Array, Array]:
    """Slip (n,) along the body over `LABEL_S`, and the distance rolled (n,)."""
    sums = np.concatenate([[0.0], np.cumsum(w) * GRID_S])
    edges = np.concatenate([grid, [grid[-1] + GRID_S]])

    def over(t: Array, path: Array) -> Array:
        return np.asarray(np.interp(ends, t, path) - np.interp(ends - LABEL_S, t, path))

    rolled = over(edges, sums)
    truth, gnss = recording.truth, recording.gnss
    if truth is not None and len(truth):
        t = (truth.t_ns - recording.start_ns) * 1e-9
        R = quaternion_to_matrix(truth.quaternion)
        good = np.isfinite(truth.position_m[:, :2]).all(axis=1) & np.isfinite(R[:, 0, 0])
        step = np.diff(truth.position_m[good, :2], axis=0)
        along = np.sum(step * R[good][:-1, :2, 0], axis=1)
        forward = over(t[good], np.concatenate([[0.0], np.cumsum(along)]))
        first, last = t[good][0], t[good][-1]
    elif gnss is not None and len(gnss):
        t = (gnss.t_ns - recording.start_ns) * 1e-9
        moved = np.stack([over(t, gnss.enu_m[:, k]) for k in (0, 1)])
        forward, first, last = np.hypot(*moved) * np.sign(rolled), t[0], t[-1]
    else:
        return np.full(len(ends), np.nan), rolled
    known = (np.abs(rolled) > LEAST_ROLLED_M) & (ends - LABEL_S >= first) & (ends <= last)
    slip = np.full(len(ends), np.nan)
    slip[known] = np.clip(1.0 - forward[known] / rolled[known], *SLIP_RANGE)
    return slip, rolled
