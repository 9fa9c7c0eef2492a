"""Readings that come late, by however much: a row is made of the run as it was so long before.

The catalogue's law of a delay is its first order, y - e dy/dt: all that a signature needs, but not what a
delay of a third of a second does to a rate that turns around in one. A fit through the twin takes the delay
itself. What an IMU reads goes on from window to window; a position does not, as the pose is set anew, and
goes straight on before its window's start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.predict import LEAD_S, averaging
from terrafusion.twin.effects.sensing import CLOCK_S
from terrafusion.twin.gap.data.samples import Layout, weighty

Array = NDArray[np.float64]

IMU = ("yaw_rate_radps", "accel_x_mps2", "accel_y_mps2")
VELOCITY = ("gnss_v_e_mps", "gnss_v_n_mps")
FIXES = ("gnss_east_m", "gnss_north_m", *VELOCITY)
DELAYS = {
    "imu_time_offset/shift": IMU, "imu_time_offset/drift": IMU, "gnss_latency/both": FIXES,
    "gnss_latency/velocity": VELOCITY,
}  # fmt: skip
"""Delays of the catalogue and the channels that they make late."""
GROWING = "imu_time_offset/drift"
"""The one that grows with the time driven: its value is that after `CLOCK_S`."""


def in_time(effects: Mapping[str, float]) -> dict[str, float]:
    """The effects without delays."""
    return {key: value for key, value in effects.items() if key not in DELAYS}


def late_layout(
    log: PreparedLog, effects: Mapping[str, float], rows: Layout
) -> list[tuple[NDArray[np.int64], Array]]:
    """`Layout.fine` of the log with the delays among the effects; `rows` is that without."""
    late = {key: effects[key] for key in DELAYS if effects.get(key, 0.0) != 0.0}
    shift = np.cumsum(np.append(0, np.diff(log.windows, axis=1).ravel() + 1))
    out = list(rows.fine)
    for i, observed in enumerate(log.observed):
        seconds = _lateness(observed, late)
        if seconds.any():
            before = dataclasses.replace(
                observed, begin_s=observed.begin_s - seconds, end_s=observed.end_s - seconds
            )
            own = window_of(before if observed.channel in IMU else observed, log.windows)
            out[i] = weighty(*averaging(before, log, shift, np.maximum(own, 0)))
    return out


def _lateness(observed: Observed, late: Mapping[str, float]) -> Array:
    """By how much each row (n,) of a channel is late, s."""
    middle = 0.5 * (observed.begin_s + observed.end_s)
    out = np.zeros(len(middle))
    for key, value in late.items():
        if observed.channel in DELAYS[key]:
            out += value * ((middle + LEAD_S) / CLOCK_S if key == GROWING else 1.0)
    return out
