"""Probes: what a gap could look like that no candidate has in store.

A probe adds a function of what the robot was told to do to one channel: a constant, speed, turn rate, their
rates and products. Whatever the missing physics is, it shows as some dependence of the residuals on the
input.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.rollout.sensitivities import Signature

Array = NDArray[np.float64]

BASIS = (
    "constant",
    "speed",
    "turn_rate",
    "acceleration",
    "turn_acceleration",
    "speed2",
    "abs_turn",
    "lateral",
)
SMOOTH_S = 0.2
"""Rates of the commands are taken over this long."""
PAIRS = {"gnss_east_m": "gnss_position", "gnss_v_e_mps": "gnss_velocity"}
"""Channels that come in pairs of east and north: probes act along and across the robot's heading."""
NORTH = {"gnss_north_m": "gnss_position", "gnss_v_n_mps": "gnss_velocity"}

NAMES = {
    "wheel_left_radps": "wheel_left", "wheel_right_radps": "wheel_right", "wheel_mean_radps": "wheel_left",
    "yaw_rate_radps": "yaw_rate", "accel_x_mps2": "accel_x", "accel_y_mps2": "accel_y",
    "gnss_east_m": "gnss_position", "gnss_north_m": "gnss_position",
    "gnss_v_e_mps": "gnss_velocity", "gnss_v_n_mps": "gnss_velocity",
    "current_left_a": "motor_current", "current_right_a": "motor_current",
}  # fmt: skip
"""Contract name of the channel that each observed one belongs to."""


def told_twist(log: PreparedLog, model: Model) -> tuple[Array, Array]:
    """Times (N,) and told forward speed and turn rate (N, 2) of the log's grid, m/s and rad/s."""
    odometry = model.vehicle.odometry
    left, right = log.sides.T * odometry.wheel_radius_m
    t_s: Array = DT_S * np.arange(float(len(log.sides)))
    return t_s, np.stack([0.5 * (left + right), (right - left) / odometry.track_m], axis=1)


def basis(log: PreparedLog, model: Model, at_s: Array) -> Array:
    """The functions `BASIS` (n, B) of the commands at times (n,), each of order one."""
    t_s, twist = told_twist(log, model)
    width = max(1, round(SMOOTH_S / DT_S))
    rate = np.zeros_like(twist)
    rate[width:] = (twist[width:] - twist[:-width]) / SMOOTH_S
    v, r = (np.interp(at_s, t_s, column) for column in twist.T)
    dv, dr = (np.interp(at_s, t_s, column) for column in rate.T)
    return np.stack([np.ones_like(v), v, 2.0 * r, dv, 0.5 * dr, v * v, 2.0 * np.abs(r), 2.0 * v * r], axis=1)


def names(channels: Sequence[str]) -> list[str]:
    """Names of the probes of these channels, in the order of `columns`."""
    out = []
    for channel in channels:
        if channel in NORTH:
            continue
        ways = ("along", "across") if channel in PAIRS else ("",)
        out += [f"{channel}:{way}{name}" for way in ways for name in BASIS]
    return out


def columns(
    log: PreparedLog, model: Model, observed: Observed, signature: Signature, order: Sequence[str]
) -> Array:
    """Probes (n, G) of one channel's rows, in units of its sigma, among all those of `order` (channels)."""
    f = basis(log, model, 0.5 * (observed.begin_s + observed.end_s)) * np.median(observed.sigma)
    out = []
    heading = signature.heading
    for channel in order:
        if channel in NORTH:
            continue
        mine = observed.channel == channel
        if channel in PAIRS:
            partner = next(c for c, name in NORTH.items() if name == PAIRS[channel])
            east, north = mine, observed.channel == partner
            cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
            zero = np.zeros_like(f)
            out += [f * cos, -f * sin] if east else [f * sin, f * cos] if north else [zero, zero]
        else:
            out.append(f if mine else np.zeros_like(f))
    return np.hstack(out)
