"""Clocks: rates, gaps, repeats, spans."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.doctor.finding import Finding, Patient
from terrafusion.datasets.recording import Channel, Recording

CLOCKED = ("command", "wheels", "imu", "gnss", "motor")
"""Channels that should tick evenly; terrain labels come when they come."""
GAP_PERIODS, GAP_S = 5.0, 0.2
JITTER_SHARE = 0.2


def check_spans(patient: Patient) -> Iterator[Finding]:
    """Channels must share a stretch of time."""
    channels = dict(_clocked(patient.recording))
    if len(channels) < 2:
        return
    last_start = max(channels, key=lambda name: channels[name].t_ns[0])
    first_end = min(channels, key=lambda name: channels[name].t_ns[-1])
    if channels[last_start].t_ns[0] > channels[first_end].t_ns[-1]:
        yield Finding(
            "no-common-time",
            "error",
            last_start,
            f"begins after {first_end} has ended",
            f"{patient.since_start_s(channels[last_start].t_ns[0]):.2f} s against "
            f"{patient.since_start_s(channels[first_end].t_ns[-1]):.2f} s",
            "bring the channels onto one clock",
        )


def check_jitter(patient: Patient) -> Iterator[Finding]:
    """Intervals that scatter: a clock of arrival rather than of measurement."""
    for name, channel in _clocked(patient.recording):
        dt = np.diff(channel.t_ns) * 1e-9
        if len(dt) < 20:
            continue
        period = float(np.median(dt))
        share = float((np.abs(dt - period) > 0.5 * period).mean())
        if share > JITTER_SHARE:
            yield Finding(
                "uneven-sampling",
                "warning",
                name,
                "uneven sampling",
                f"{share:.0%} of the intervals are more than half off the median of {period * 1e3:.3g} ms",
                "use the sensor's own time stamps",
            )


def check_gaps(patient: Patient) -> Iterator[Finding]:
    """Stretches without samples."""
    for name, channel in _clocked(patient.recording):
        dt = np.diff(channel.t_ns) * 1e-9
        if not len(dt):
            continue
        gaps = np.flatnonzero((dt > GAP_PERIODS * np.median(dt)) & (dt > GAP_S))
        if gaps.size:
            worst = int(gaps[np.argmax(dt[gaps])])
            yield Finding(
                "gaps",
                "warning",
                name,
                f"{gaps.size} gap{'s' if gaps.size > 1 else ''}",
                f"longest {dt[worst]:.2f} s from t = {patient.since_start_s(channel.t_ns[worst]):.2f} s, "
                f"{dt[gaps].sum():.2f} s in all",
                "expect larger uncertainty there; look for dropped messages",
            )


def check_duplicates(patient: Patient) -> Iterator[Finding]:
    """Samples that share their time."""
    for name, channel in patient.recording.channels().items():
        repeated = np.flatnonzero(np.diff(channel.t_ns) == 0)
        if repeated.size:
            yield Finding(
                "repeated-times",
                "warning",
                name,
                f"{repeated.size} repeated times",
                f"first at t = {patient.since_start_s(channel.t_ns[repeated[0]]):.3f} s",
                "remove the double samples",
            )


def _clocked(recording: Recording) -> list[tuple[str, Channel]]:
    return [(name, channel) for name, channel in recording.channels().items() if name in CLOCKED]
