"""What each channel tells of the same motion: yaw rate and speed, on its own clock."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Recording

Array = NDArray[np.float64]
TimesNs = NDArray[np.int64]
Signal = tuple[TimesNs, Array]

CHORD_S = 0.5
"""Half the time over which positions are differenced to a speed."""


def yaw_rates(recording: Recording, wheel_radius_m: float) -> dict[str, Signal]:
    """Every channel's account of the yaw rate; that of the wheels up to the track."""
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
    """Every channel's account of the speed, without sign: fixes do not know it."""
    found: dict[str, Signal] = {}
    wheels, gnss, truth, command = recording.wheels, recording.gnss, recording.truth, recording.command
    if wheels is not None:
        found["wheels"] = wheels.t_ns, np.abs(wheels.side_speeds_mps(wheel_radius_m).mean(axis=1))
    if gnss is not None and len(gnss) > 2:
        velocity = gnss.velocity_enu_mps
        by_chord = velocity is None or not np.isfinite(velocity[:, :2]).any()
        told = chord_speeds(gnss.t_ns, gnss.enu_m) if by_chord else np.hypot(*np.asarray(velocity)[:, :2].T)
        found["gnss"] = gnss.t_ns, told
    if truth is not None and len(truth) > 2:
        found["truth"] = truth.t_ns, chord_speeds(truth.t_ns, truth.position_m)
    if command is not None:
        found["command"] = command.t_ns, np.abs(command.v_mps)
    return {name: signal for name, signal in found.items() if np.isfinite(signal[1]).sum() > 1}


def chord_speeds(t_ns: TimesNs, position_m: Array) -> Array:
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
