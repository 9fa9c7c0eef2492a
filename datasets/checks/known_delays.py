"""Delays of the vehicle file, which the estimator takes out of the stamps, and how well they are known."""

import dataclasses
import math

from terrafusion.datasets.checks.finding import CheckContext, retimed
from terrafusion.datasets.core.bootstrap import BootstrapInterval
from terrafusion.datasets.core.lag import Lag

DELAYS = {"gnss": "gnss_delay_s", "wheels": "wheel_delay_s"}
"""By channel the vehicle file's number for its delay."""
Z_95 = 1.96
"""Sigmas to an end of a 95 % interval."""


def on_one_clock(context: CheckContext) -> CheckContext:
    """The context less the delays that the vehicle file has, as the estimator takes them out."""
    recording = context.recording
    for name, number in DELAYS.items():
        late_ns, channel = round(context.known(number) * 1e9), getattr(recording, name)
        if late_ns and channel is not None:
            recording = retimed(recording, name, channel.t_ns - late_ns)
    if recording is context.recording:
        return context
    return dataclasses.replace(context, recording=recording)


def sigma_s(context: CheckContext, *channels: str) -> float:
    """1 sigma of the delays taken out of the clocks of some channels, together."""
    return math.hypot(*(context.known_sigma(DELAYS[name]) for name in channels if name in DELAYS))


def lag_with_sigma(lag: Lag, sigma: float) -> Lag:
    """The lag, its 95 % interval widened by a delay known to `sigma`, s."""
    low_s, high_s = _widened(lag.seconds, lag.low_s, lag.high_s, sigma)
    return dataclasses.replace(lag, low_s=low_s, high_s=high_s)


def interval_with_sigma(found: BootstrapInterval, sigma: float) -> BootstrapInterval:
    """The same of an interval by bootstrap."""
    low_s, high_s = _widened(found.value, found.low, found.high, sigma)
    return dataclasses.replace(found, low=low_s, high=high_s)


def _widened(value: float, low: float, high: float, sigma: float) -> tuple[float, float]:
    if not sigma:
        return low, high
    below, above = (math.hypot(end - value, Z_95 * sigma) for end in (low, high))
    return value - below, value + above
