"""Clocks compared with each other: gaps, jumps, drifts, and constant delays between sensors."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from terrafusion.datasets.checks.clocks import clock_drifts, clock_jumps, drift_finding, jump_findings
from terrafusion.datasets.checks.finding import CheckContext, Finding, period_s, retimed, retiming
from terrafusion.datasets.checks.motion import (
    LEAST_R,
    SPEED_PAIRS,
    YAW_PAIRS,
    Pair,
    SensorPairs,
    Signal,
    far_lag,
    odd_one,
    reason,
    signal_pairs,
)
from terrafusion.datasets.checks.path import path_by
from terrafusion.datasets.checks.path_model import path_model
from terrafusion.datasets.checks.signals import without_stuck
from terrafusion.datasets.checks.timing import gap_findings
from terrafusion.datasets.core.arrays import Array, Mask
from terrafusion.datasets.core.lag import Lag
from terrafusion.datasets.core.recording import Recording

LEAST_LAG_S = dict.fromkeys(YAW_PAIRS, 0.1) | dict.fromkeys(SPEED_PAIRS, 0.2)
"""Smaller lags are no finding; slip distorts the speed of wheels, so that theirs may be larger."""
ERROR_FROM_S = 0.5
"""An interval that is all beyond this is an error."""
SLIDING_S = 2.0
"""The same where the others lag behind the wheels, as they do where a robot skids: at 1 m/s2 of traction it
takes 3 s to reach 3 m/s, a mean delay of half of that."""
LEAST_LATE_S, SIGNIFICANT_S, MOST_REST = 0.3, 0.2, 0.97
"""Fixes count as late from the first on, with the interval of the delay beyond the second, and where that
leaves no more than this share of the residuals."""
CALIBRATED_S = 3.0
"""Late fixes are no error up to this: the estimator finds such a delay by itself."""
GRID_S, LONGEST_MEAN_S, LONGEST_S = 0.02, 2.0, 3600.0
FOLLOWS_AFTER = (0.7, 1.0, 1.4, 2.0)
"""Time constants that are tried, over the delay, which is shorter where changes are quick."""


def check_clocks(context: CheckContext) -> Iterator[Finding]:
    """Clocks compared with each other. A jump hides a drift, either hides an offset: the first counts."""
    pairs = signal_pairs(CheckContext(without_stuck(context), context.rig))
    jumps = clock_jumps(context.recording, pairs)
    yield from gap_findings(context, {name: [jump.row for jump in found] for name, found in jumps.items()})
    if jumps:
        yield from jump_findings(context, jumps)
    elif drifts := clock_drifts(context.recording, pairs):
        yield drift_finding(context.recording, drifts)
    else:
        corrected = _on_one_clock(context)
        if corrected is not context:
            pairs = signal_pairs(CheckContext(without_stuck(corrected), context.rig))
        lags, wheels_slip = sensor_lags(pairs)
        off = {pair: lag for pair, lag in lags.items() if _matters(pair, lag, *pairs[pair])}
        if off:
            precise = {p for p, lag in lags.items() if lag.high_s - lag.low_s < 2.0 * LEAST_LAG_S[p]}
            off |= {p: lags[p] for p in precise - set(off) if _confirms(p, lags[p], off)}
            yield offset_finding(corrected.recording, off, precise | set(off))
        elif not wheels_slip:
            yield from _late_fixes(corrected)


def _on_one_clock(context: CheckContext) -> CheckContext:
    """The context less the delays that the vehicle file has, as the estimator takes them out."""
    recording = context.recording
    for name, number in (("gnss", "gnss_delay_s"), ("wheels", "wheel_delay_s")):
        late_ns, channel = round(context.known(number) * 1e9), getattr(recording, name)
        if late_ns and channel is not None:
            recording = retimed(recording, name, channel.t_ns - late_ns)
    if recording is context.recording:
        return context
    return dataclasses.replace(context, recording=recording)


def sensor_lags(pairs: SensorPairs) -> tuple[dict[Pair, Lag], bool]:
    """Lags between sensors of the same motion, and whether the wheels slip and drag the body after them."""
    lags, wheels_slip = {}, False
    for pair, signals in pairs.items():
        lag = far_lag(*signals)
        if lag is None or lag.r < LEAST_R:
            continue
        suspect = _matters(pair, lag, *signals)
        if suspect and pair[1] == "wheels" and lag.seconds < 0.0 and _follows(lag, *signals):
            wheels_slip = True
        elif not suspect or not opposed(lag, *signals):
            lags[pair] = _without_smoothing(lag, *signals) if suspect and pair[1] == "wheels" else lag
    return lags, wheels_slip


def _confirms(pair: Pair, lag: Lag, off: dict[Pair, Lag]) -> bool:
    """Whether a lag, too small to matter alone, is that of a channel that is off against another one, too."""
    for name in pair:
        for other, found in off.items():
            if name not in other:
                continue
            same = (name == pair[1]) == (name == other[1])
            seconds = found.seconds if same else -found.seconds
            if lag.low_s <= seconds <= lag.high_s and _distance_to_zero_s(lag) > 0.5 * abs(seconds):
                return True
    return False


def _late_fixes(context: CheckContext) -> Iterator[Finding]:
    """The path of the fixes must bend when wheels and gyro do; speeds from noisy fixes do not show it."""
    model = path_model(context, path_by(context.recording, "gnss"))
    if model is None or abs(model.delay_s.value) < LEAST_LATE_S or model.rest > MOST_REST:
        return
    if not model.delay_s.is_beyond(SIGNIFICANT_S):
        return
    late = model.delay_s
    beyond = min(abs(late.low), abs(late.high)) > CALIBRATED_S
    yield Finding(
        "clock-offset", "error" if beyond else "warning", "gnss",
        f"its times are {abs(late.value):.2f} s {'late' if late.value > 0 else 'early'} "
        "against wheels and imu",
        f"95 % interval {late.low:.2f} to {late.high:.2f} s, by the path in {model.windows} stretches",
        f"move the times of gnss by {-late.value:+.2f} s",
        retiming("gnss", lambda t_ns: t_ns - round(late.value * 1e9)),
    )  # fmt: skip


def offset_finding(recording: Recording, off: dict[Pair, Lag], measured: set[Pair]) -> Finding:
    """The finding on the channel that disagrees with most others, of those that could be compared."""
    name = odd_one(recording, set(off), measured)
    pair = min((p for p in off if name in p), key=lambda p: off[p].high_s - off[p].low_s)
    lag, against = off[pair], pair[0] if name == pair[1] else pair[1]
    if name == pair[0]:
        lag = Lag(-lag.seconds, -lag.high_s, -lag.low_s, lag.r)
    ahead = name if lag.seconds < 0.0 else against
    limit_s = CALIBRATED_S if name == "gnss" else SLIDING_S if ahead == "wheels" else ERROR_FROM_S
    return Finding(
        "clock-offset",
        "error" if _distance_to_zero_s(lag) > limit_s else "warning",
        name,
        f"its times are {abs(lag.seconds):.3f} s {'late' if lag.seconds > 0 else 'early'} against {against}",
        f"95 % interval {lag.low_s:.3f} to {lag.high_s:.3f} s, correlation {lag.r:.2f}",
        f"move the times of {name} by {-lag.seconds:+.3f} s; {reason(name, set(off))}",
        retiming(name, lambda t_ns: t_ns - round(lag.seconds * 1e9)),
    )


def _matters(pair: Pair, lag: Lag, one: Signal, other: Signal) -> bool:
    """Whether a lag is large, and its interval clear of what half a sample and slip may cause."""
    least = LEAST_LAG_S[pair]
    sample_s = max(period_s(one[0]), period_s(other[0]))
    ahead = pair[1] == "wheels" and lag.seconds < 0.0  # as where the robot skids after them
    clear_s = (1.0 if ahead else 0.5) * max(sample_s, least)
    return abs(lag.seconds) >= least and _distance_to_zero_s(lag) > clear_s


def _distance_to_zero_s(lag: Lag) -> float:
    """Distance of its interval from zero."""
    return min(abs(lag.low_s), abs(lag.high_s)) if lag.low_s * lag.high_s > 0.0 else 0.0


def _without_smoothing(lag: Lag, one: Signal, other: Signal) -> Lag:
    """The lag less that of a moving average in the second signal: a filter is not a clock.

    Odometry often averages its last samples, which delays it by half their span. The length is that
    which makes the first signal most like the second. Where the second is not averaged, averaging
    both makes them more similar still, since it only removes noise.
    """
    from scipy.ndimage import uniform_filter1d

    grid, start = _common_grid(one, other)
    a, a_known = _resampled(grid, one, start)
    b, b_known = _resampled(grid + lag.seconds, other, start)
    known = a_known & b_known
    sizes = range(1, round(LONGEST_MEAN_S / GRID_S), 4)
    r = [_correlation(uniform_filter1d(a, size)[known], b[known]) for size in sizes]
    size = sizes[int(np.argmax(r))]
    both = _correlation(uniform_filter1d(a, size)[known], uniform_filter1d(b, size)[known])
    if size == 1 or max(r) < both or 1.0 - max(r) > 0.6 * (1.0 - r[0]):
        return lag
    delay_s = max(0.5 * (size * GRID_S - period_s(other[0])), 0.0)
    return dataclasses.replace(
        lag, seconds=lag.seconds - delay_s, low_s=lag.low_s - delay_s, high_s=lag.high_s - delay_s
    )


def _follows(lag: Lag, body: Signal, wheels: Signal) -> bool:
    """Whether the body follows its wheels as through a first-order lag, at least as well as by a pure delay.

    Wheels that slip drag the body after them: quick changes arrive smaller and sooner than slow ones. Behind
    a clock that is late all are delayed alike.
    """
    from scipy.signal import lfilter

    grid, start = _common_grid(body, wheels)
    a, a_known = _resampled(grid, body, start)
    b, b_known = _resampled(grid, wheels, start)
    later, later_known = _resampled(grid + lag.seconds, wheels, start)
    known = a_known & b_known & later_known
    decays = np.exp(-GRID_S / (np.array(FOLLOWS_AFTER) * abs(lag.seconds)))
    dragged = (lfilter([1.0 - decay], [1.0, -decay], b) for decay in decays.tolist())
    r = max(_correlation(a[known], one[known]) for one in dragged)
    return r >= _correlation(a[known], later[known])


def opposed(lag: Lag, one: Signal, other: Signal) -> bool:
    """Whether the two agree about as well without the lag but with one sign changed: a sign, no clock."""
    from scipy.ndimage import uniform_filter1d

    grid, start = _common_grid(one, other)
    if len(grid) < 2:
        return False
    width = round(0.5 / GRID_S)
    here = uniform_filter1d(_resampled(grid, one, start)[0], width)
    there = [uniform_filter1d(_resampled(grid + s, other, start)[0], width) for s in (0.0, lag.seconds)]
    return -_correlation(here, there[0]) > _correlation(here, there[1]) - 0.1


def _common_grid(one: Signal, other: Signal) -> tuple[Array, np.int64]:
    """A grid (s) over the common time of two signals, from its start (ns)."""
    start, end = max(one[0][0], other[0][0]), min(one[0][-1], other[0][-1])
    return np.arange(0.0, min(float(end - start) * 1e-9, LONGEST_S), GRID_S), start


def _resampled(grid_s: Array, signal: Signal, origin_ns: np.int64) -> tuple[Array, Mask]:
    """A signal at other times, and whether it is known there: away from its gaps."""
    known = np.isfinite(signal[1])
    t_s, values = (signal[0][known] - origin_ns) * 1e-9, signal[1][known]
    after = np.clip(np.searchsorted(t_s, grid_s), 1, len(t_s) - 1)
    near = t_s[after] - t_s[after - 1] < 3.0 * period_s(signal[0])
    return np.interp(grid_s, t_s, values), np.asarray(near)


def _correlation(a: Array, b: Array) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if len(a) and min(a.std(), b.std()) > 1e-9 else 0.0
