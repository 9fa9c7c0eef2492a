"""Wheel speed commands: commanded segments, limits of the robot's controller, delays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.blind.plant.spec import RunSpec

Array = NDArray[np.float64]

HUNTING_HZ = 0.9


def commanded_twist(spec: RunSpec, t_s: Array) -> Array:
    """Commanded speed and yaw rate (N, 2) at times (N,) before any limit; the last segment holds on."""
    ends = np.cumsum([segment.duration_s for segment in spec.drive])
    which = np.minimum(np.searchsorted(ends, t_s, side="right"), len(ends) - 1)
    begun = np.concatenate([[0.0], ends])[which]
    values = np.array(
        [(s.v_mps, s.yaw_rate_radps, s.v_amplitude_mps, s.yaw_rate_amplitude_radps, s.hz) for s in spec.drive]
    )[which]
    wave = np.sin(2.0 * np.pi * values[:, 4] * (t_s - begun))
    return np.stack([values[:, 0] + values[:, 2] * wave, values[:, 1] + values[:, 3] * wave], axis=1)


def side_commands(specs: Sequence[RunSpec], n: dict[str, Any], t_s: Array) -> Array:
    """Commanded wheel speeds (N, 2, B), left and right, rad/s, as they reach the speed loops."""
    dt = float(t_s[1] - t_s[0])
    command = np.stack([commanded_twist(spec, t_s) for spec in specs], axis=-1)  # (N, 2, B)
    drives = [spec.vehicle.drive for spec in specs]
    top = np.array([drive.max_speed_mps for drive in drives])
    command[:, 0] = np.clip(command[:, 0], -top, top)
    steps = dt * np.array([[d.max_accel_mps2 for d in drives], [d.max_yaw_accel_radps2 for d in drives]])
    twist = np.empty_like(command)
    now = np.zeros_like(command[0])
    for i, goal in enumerate(command):
        now = now + np.clip(goal - now, -steps, steps)
        twist[i] = now
    odometry = [spec.vehicle.odometry for spec in specs]
    half = 0.5 * np.array([o.track_m for o in odometry]) * twist[:, 1]
    radius = np.array([o.wheel_radius_m for o in odometry])
    hunting = 1.0 + n["change_hunting"] * np.sin(2.0 * np.pi * HUNTING_HZ * t_s)[:, None]
    sides = np.stack([twist[:, 0] - half, twist[:, 0] + half], axis=1) * (hunting / radius)[:, None]
    return _delayed(sides, t_s, n)


def _delayed(sides: Array, t_s: Array, n: dict[str, Any]) -> Array:
    late, hold, lag = n["dead_s"] + n["change_late_s"], n["change_hold_s"], n["change_lag_second_s"]
    for b in np.flatnonzero((late > 0.0) | (hold > 0.0)):
        at = t_s - late[b]
        if hold[b] > 0.0:
            at = 2.0 * hold[b] * np.floor(at / (2.0 * hold[b]))
        for side in (0, 1):
            sides[:, side, b] = np.interp(at, t_s, sides[:, side, b])
    for b in np.flatnonzero(lag > 0.0):
        keep = np.exp(-(t_s[1] - t_s[0]) / (0.5 * lag[b]))
        for _ in range(2):
            sides[..., b] = _low_passed(sides[..., b], keep)
    return sides


def _low_passed(values: Array, keep: float) -> Array:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values, axis=0))
