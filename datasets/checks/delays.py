"""Clocks compared with each other: gaps, jumps, and constant delays between sensors."""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.drifts import LEAST_LAG_S, clock_drifts, drift_finding
from terrafusion.datasets.checks.finding import CheckContext, Finding, clocks_of, period_s, retiming
from terrafusion.datasets.checks.known_delays import (
    interval_with_sigma,
    lag_with_sigma,
    on_one_clock,
    sigma_s,
)
from terrafusion.datasets.checks.path_model import model_by_fixes
from terrafusion.datasets.checks.signals import without_stuck
from terrafusion.datasets.checks.timing import gap_findings
from terrafusion.datasets.core.arrays import Array, Mask, TimesNs
from terrafusion.datasets.core.lag import Lag
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.recording import Recording

LEAST_JUMP_S, JUMP_PERIODS, MOST_JUMPS = 0.3, 3.0, 4
SURE_JUMP_S = 1.0
"""A jump that no correlation confirms must be this long, and show at the end of the channel."""


@dataclass(frozen=True)
class JumpAhead:
    """From `row` on the times of a channel are `step_ns` too late."""

    row: int
    step_ns: int


def clock_jumps(recording: Recording, pairs: motion.SensorPairs) -> dict[str, list[JumpAhead]]:
    """Jumps ahead of single clocks, by channel.

    A gap is a jump if the samples after it fit the other channels only when shifted back or, where
    nothing can be compared, if the channel ends that much late.
    """
    found = {}
    for name, t_ns in clocks_of(recording).items():
        candidates = _candidates(t_ns)
        if not candidates:
            continue
        own = [(pair.index(name), signals) for pair, signals in pairs.items() if name in pair]
        ends_late = _ends_late(recording, name, sum(candidate.step_ns for candidate in candidates))
        jumps: list[JumpAhead] = []
        for candidate, after in zip(candidates, [*candidates[1:], JumpAhead(len(t_ns), 0)], strict=True):
            rows, moved_ns = slice(candidate.row, after.row), sum(jump.step_ns for jump in jumps)
            answers = (_fits_moved_back(i, signals, rows, moved_ns, candidate) for i, signals in own)
            moved = next((answer for answer in answers if answer is not None), None)
            if moved or (moved is None and ends_late and candidate.step_ns > SURE_JUMP_S * 1e9):
                jumps.append(candidate)
        if jumps:
            found[name] = jumps
    return found


def jump_findings(context: CheckContext, jumps: dict[str, list[JumpAhead]]) -> Iterator[Finding]:
    """One finding a channel that jumps."""
    for name, own in jumps.items():
        at_s = context.since_start_s(clocks_of(context.recording)[name][own[0].row])
        total_s = sum(jump.step_ns for jump in own) * 1e-9
        yield Finding(
            "clock-jump", "error", name,
            f"its clock jumps ahead {counted(len(own), 'time')}",
            f"by {total_s:.2f} s in all, first at t = {at_s:.2f} s; the other channels continue meanwhile, "
            "and the samples after it fit them only when moved back",
            "move the samples after it back",
            retiming(name, functools.partial(_moved_back, own)),
        )  # fmt: skip


def _moved_back(jumps: list[JumpAhead], t_ns: TimesNs) -> TimesNs:
    moved = t_ns.copy()
    for jump in jumps:
        moved[jump.row :] -= jump.step_ns
    return moved


def _candidates(t_ns: TimesNs) -> list[JumpAhead]:
    """Gaps that could be jumps, in order of time: the longest few."""
    steps = np.diff(t_ns)
    if len(steps) < 20:
        return []
    period_ns = round(period_s(t_ns) * 1e9)
    rows = np.flatnonzero(steps > max(JUMP_PERIODS * period_ns, LEAST_JUMP_S * 1e9))
    rows = np.sort(rows[np.argsort(-steps[rows], kind="stable")[:MOST_JUMPS]])
    return [JumpAhead(int(row) + 1, int(steps[row]) - period_ns) for row in rows]


def _fits_moved_back(
    own: int, signals: tuple[motion.Signal, motion.Signal], rows: slice, moved_ns: int, jump: JumpAhead
) -> bool | None:
    """Whether the rows after a jump fit the other signal only when shifted back; None where nothing fits."""
    other, (t_ns, values) = signals[1 - own], signals[own]
    before = motion.near_lag(other, (t_ns[: jump.row], values[: jump.row]))
    usual_s = before.seconds if before is not None and before.r > motion.LEAST_R and not moved_ns else 0.0
    t_ns, values = t_ns[rows] - moved_ns, values[rows]
    stay, back = (motion.near_lag(other, (t_ns - step, values)) for step in (0, jump.step_ns))
    r_stay, r_back = (_fit(lag, usual_s, jump.step_ns * 1e-9) for lag in (stay, back))
    return r_back > r_stay + 0.05 if max(r_stay, r_back) > motion.LEAST_R else None


def _fit(lag: Lag | None, usual_s: float, step_s: float) -> float:
    """Correlation of a lag whose change is small compared with the step; 0 where it is not."""
    return lag.r if lag is not None and abs(lag.seconds - usual_s) < 0.4 * step_s else 0.0


def _ends_late(recording: Recording, name: str, step_ns: int) -> bool:
    """Whether a channel starts with the others and ends that much later than they do."""
    clocks = clocks_of(recording)
    own = clocks.pop(name)
    if not clocks:
        return False
    start_ns = float(np.median([t[0] for t in clocks.values()]))
    end_ns = float(np.median([t[-1] for t in clocks.values()]))
    slack_ns = 0.1 * step_ns + 2e8
    return abs(own[0] - start_ns) < slack_ns and abs(own[-1] - end_ns - step_ns) < slack_ns


ERROR_FROM_S = 0.5
"""An interval that is all beyond this is an error."""
SLIDING_S = 2.0
"""The same where the others lag behind the wheels, as they do where a robot skids: at 1 m/s2 of traction it
takes 3 s to reach 3 m/s, a mean delay of half of that."""
MOST_LEFT = 0.9
"""Share of what is not correlated without a lag beyond `ERROR_FROM_S` that may be left with it."""
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
    pairs = motion.signal_pairs(CheckContext(without_stuck(context), context.rig))
    jumps = clock_jumps(context.recording, pairs)
    yield from gap_findings(context, {name: [jump.row for jump in found] for name, found in jumps.items()})
    if jumps:
        yield from jump_findings(context, jumps)
    elif (drifts := clock_drifts(context.recording, pairs))[0]:
        yield drift_finding(context.recording, *drifts)
    else:
        corrected = on_one_clock(context)
        if corrected is not context:
            pairs = motion.signal_pairs(CheckContext(without_stuck(corrected), context.rig))
        lags, wheels_slip = sensor_lags(pairs)
        lags = {pair: lag_with_sigma(lag, sigma_s(context, *pair)) for pair, lag in lags.items()}
        off = {pair: lag for pair, lag in lags.items() if _matters(pair, lag, *pairs[pair])}
        if off:
            precise = {p for p, lag in lags.items() if lag.high_s - lag.low_s < 2.0 * LEAST_LAG_S[p]}
            off |= {p: lags[p] for p in precise - set(off) if _confirms(p, lags[p], off)}
            yield offset_finding(corrected.recording, off, precise | set(off))
        elif not wheels_slip:
            yield from _late_fixes(corrected)


def sensor_lags(pairs: motion.SensorPairs) -> tuple[dict[motion.Pair, Lag], bool]:
    """Lags between sensors of the same motion, and whether the wheels slip and drag the body after them."""
    lags, wheels_slip = {}, False
    for pair, signals in pairs.items():
        lag = motion.far_lag(*signals)
        if lag is None or lag.r < motion.LEAST_R:
            continue
        suspect = _matters(pair, lag, *signals)
        if suspect and pair[1] == "wheels" and lag.seconds < 0.0 and _follows(lag, *signals):
            wheels_slip = True
        elif not suspect or not (opposed(lag, *signals) or _as_well_without(lag, *signals)):
            lags[pair] = _without_smoothing(lag, *signals) if suspect and pair[1] == "wheels" else lag
    return lags, wheels_slip


def _confirms(pair: motion.Pair, lag: Lag, off: dict[motion.Pair, Lag]) -> bool:
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
    model = model_by_fixes(context)
    if model is None or abs(model.delay_s.value) < LEAST_LATE_S or model.rest > MOST_REST:
        return
    late = interval_with_sigma(model.delay_s, sigma_s(context, "gnss"))
    if not late.is_beyond(SIGNIFICANT_S):
        return
    beyond = min(abs(late.low), abs(late.high)) > CALIBRATED_S
    yield Finding(
        "clock-offset", "error" if beyond else "warning", "gnss",
        f"its times are {abs(late.value):.2f} s {'late' if late.value > 0 else 'early'} "
        "against wheels and imu",
        f"95 % interval {late.low:.2f} to {late.high:.2f} s, by the path in {model.windows} stretches",
        f"move the times of gnss by {-late.value:+.2f} s",
        retiming("gnss", lambda t_ns: t_ns - round(late.value * 1e9)),
    )  # fmt: skip


def offset_finding(recording: Recording, off: dict[motion.Pair, Lag], measured: set[motion.Pair]) -> Finding:
    """The finding on the channel that disagrees with most others, of those that could be compared."""
    name = motion.odd_one(recording, set(off), measured)
    pair = min((p for p in off if name in p), key=lambda p: off[p].high_s - off[p].low_s)
    lag, against = off[pair], pair[0] if name == pair[1] else pair[1]
    if name == pair[0]:
        lag = _reversed(lag)
    why = motion.reason(name, set(off))
    witnesses = {one for p in measured - set(off) if against in p for one in p} - {against}
    if lag.seconds < 0.0 and witnesses == {"gnss"}:
        name, against, lag = against, name, _reversed(lag)
        why = (
            f"a stamp is late rather than early (assumed): {name} agrees with gnss, so either both are "
            f"late or {against} is early"
        )
    elif lag.seconds < 0.0 and not witnesses and len(off) == 1:
        why += ", but it may be that which is late: no third clock shows it"
    ahead = name if lag.seconds < 0.0 else against
    limit_s = CALIBRATED_S if name == "gnss" else SLIDING_S if ahead == "wheels" else ERROR_FROM_S
    return Finding(
        "clock-offset",
        "error" if _distance_to_zero_s(lag) > limit_s else "warning",
        name,
        f"its times are {abs(lag.seconds):.3f} s {'late' if lag.seconds > 0 else 'early'} against {against}",
        f"95 % interval {lag.low_s:.3f} to {lag.high_s:.3f} s, correlation {lag.r:.2f}",
        f"move the times of {name} by {-lag.seconds:+.3f} s; {why}",
        retiming(name, lambda t_ns: t_ns - round(lag.seconds * 1e9)),
    )


def _reversed(lag: Lag) -> Lag:
    """The lag of the first signal against the second."""
    return Lag(-lag.seconds, -lag.high_s, -lag.low_s, lag.r)


def _matters(pair: motion.Pair, lag: Lag, one: motion.Signal, other: motion.Signal) -> bool:
    """Whether a lag is large, and its interval clear of what half a sample and slip may cause."""
    least = LEAST_LAG_S[pair]
    sample_s = max(period_s(one[0]), period_s(other[0]))
    ahead = pair[1] == "wheels" and lag.seconds < 0.0  # as where the robot skids after them
    clear_s = (1.0 if ahead else 0.5) * max(sample_s, least)
    return abs(lag.seconds) >= least and _distance_to_zero_s(lag) > clear_s


def _distance_to_zero_s(lag: Lag) -> float:
    """Distance of its interval from zero."""
    return min(abs(lag.low_s), abs(lag.high_s)) if lag.low_s * lag.high_s > 0.0 else 0.0


def _without_smoothing(lag: Lag, one: motion.Signal, other: motion.Signal) -> Lag:
    """The lag less that of a moving average in the second signal: a filter is not a clock.

    Odometry often averages its last samples, which delays it by half their span. The length is that
    which makes the first signal most like the second. Where the second is not averaged, averaging
    both makes them more similar still, since it only removes noise.
    """
    from scipy.ndimage import uniform_filter1d

    (a, a_known), (b, b_known) = _on_grid(one, other, lag.seconds)
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


def _follows(lag: Lag, body: motion.Signal, wheels: motion.Signal) -> bool:
    """Whether the body follows its wheels as through a first-order lag, at least as well as by a pure delay.

    Wheels that slip drag the body after them: quick changes arrive smaller and sooner than slow ones. Behind
    a clock that is late all are delayed alike.
    """
    from scipy.signal import lfilter

    (a, a_known), (b, b_known), (later, later_known) = _on_grid(body, wheels, 0.0, lag.seconds)
    known = a_known & b_known & later_known
    decays = np.exp(-GRID_S / (np.array(FOLLOWS_AFTER) * abs(lag.seconds)))
    dragged = (lfilter([1.0 - decay], [1.0, -decay], b) for decay in decays.tolist())
    r = max(_correlation(a[known], one[known]) for one in dragged)
    return r >= _correlation(a[known], later[known])


def opposed(lag: Lag, one: motion.Signal, other: motion.Signal) -> bool:
    """Whether the two agree about as well without the lag but with one sign changed: a sign, no clock."""
    from scipy.ndimage import uniform_filter1d

    width = round(0.5 / GRID_S)
    here, *there = (uniform_filter1d(v, width) for v, _ in _on_grid(one, other, 0.0, lag.seconds))
    return len(here) > 1 and -_correlation(here, there[0]) > _correlation(here, there[1]) - 0.1


def _as_well_without(lag: Lag, one: motion.Signal, other: motion.Signal) -> bool:
    """Whether the two agree about as well without a long lag: slip and slopes, no clock."""
    (a, a_known), (here, here_known), (there, there_known) = _on_grid(one, other, 0.0, lag.seconds)
    known = a_known & here_known & there_known
    left, without = (1.0 - _correlation(a[known], b[known]) for b in (there, here))
    return abs(lag.seconds) > ERROR_FROM_S and left > MOST_LEFT * without


def _on_grid(one: motion.Signal, other: motion.Signal, *later_s: float) -> list[tuple[Array, Mask]]:
    """The first signal on a grid over the time of both, then the second so much later; and where known."""
    start, end = max(one[0][0], other[0][0]), min(one[0][-1], other[0][-1])
    grid = np.arange(0.0, min(float(end - start) * 1e-9, LONGEST_S), GRID_S)
    return [_resampled(grid, one, start), *(_resampled(grid + s, other, start) for s in later_s)]


def _resampled(grid_s: Array, signal: motion.Signal, origin_ns: np.int64) -> tuple[Array, Mask]:
    """A signal at other times, and whether it is known there: away from its gaps."""
    known = np.isfinite(signal[1])
    t_s, values = (signal[0][known] - origin_ns) * 1e-9, signal[1][known]
    after = np.clip(np.searchsorted(t_s, grid_s), 1, len(t_s) - 1)
    near = t_s[after] - t_s[after - 1] < 3.0 * period_s(signal[0])
    return np.interp(grid_s, t_s, values), np.asarray(near & (grid_s >= t_s[0]) & (grid_s <= t_s[-1]))


def _correlation(a: Array, b: Array) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if len(a) and min(a.std(), b.std()) > 1e-9 else 0.0
