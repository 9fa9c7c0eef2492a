"""Clocks that run fast or slow against those of other channels."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks import motion
from terrafusion.datasets.checks.finding import Finding, clocks_of, period_s, retiming
from terrafusion.datasets.core.arrays import TimesNs
from terrafusion.datasets.core.recording import Recording

LEAST_DRIFT, MOST_DRIFT, DRIFT_SHARE = 0.003, 0.1, 0.35
"""A drift counts from this rate on, where durations and lags agree on it to this share."""
LEAST_BY_LAGS = 0.0005
"""Smaller ones count from this rate on, by the lags alone."""
DRIFT_WINDOW_S, DRIFT_ROUNDS = 20.0, 3
BETWEEN = (0.35, 0.65)
"""Shares of the log's time at which a drift by lags alone is looked at again."""
LEAST_LAG_S = dict.fromkeys(motion.YAW_PAIRS, 0.1) | dict.fromkeys(motion.SPEED_PAIRS, 0.2)
"""Smaller lags are no finding; slip distorts the speed of wheels, so that theirs may be larger."""


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


def clock_drifts(
    recording: Recording, pairs: motion.SensorPairs
) -> tuple[dict[motion.Pair, Drift], set[str]]:
    """Drifts of the second clock of a pair against the first, and the channels of the pairs that have none.

    Durations and growing lags agree on a drift; of channels that do not begin and end together the lags alone
    tell it, where they grow clearly.
    """
    found, steady = {}, set[str]()
    for pair, signals in pairs.items():
        rate = _longer(recording, pair)
        drift = _drift(*signals, rate) if LEAST_DRIFT < abs(rate) < MOST_DRIFT else None
        first = None if drift else _growing_lag(*signals, int(signals[1][0][0]))
        if first is not None and abs(first[1]) - first[2] < LEAST_BY_LAGS:
            steady |= {*pair} if abs(first[1]) + first[2] < LEAST_DRIFT else set()
        elif first is not None:
            drift = _drift_by_lags(*signals, LEAST_LAG_S[pair])
        if drift is not None:
            found[pair] = drift
    return found, steady


def _agree(one: float, other: float) -> bool:
    """Whether two estimates of a drift rate do; the share is that of the second."""
    return abs(one - other) <= DRIFT_SHARE * abs(other)


def _longer(recording: Recording, pair: motion.Pair) -> float:
    """By which share of the first channel of a pair the second is longer; 0 where that has no length."""
    one, other = (float(t[-1]) - float(t[0]) for t in map(clocks_of(recording).__getitem__, pair))
    return other / one - 1.0 if one > 0.0 else 0.0


def _drift_by_lags(one: motion.Signal, other: motion.Signal, least_s: float) -> Drift | None:
    """A drift that the lags at both ends show to a third, and those between lie on it: a step is none.

    It moves the clock by `least_s` at least, so that it matters, and within what a search for lags reaches.
    """
    drift = _drift(one, other, None)
    if drift is None:
        return None
    rate = 1.0 / drift.scale - 1.0
    start, end = float(max(one[0][0], other[0][0])), float(min(one[0][-1], other[0][-1]))
    grown_s = abs(rate) * (end - start) * 1e-9
    if drift.spread > abs(rate) / 3.0 or not least_s < grown_s < motion.NEAR_S:
        return None
    t_ns, half = drift.corrected(other[0]), max(DRIFT_WINDOW_S * 1e9, 0.2 * (end - start)) / 2.0
    for share in BETWEEN:
        parts = [abs(t - start - share * (end - start)) < half for t in (one[0], t_ns)]
        lag = motion.near_lag((one[0][parts[0]], one[1][parts[0]]), (t_ns[parts[1]], other[1][parts[1]]))
        if lag is None or abs(lag.seconds) > max(0.2 * grown_s, lag.high_s - lag.seconds):
            return None
    return drift


def _drift(one: motion.Signal, other: motion.Signal, rate: float | None) -> Drift | None:
    """The drift of the second clock by the lags at both ends of the log, where they agree with any `rate`.

    The lags are measured on the clock as corrected so far, so that the drift does not blur them.
    """
    anchor = int(other[0][0])
    drift = Drift(anchor, 0.0, 1.0 / (1.0 + (rate or 0.0)), 0.0, 1.0)
    for _ in range(DRIFT_ROUNDS):
        line = _growing_lag(one, (drift.corrected(other[0]), other[1]), anchor)
        if line is None:
            return None
        at_anchor_s, slope, spread, r = line
        drift = Drift(
            anchor, drift.offset_s * (1.0 - slope) - at_anchor_s, drift.scale * (1.0 - slope), spread, r
        )
        estimated = 1.0 / drift.scale - 1.0
        if (rate is not None and not _agree(estimated, rate)) or spread > 0.5 * abs(estimated):
            return None
    return drift


def _growing_lag(
    one: motion.Signal, other: motion.Signal, anchor: int
) -> tuple[float, float, float, float] | None:
    """Lag at the anchor, its growth with 95 % interval, and the correlation, from both ends of the log."""
    start, end = float(max(one[0][0], other[0][0])), float(min(one[0][-1], other[0][-1]))
    window = max(DRIFT_WINDOW_S * 1e9, 0.2 * (end - start))
    if end - start < 2.0 * window:
        return None
    lags = []
    for begin in (start, end - window):
        part = [(t >= begin) & (t < begin + window) for t in (one[0], other[0])]
        lag = motion.near_lag((one[0][part[0]], one[1][part[0]]), (other[0][part[1]], other[1][part[1]]))
        if lag is None or lag.r < motion.LEAST_R:
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


def drift_finding(recording: Recording, drifts: dict[motion.Pair, Drift], steady: set[str]) -> Finding:
    """The finding on the clock that drifts, which is none of those that are `steady` with another."""
    names = {name for pair in drifts for name in pair}
    names = names - steady or names
    by_durations = any(
        _agree(_longer(recording, pair), 1.0 / drift.scale - 1.0) for pair, drift in drifts.items()
    )
    # An IMU counts its samples itself (assumed); the times of the others are mostly those of the computer.
    name = "imu" if "imu" in names and not by_durations else _odd_duration(recording, names)
    pair = min((p for p in drifts if name in p), key=lambda p: drifts[p].spread)
    drift = drifts[pair] if name == pair[1] else drifts[pair].reversed()
    scaled = dataclasses.replace(drift, offset_s=0.0)  # an offset is a later finding
    rate, against = 1.0 / drift.scale - 1.0, pair[0] if name == pair[1] else pair[1]
    agree = _agree(_longer(recording, (against, name)), rate)
    return Finding(
        "clock-drift", "error", name,
        f"its clock runs {abs(rate):.2%} too {'fast' if rate > 0 else 'slow'}",
        f"{rate:+.3%} +- {drift.spread:.3%} against {against} by the lags at both ends of the log "
        f"(correlation {drift.r:.2f}){'; their durations differ by the same rate' if agree else ''}",
        f"scale the times of {name} about its first; {motion.reason(name, set(drifts))}",
        retiming(name, scaled.corrected),
    )  # fmt: skip
