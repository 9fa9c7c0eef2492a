"""Sampling rates that are too low for the motion they sample."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, period_s
from terrafusion.datasets.core.arrays import Array, TimesNs

SLOW_HZ = 5.0
"""Faster channels are not judged: noise from sample to sample would look like motion."""
LEAST_ROWS = 20
MOST_YAW_RAD, MOST_SHARE = 0.05, 0.03
"""Error after a minute that is expected from the rate alone: of the yaw, and of the distance over itself."""


def check_rates(context: CheckContext) -> Iterator[Finding]:
    """Gyro and wheels must be sampled fast enough to be integrated."""
    imu, wheels = context.recording.imu, context.recording.wheels
    if imu is not None:
        error, hz = _after_a_minute(imu.t_ns, imu.gyro_radps[:, 2])
        if error > MOST_YAW_RAD:
            yield Finding(
                "low-rate", "warning", "imu",
                f"{hz:.3g} Hz is too slow for the turns of this drive",
                f"from sample to sample gyro z changes so much that {np.degrees(error):.0f} deg of yaw are "
                "unknown after a minute",
                "log the IMU faster, at 50 Hz or more; a mean over each interval needs no more",
            )  # fmt: skip
    if wheels is not None:
        error, hz = _after_a_minute(wheels.t_ns, wheels.speed.mean(axis=1))
        minute = 60.0 * float(np.abs(np.nan_to_num(wheels.speed)).mean()) if len(wheels) else 0.0
        if minute > 0.0 and error > MOST_SHARE * minute:
            yield Finding(
                "low-rate", "warning", "wheels",
                f"{hz:.3g} Hz is too slow for the changes of speed of this drive",
                f"from sample to sample they change so much that {error / minute:.0%} of the distance are "
                "unknown after a minute",
                "log the wheels faster, at 10 Hz or more; counts of an encoder need no more",
            )  # fmt: skip


def _after_a_minute(t_ns: TimesNs, rate: Array) -> tuple[float, float]:
    """1 sigma of the integral of a rate over a minute, and its sampling rate (Hz); 0 for fast channels.

    Between two samples that differ by d, the mean is unknown by d / sqrt(12), independently in each interval.
    """
    known = np.isfinite(rate)
    if known.sum() < LEAST_ROWS:
        return 0.0, 0.0
    period = period_s(t_ns[known])
    if 1.0 / period > 0.99 * SLOW_HZ:
        return 0.0, 1.0 / period
    step = float(np.sqrt(np.mean(np.diff(rate[known]) ** 2)))
    return step * period / np.sqrt(12.0) * np.sqrt(60.0 / period), 1.0 / period
