"""Sensors that tell of one motion, in pairs: their lags, the odd one out, other times for a channel.

The command is left out: the robot answers it late by nature.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.checks.finding import CheckContext
from terrafusion.datasets.checks.yaw_sources import Signal, speeds, yaw_rates
from terrafusion.datasets.core.lag import Lag, lag_between
from terrafusion.datasets.core.recording import Recording

TimesNs = NDArray[np.int64]
Pair = tuple[str, str]
"""Two channels, the second measured against the first."""
Pairs = dict[Pair, tuple[Signal, Signal]]
"""Their accounts of one quantity."""

YAW_PAIRS: tuple[Pair, ...] = (("imu", "wheels"), ("truth", "imu"))
SPEED_PAIRS: tuple[Pair, ...] = (("truth", "wheels"), ("gnss", "wheels"), ("truth", "gnss"))
LEAST_R = 0.7
NEAR_S, FAR_S = 2.0, 20.0
"""Lags are looked for nearby first; where nothing correlates there, further off."""
FAR_R = 0.87
"""A lag far off counts where the correlation is this high."""


def signal_pairs(context: CheckContext) -> Pairs:
    """The accounts of one quantity by two channels, for all pairs that are there."""
    radius = context.wheel_radius_m() or 1.0
    found = {}
    for accounts, pairs in (
        (yaw_rates(context.recording, radius), YAW_PAIRS),
        (speeds(context.recording, radius), SPEED_PAIRS),
    ):
        for one, other in pairs:
            if one in accounts and other in accounts:
                found[one, other] = accounts[one], accounts[other]
    return found


def near_lag(one: Signal, other: Signal, reach_s: float = NEAR_S, least_r: float = LEAST_R) -> Lag | None:
    """Lag of the second signal within the reach, where they correlate."""
    if not min(len(one[0]), len(other[0])):
        return None
    origin = one[0][0]
    t_one, t_other = (one[0] - origin) * 1e-9, (other[0] - origin) * 1e-9
    return lag_between(t_one, one[1], t_other, other[1], reach_s=reach_s, least_r=least_r)


def far_lag(one: Signal, other: Signal) -> Lag | None:
    """Lag of the second signal, nearby or else far off, where they correlate."""
    near = near_lag(one, other)
    return near if near is not None else near_lag(one, other, FAR_S, FAR_R)


def period_s(t_ns: TimesNs) -> float:
    """Median of the intervals that are not zero; 1 where there is none."""
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if steps.size else 1.0


def odd_one(recording: Recording, off: set[Pair], told: set[Pair]) -> str:
    """The channel that disagrees with the largest share of the others, of equals with most of them, of
    equals the one of lowest rate."""

    def oddness(name: str) -> tuple[float, int, float]:
        count = sum(name in pair for pair in off)
        return count / sum(name in pair for pair in told), count, period_s(getattr(recording, name).t_ns)

    return max(sorted({name for pair in off for name in pair}), key=oddness)


def why(name: str, off: set[Pair]) -> str:
    """Why this channel is mended and no other, in words."""
    others = sorted(pair[0] if pair[1] == name else pair[1] for pair in off if name in pair)
    return f"it disagrees with {' and '.join(others)}" if len(others) > 1 else f"{others[0]} is not touched"


def clocks_of(recording: Recording) -> dict[str, TimesNs]:
    """Times of all channels that tick, and of the truth."""
    clocks = {name: channel.t_ns for name, channel in recording.channels().items() if name != "terrain"}
    if recording.truth is not None and len(recording.truth):
        clocks["truth"] = recording.truth.t_ns
    return clocks


def retimed(recording: Recording, name: str, t_ns: TimesNs) -> Recording:
    """The recording with other times for one channel (or "truth"); it begins no later than they do."""
    channel = dataclasses.replace(getattr(recording, name), t_ns=t_ns)
    start_ns = min(recording.start_ns, int(t_ns[0])) if len(t_ns) else recording.start_ns
    return dataclasses.replace(recording, start_ns=start_ns, **{name: channel})
