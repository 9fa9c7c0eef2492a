"""Nuisance basis: dependences of the residuals on the commands that no candidate explains.

Each function adds a constant, speed, turn rate, their rates or products, to one channel. Missing physics of
any kind shows as some dependence of the residuals on the input.
"""

from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed

BASIS = (
    "constant", "speed", "turn_rate", "acceleration", "turn_acceleration", "speed2", "abs_turn", "lateral",
)  # fmt: skip
SMOOTH_S = 0.2  # interval over which rates of the commands are taken
ACCELERATION_SAMPLES = 51  # grid samples over which an acceleration is averaged
NORTH_OF = {"gnss_east_m": "gnss_north_m", "gnss_v_e_mps": "gnss_v_n_mps"}
"""North channel by east channel: for these the functions act along and across the robot's heading."""
CHANNEL_NAMES = {
    "wheel_left_radps": "wheel_left", "wheel_right_radps": "wheel_right", "wheel_mean_radps": "wheel_left",
    "yaw_rate_radps": "yaw_rate", "accel_x_mps2": "accel_x", "accel_y_mps2": "accel_y",
    "gnss_east_m": "gnss_position", "gnss_north_m": "gnss_position",
    "gnss_v_e_mps": "gnss_velocity", "gnss_v_n_mps": "gnss_velocity",
    "current_left_a": "motor_current", "current_right_a": "motor_current",
}  # fmt: skip
"""Name in `diagnosis.json` of the channel that each observed one belongs to."""

CHANNEL_UNITS = {
    "wheel_left": "rad/s", "wheel_right": "rad/s", "yaw_rate": "rad/s", "accel_x": "m/s2", "accel_y": "m/s2",
    "gnss_position": "m", "gnss_velocity": "m/s", "motor_current": "A",
}  # fmt: skip
"""Unit of each of those."""


def commanded_twist(log: PreparedLog, model: Model) -> tuple[Array, Array]:
    """Times (N,) of the log's grid, and commanded forward speed and turn rate (N, 2), m/s and rad/s."""
    odometry = model.vehicle.odometry
    left, right = log.sides.T * odometry.wheel_radius_m
    t_s: Array = DT_S * np.arange(float(len(log.sides)))
    return t_s, np.stack([0.5 * (left + right), (right - left) / odometry.track_m], axis=1)


def commanded_acceleration(speed_mps: Array) -> Array:
    """Acceleration (N,), m/s2, of commanded speeds (N,) of the grid, averaged over half a second."""
    rate = np.pad(np.gradient(speed_mps, DT_S), ACCELERATION_SAMPLES // 2, mode="edge")
    return np.convolve(rate, np.ones(ACCELERATION_SAMPLES) / ACCELERATION_SAMPLES, mode="valid")


def command_basis(log: PreparedLog, model: Model, at_s: Array) -> Array:
    """The functions `BASIS` (n, B) of the commands at times (n,), each of order one."""
    t_s, twist = commanded_twist(log, model)
    width = max(1, round(SMOOTH_S / DT_S))
    rate = np.zeros_like(twist)
    rate[width:] = (twist[width:] - twist[:-width]) / SMOOTH_S
    v, r = (np.interp(at_s, t_s, column) for column in twist.T)
    dv, dr = (np.interp(at_s, t_s, column) for column in rate.T)
    return np.stack([np.ones_like(v), v, 2.0 * r, dv, 0.5 * dr, v * v, 2.0 * np.abs(r), 2.0 * v * r], axis=1)


def nuisance_columns(
    log: PreparedLog, model: Model, observed: Observed, heading: Array, channels: Sequence[str]
) -> Array:
    """Nuisance columns (n, G) of one channel's samples, in units of its sigma, among those of all `channels`;
    `heading` (n,) is that of the body, rad."""
    f = command_basis(log, model, 0.5 * (observed.begin_s + observed.end_s)) * np.median(observed.sigma)
    cos, sin, zero = np.cos(heading)[:, None], np.sin(heading)[:, None], np.zeros_like(f)
    out = []
    for channel in channels:
        if channel in NORTH_OF.values():
            continue
        if channel not in NORTH_OF:
            out.append(f if observed.channel == channel else zero)
        elif observed.channel == channel:
            out += [f * cos, -f * sin]
        elif observed.channel == NORTH_OF[channel]:
            out += [f * sin, f * cos]
        else:
            out += [zero, zero]
    return np.hstack(out)
