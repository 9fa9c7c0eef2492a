"""Each clock by itself: span, rate, coarse stamps, jitter, gaps, repeats, steps removed on reading."""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np

from terrafusion.datasets.checks.finding import (
    CheckContext,
    Finding,
    changed,
    clocks_of,
    period_s,
    retimed,
    retiming,
)
from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.channels import Channel
from terrafusion.datasets.core.conventions import numbers_of, true_updates
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Recording

C = TypeVar("C", bound=Channel)
CLOCKED = ("command", "wheels", "imu", "gnss", "motor")
"""Channels that are sampled evenly; terrain labels are not."""
GAP_PERIODS, GAP_S = 5.0, 0.2
MISSING_SHARE = 0.05
JITTER_SHARE = 0.2
LEAST_ROWS = 20
TOGETHER, IN_BURSTS, MOST_BURST = 0.1, 0.8, 100
"""Intervals within a burst over those between bursts, at most; share of the time that these take, at least;
most samples of one."""
FINEST_TICK_S = 0.002
SAME_SPAN = 0.1
"""Channels whose durations differ by less than this share were recorded together."""
SLOW_HZ = 5.0
"""Faster channels are not judged: noise from sample to sample would look like motion."""
MOST_YAW_RAD, MOST_SHARE = 0.05, 0.03
"""Error after a minute that is expected from the rate alone: of the yaw, and of the distance over itself."""


def check_spans(context: CheckContext) -> Iterator[Finding]:
    """Channels must overlap in time."""
    sampled = clocks_of(context.recording).items()
    clocks = {name: t for name, t in sampled if name in (*CLOCKED, "truth") and len(t) > 1}
    apart = {
        name: [o for o, t in clocks.items() if t[0] > own[-1] or t[-1] < own[0]]
        for name, own in clocks.items()
    }
    outlier = max(apart, key=lambda name: (len(apart[name]), clocks[name][0]), default="")
    if not outlier or not apart[outlier]:
        return
    own, others = clocks[outlier], [clocks[name] for name in clocks if name != outlier]
    begins, ends = min(int(t[0]) for t in others), max(int(t[-1]) for t in others)
    late = own[0] > ends
    alike = abs(int(own[-1]) - int(own[0]) - (ends - begins)) <= SAME_SPAN * (ends - begins)
    yield Finding(
        "no-common-time", "error", outlier,
        f"begins after {' and '.join(apart[outlier])} ended" if late else "ended before the others begin",
        f"it runs from {context.since_start_s(own[0]):.2f} to {context.since_start_s(own[-1]):.2f} s, "
        f"the others from {context.since_start_s(np.int64(begins)):.2f} "
        f"to {context.since_start_s(np.int64(ends)):.2f} s",
        "let it start with the others: they last equally long; correlation finds the remaining offset"
        if alike
        else "bring the channels onto one clock; their durations differ, so the offset is unknown",
        functools.partial(_moved, name=outlier, by_ns=begins - int(own[0])) if alike else None,
    )  # fmt: skip


def _moved(recording: Recording, name: str, by_ns: int) -> Recording:
    moved = retimed(recording, name, getattr(recording, name).t_ns + by_ns)
    first_ns = min(int(t[0]) for t in clocks_of(moved).values())
    return dataclasses.replace(moved, start_ns=max(first_ns, moved.start_ns)) if by_ns > 0 else moved


def check_steps(context: CheckContext) -> Iterator[Finding]:
    """Steps of a clock that the reader removed."""
    jumps = context.recording.clock_jumps
    for name in dict.fromkeys(jump.channel for jump in jumps):
        own = [jump for jump in jumps if jump.channel == name]
        worst = max(own, key=lambda jump: abs(jump.step_s))
        yield Finding(
            "clock-jump", "error", name,
            f"its clock was set {counted(len(own), 'time')}",
            f"largest step {worst.step_s:+.3f} s at t = {context.since_start_s(np.int64(worst.t_ns)):.2f} s",
            "keep the times as repaired on reading: good to a sampling period",
            functools.partial(_with_jumps_accepted, channel=name),
        )  # fmt: skip


def _with_jumps_accepted(recording: Recording, channel: str) -> Recording:
    others = tuple(jump for jump in recording.clock_jumps if jump.channel != channel)
    return dataclasses.replace(recording, clock_jumps=others)


def check_coarse(context: CheckContext) -> Iterator[Finding]:
    """Stamps coarser than the rate of the channel."""
    for name, channel in _clocked(context.recording):
        tick_s = coarse_tick_s(channel)
        if not tick_s:
            continue
        cut = tick_s > 0.99
        rate_hz = (len(channel) - 1) / max(float(channel.t_ns[-1] - channel.t_ns[0]) * 1e-9, 1e-9)
        yield Finding(
            "coarse-times", "error" if tick_s > 0.1 else "warning", name,
            f"its stamps are {'cut' if cut else 'rounded'} to {tick_s:g} s",
            f"all times are multiples of {tick_s:g} s apart, at {rate_hz:.3g} rows a second",
            f"fit an even clock, taking the stamps as {'cut off' if cut else 'rounded'}",
            retiming(name, functools.partial(_refined, tick_s=tick_s, cut=cut)),
        )  # fmt: skip


def _refined(t_ns: TimesNs, tick_s: float, cut: bool) -> TimesNs:
    """Even times of stamps that are rounded to a tick, or cut off."""
    even = _even(t_ns, 3.0 * tick_s)
    late_s = 0.5 * (tick_s - float(np.mean(np.diff(even))) * 1e-9) if cut else 0.0
    return np.asarray(even + round(late_s * 1e9))


def coarse_tick_s(channel: Channel) -> float:
    """Unit that the times of a channel are rounded to, where it is coarse for its rate; else 0."""
    dt = np.diff(channel.t_ns) * 1e-9
    if len(dt) < LEAST_ROWS or not (dt > 0).any():
        return 0.0
    tick = float(dt[dt > 0].min())
    steps = dt / tick
    if tick < FINEST_TICK_S or (np.abs(steps - np.rint(steps)) > 0.01).mean() > 0.01:
        return 0.0
    near = steps < 3.5
    mean = float(dt[near].mean())
    uneven = (np.abs(dt[near] - np.median(dt[near])) > 0.5 * tick).mean() > 0.1 or np.median(dt) == 0.0
    if not uneven or tick < 0.6 * mean:
        return 0.0
    residual = (channel.t_ns - _even(channel.t_ns, 3.0 * tick)) * 1e-9
    twice = (dt == 0.0) & ~true_updates(numbers_of(channel), len(channel))[1:]
    if residual.std() > 0.4 * tick or twice.sum() > 0.95 * max((dt == 0.0).sum(), 1):
        return 0.0
    return round(tick, 6)


def _even(t_ns: TimesNs, gap_s: float) -> TimesNs:
    """Times on straight lines through each stretch without gaps longer than `gap_s` and five mean periods."""
    dt = np.diff(t_ns) * 1e-9
    gap_s = max(gap_s, GAP_PERIODS * float(dt.mean()))
    edges = [0, *(np.flatnonzero(dt > gap_s) + 1).tolist(), len(t_ns)]
    even = t_ns.copy()
    for first, last in itertools.pairwise(edges):
        if last - first >= LEAST_ROWS:
            index = np.arange(last - first)
            line = np.polynomial.Polynomial.fit(index, t_ns[first:last] - t_ns[first], 1)
            even[first:last] = t_ns[first] + np.rint(line(index)).astype(np.int64)
    return np.maximum.accumulate(even)


def check_jitter(context: CheckContext) -> Iterator[Finding]:
    """Intervals that scatter: times of arrival rather than of measurement."""
    for name, logged in _clocked(context.recording):
        channel = _without_copies(logged)
        dt = np.diff(channel.t_ns) * 1e-9
        if len(dt) < LEAST_ROWS or coarse_tick_s(channel):
            continue
        period = float(np.median(dt))
        off, steps = np.abs(dt - period) > 0.5 * period, dt / period if period > 0.0 else dt
        lost = (steps > 1.5) & (steps < GAP_PERIODS) & (np.abs(steps - np.rint(steps)) < 0.1)  # are missing
        share, burst_s = float((off & ~lost).mean()), _burst_s(dt)
        if share <= JITTER_SHARE and not burst_s:
            continue
        mean = max(float(dt.mean()), 0.5 * burst_s)
        late = (channel.t_ns - _even(channel.t_ns, GAP_S)) * 1e-9
        regular = len(dt) >= 50 and late.std() < mean and np.abs(late).max() < GAP_PERIODS * mean
        yield Finding(
            "uneven-sampling", "warning", name,
            "uneven sampling",
            f"samples come together, {burst_s * 1e3:.3g} ms from the ones to the next"
            if burst_s
            else f"{share:.0%} of the intervals are more than half off the median of {period * 1e3:.3g} ms",
            "fit an even clock: the times scatter about one like times of arrival; their mean delay stays"
            if regular
            else "use the sensor's own time stamps; the log does not have them",
            changed(name, _evenly_timed) if regular else None,
        )  # fmt: skip


def _burst_s(dt: Array) -> float:
    """Median interval (s) between bursts of samples, as of a port that is read now and then; 0 without."""
    near = dt[dt <= GAP_S]
    long = near > near.mean() if len(near) else near > 0.0
    apart, together = near[long], near[~long]
    if min(len(apart), len(together)) < LEAST_ROWS or len(apart) * MOST_BURST < len(near):
        return 0.0
    burst_s = float(np.median(apart))
    clear = np.median(together) < TOGETHER * burst_s and apart.sum() > IN_BURSTS * near.sum()
    return burst_s if clear else 0.0


def _without_copies(channel: C) -> C:
    """Without rows that repeat time and numbers of the one before: written twice, they are no arrivals."""
    new = true_updates(numbers_of(channel), len(channel))
    return channel.select(new | (np.diff(channel.t_ns, prepend=channel.t_ns[0] - 1) > 0))


def _evenly_timed(channel: C) -> C:
    own = _without_copies(channel)
    return dataclasses.replace(own, t_ns=_even(own.t_ns, GAP_S))


def gap_findings(context: CheckContext, jumps: Mapping[str, Sequence[int]]) -> Iterator[Finding]:
    """Stretches without samples, except at the rows `jumps` by channel of a clock jump."""
    for name, channel in _clocked(context.recording):
        dt = np.diff(channel.t_ns) * 1e-9
        dt[np.array(jumps.get(name, ()), dtype=int) - 1] = 0.0
        if not (dt > 0).any() or coarse_tick_s(channel):
            continue
        period = period_s(channel.t_ns)
        gaps = np.flatnonzero(is_gap(channel.t_ns) & (dt > 0.0))
        missing = _missing(dt[dt <= GAP_PERIODS * period] / period) if len(dt) >= LEAST_ROWS else 0
        if gaps.size:
            worst = int(gaps[np.argmax(dt[gaps])])
            what = counted(gaps.size, "gap")
            evidence = (
                f"longest {dt[worst]:.2f} s from t = {context.since_start_s(channel.t_ns[worst]):.2f} s, "
                f"{dt[gaps].sum():.2f} s in all"
            )
        elif missing > MISSING_SHARE * (len(channel) + missing):
            what = f"{missing / (len(channel) + missing):.0%} of the samples are missing, one here and there"
            evidence = f"intervals of whole multiples of {period * 1e3:.3g} ms, {missing} of which are empty"
        elif (early_s := _early_s(context, name)) > max(GAP_PERIODS * period, GAP_S):
            what = (
                f"no fix in the last {early_s:.2f} s"
                if name == "gnss"
                else f"ends {early_s:.2f} s before the other channels"
            )
            evidence = f"its last sample is at t = {context.since_start_s(channel.t_ns[-1]):.2f} s"
        else:
            continue
        causes = "dropped messages or a clock that was set ahead"
        if name == "gnss":  # rows without a fix are none of its samples
            causes = f"a receiver that lost its satellites, {causes}"
        fix = f"expect larger uncertainty there, and look for {causes}"
        yield Finding("gaps", "warning", name, what, evidence, fix)


def _early_s(context: CheckContext, name: str) -> float:
    """Seconds from the end of a sensor to that of all others, where they are a share of the log; else 0."""
    clocks = {o: t for o, t in clocks_of(context.recording).items() if o in ("wheels", "imu", "gnss")}
    others = [t for o, t in clocks.items() if o != name]
    if name not in clocks or not others or clocks[name][-1] < max(t[0] for t in others):
        return 0.0
    end = min(t[-1] for t in others)
    early_s = float(end - clocks[name][-1]) * 1e-9
    return early_s if early_s > SAME_SPAN * context.since_start_s(end) else 0.0


def is_gap(t_ns: TimesNs) -> Mask:
    """Which of the intervals (N - 1,) are gaps: longer than a few periods and than a fraction of a second."""
    dt = np.diff(t_ns) * 1e-9
    return np.asarray((dt > GAP_PERIODS * period_s(t_ns)) & (dt > GAP_S))


def _missing(steps: Array) -> int:
    """Samples missing in intervals given in periods; 0 where the long ones are no whole multiples."""
    long = steps[steps > 1.5]
    whole = np.abs(long - np.rint(long)) < 0.25
    return int((np.rint(long) - 1.0).sum()) if long.size and whole.mean() > 0.8 else 0


def check_duplicates(context: CheckContext) -> Iterator[Finding]:
    """Samples that share their time."""
    for name, channel in context.recording.channels().items():
        repeated = np.flatnonzero(np.diff(channel.t_ns) == 0)
        if not repeated.size or (name in CLOCKED and coarse_tick_s(channel)):
            continue
        yield Finding(
            "repeated-times", "warning", name,
            f"{repeated.size} repeated times",
            f"first at t = {context.since_start_s(channel.t_ns[repeated[0]]):.3f} s",
            "keep the first sample of each time",
            changed(name, lambda own: own.select(np.diff(own.t_ns, prepend=own.t_ns[0] - 1) > 0)),
        )  # fmt: skip


def _clocked(recording: Recording) -> list[tuple[str, Channel]]:
    return [(name, channel) for name, channel in recording.channels().items() if name in CLOCKED]


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
