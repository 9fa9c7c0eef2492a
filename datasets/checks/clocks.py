"""Clocks that jump ahead or drift, detected by comparison with other sensors."""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks.finding import CheckContext, Finding, clocks_of, counted, period_s, retiming
from terrafusion.datasets.checks.motion import LEAST_R, Pair, SensorPairs, Signal, near_lag, reason
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.lag import Lag
from terrafusion.datasets.core.recording import Recording

LEAST_JUMP_S, JUMP_PERIODS, MOST_JUMPS = 0.3, 3.0, 4
SURE_JUMP_S = 1.0
"""A jump that no correlation confirms must be this long, and show at the end of the channel."""
LEAST_DRIFT, MOST_DRIFT, DRIFT_SHARE = 0.003, 0.1, 0.35
"""A drift counts from this rate on, where durations and lags agree on it to this share."""
DRIFT_WINDOW_S, DRIFT_ROUNDS = 20.0, 3


@dataclass(frozen=True)
class JumpAhead:
    """From `row` on the times of a channel are `step_ns` too late."""

    row: int
    step_ns: int


@dataclass(frozen=True)
class Drift:
    """True time of a clock: anchor + offset + scale (t - anchor).

    `spread` is half the 95 % interval of the drift rate, `r` the correlation of the signals.
    """

    anchor_ns: int
    offset_s: float
    scale: float
    spread: float
    r: float

    def corrected(self, t_ns: TimesNs) -> TimesNs:
        """True times of the drifting clock."""
        since = (t_ns - self.anchor_ns) * self.scale + self.offset_s * 1e9
        return np.asarray(self.anchor_ns + np.rint(since).astype(np.int64))

    def reversed(self) -> "Drift":
        """The drift of the other clock of the pair, were this one right."""
        return Drift(self.anchor_ns, -self.offset_s / self.scale, 1.0 / self.scale, self.spread, self.r)


def clock_jumps(recording: Recording, pairs: SensorPairs) -> dict[str, list[JumpAhead]]:
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
    own: int, signals: tuple[Signal, Signal], rows: slice, moved_ns: int, jump: JumpAhead
) -> bool | None:
    """Whether the rows after a jump fit the other signal only when shifted back; None where nothing fits."""
    other, (t_ns, values) = signals[1 - own], signals[own]
    before = near_lag(other, (t_ns[: jump.row], values[: jump.row]))
    usual_s = before.seconds if before is not None and before.r > LEAST_R and not moved_ns else 0.0
    t_ns, values = t_ns[rows] - moved_ns, values[rows]
    stay, back = (near_lag(other, (t_ns - step, values)) for step in (0, jump.step_ns))
    r_stay, r_back = (_fit(lag, usual_s, jump.step_ns * 1e-9) for lag in (stay, back))
    return r_back > r_stay + 0.05 if max(r_stay, r_back) > LEAST_R else None


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


def clock_drifts(recording: Recording, pairs: SensorPairs) -> dict[Pair, Drift]:
    """Drifts of the second clock of a pair against the first: durations and growing lags agree on it."""
    clocks, found = clocks_of(recording), {}
    for pair, signals in pairs.items():
        spans = [float(clocks[name][-1]) - float(clocks[name][0]) for name in pair]
        rate = spans[1] / spans[0] - 1.0 if spans[0] > 0.0 else 0.0
        if LEAST_DRIFT < abs(rate) < MOST_DRIFT:
            drift = _drift(*signals, rate)
            if drift is not None:
                found[pair] = drift
    return found


def _drift(one: Signal, other: Signal, rate: float) -> Drift | None:
    """The drift of the second clock by the lags at both ends of the log, where they agree with `rate`.

    The lags are measured on the clock as corrected so far, so that the drift does not blur them.
    """
    anchor = int(other[0][0])
    drift = Drift(anchor, 0.0, 1.0 / (1.0 + rate), 0.0, 1.0)
    for _ in range(DRIFT_ROUNDS):
        line = _growing_lag(one, (drift.corrected(other[0]), other[1]), anchor)
        if line is None:
            return None
        at_anchor_s, slope, spread, r = line
        drift = Drift(
            anchor, drift.offset_s * (1.0 - slope) - at_anchor_s, drift.scale * (1.0 - slope), spread, r
        )
        estimated = 1.0 / drift.scale - 1.0
        if abs(estimated - rate) > DRIFT_SHARE * abs(rate) or spread > 0.5 * abs(estimated):
            return None
    return drift


def _growing_lag(one: Signal, other: Signal, anchor: int) -> tuple[float, float, float, float] | None:
    """Lag at the anchor, its growth with 95 % interval, and the correlation, from both ends of the log."""
    start, end = float(max(one[0][0], other[0][0])), float(min(one[0][-1], other[0][-1]))
    window = max(DRIFT_WINDOW_S * 1e9, 0.2 * (end - start))
    if end - start < 2.0 * window:
        return None
    lags = []
    for begin in (start, end - window):
        part = [(t >= begin) & (t < begin + window) for t in (one[0], other[0])]
        lag = near_lag((one[0][part[0]], one[1][part[0]]), (other[0][part[1]], other[1][part[1]]))
        if lag is None or lag.r < LEAST_R:
            return None
        lags.append(lag)
    apart_s = (end - start - window) * 1e-9
    slope = (lags[1].seconds - lags[0].seconds) / apart_s
    spread = 0.5 * float(np.linalg.norm([lag.high_s - lag.low_s for lag in lags])) / apart_s
    at_anchor_s = lags[0].seconds - slope * (start + 0.5 * window - anchor) * 1e-9
    return at_anchor_s, slope, spread, min(lag.r for lag in lags)


def _odd_duration(recording: Recording, names: set[str]) -> str:
    """The channel whose duration is furthest from the median of all; of equals the one of lowest rate."""
    spans = {name: float(t[-1]) - float(t[0]) for name, t in clocks_of(recording).items()}
    median = float(np.median(list(spans.values())))
    oddness = {name: round(abs(spans[name] / median - 1.0), 4) for name in names}
    return max(sorted(names), key=lambda name: (oddness[name], period_s(clocks_of(recording)[name])))


def drift_finding(recording: Recording, drifts: dict[Pair, Drift]) -> Finding:
    """The finding on the clock that drifts."""
    name = _odd_duration(recording, {name for pair in drifts for name in pair})
    pair = min((p for p in drifts if name in p), key=lambda p: drifts[p].spread)
    drift = drifts[pair] if name == pair[1] else drifts[pair].reversed()
    scaled = dataclasses.replace(drift, offset_s=0.0)  # an offset is a later finding
    rate, against = 1.0 / drift.scale - 1.0, pair[0] if name == pair[1] else pair[1]
    return Finding(
        "clock-drift", "error", name,
        f"its clock runs {abs(rate):.2%} too {'fast' if rate > 0 else 'slow'}",
        f"{rate:+.3%} +- {drift.spread:.3%} against {against} by the lags at both ends of the log "
        f"(correlation {drift.r:.2f}); their durations differ by the same rate",
        f"scale the times of {name} about its first; {reason(name, set(drifts))}",
        retiming(name, scaled.corrected),
    )  # fmt: skip
