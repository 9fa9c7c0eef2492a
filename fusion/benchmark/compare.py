"""Paired comparison of the arms: medians over drives, intervals by the bootstrap, wins and losses.

Two arms are compared on the same drives. The ratio of their errors is taken drive by drive; its median over
the independent units (seeds, or field logs, whose several outages make one number by their own median) is the
result. Its interval is the sign test's, between two of the ordered ratios (Thompson 1936, Ann. Math. Statist.
7(3)): it holds for any distribution and any number of units from `LEAST_UNITS` on; fewer have none. That of a
share of two gains is the percentile bootstrap's over units (Efron 1979, Ann. Statist. 7(1)), both arms
resampled together, so that the gains keep their pairing.

A replay that failed has an infinite error, so that it loses. Where the base failed nothing is compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE, ORACLE
from terrafusion.fusion.benchmark.run_score import RunScore

Array = NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES = 4000
SEED = 0
CONFIDENCE = 0.95
LEAST_UNITS = 6
"""Fewer have no interval: all five on one side of the median are chance once in 16 times, six in 32."""
LEAST_ERROR_M = 1e-3
"""Errors below a millimetre count as one: no ratio is made of what the truth itself does not hold."""
EVEN = 0.03
"""Ratios so close to 1 are neither won nor lost."""


@dataclass(frozen=True)
class Contrast:
    """One arm against another in one family on one plant.

    Attributes:
        units: independent drives (or logs) in which both have an error.
        error_m, base_m: median errors; infinite where half of the replays failed.
        ratio, interval: median of the paired ratios, error over base; None for less than `LEAST_UNITS`.
        wins, losses: units in which the ratio is below or above 1 by more than `EVEN`.
    """

    family: str
    plant: str
    arm: str
    base: str
    units: int
    error_m: float
    base_m: float
    ratio: float
    interval: Interval | None
    wins: int
    losses: int


@dataclass(frozen=True)
class GainShare:
    """How much of the oracle's gain over the fixed row the detected ground keeps; None where it has none."""

    family: str
    plant: str
    share: float | None
    interval: Interval | None


def groups_of(rows: Sequence[RunScore]) -> dict[tuple[str, str], list[RunScore]]:
    """Rows by family and plant, in their order."""
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for row in rows:
        groups.setdefault((row.family, row.plant), []).append(row)
    return groups


def contrasts(rows: Sequence[RunScore], base: str = BASELINE) -> list[Contrast]:
    """Every arm against `base`, group by group."""
    out = []
    for (family, plant), group in groups_of(rows).items():
        errors = errors_by_unit(group)
        for arm in dict.fromkeys(row.arm for row in group):
            found = _contrast(errors, arm, base)
            if found is not None:
                out.append(Contrast(family, plant, arm, base, *found))
    return out


def shares(rows: Sequence[RunScore]) -> list[GainShare]:
    """Share of the oracle's gain, group by group."""
    return [GainShare(*key, *_share(errors_by_unit(group))) for key, group in groups_of(rows).items()]


def errors_by_unit(rows: Sequence[RunScore]) -> dict[str, dict[str, dict[str, float]]]:
    """arm -> unit -> drive -> error in m, infinite where the replay failed; without one it is left out."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        broken = row.failed or (row.diverged and row.error_m is None)
        error = math.inf if broken else row.error_m
        if error is not None:
            by_unit = out.setdefault(row.arm, {}).setdefault(row.unit, {})
            by_unit[row.drive] = max(error, LEAST_ERROR_M)
    return out


def log_ratios(errors: dict[str, dict[str, dict[str, float]]], arm: str, base: str) -> dict[str, float]:
    """Unit -> logarithm of the ratio: the median over drives of both arms in which base did not fail."""
    out = {}
    for unit, own in errors.get(arm, {}).items():
        other = errors.get(base, {}).get(unit, {})
        logs = [
            math.log(error / other[drive])
            for drive, error in own.items()
            if other.get(drive, math.inf) < math.inf
        ]
        if logs:
            out[unit] = float(np.median(logs))
    return out


def known_median(values: Sequence[float | None]) -> float | None:
    """Median of the known ones; None where there is none."""
    known = [v for v in values if v is not None and np.isfinite(v)]
    return float(np.median(known)) if known else None


def resampled(values: Array) -> Array:
    """Medians (R, k) of columns of `values` (n, k) over bootstrap samples of its rows."""
    rng = np.random.default_rng(SEED)
    rows = rng.integers(len(values), size=(RESAMPLES, len(values)))
    return np.asarray(np.median(values[rows], axis=1))


def median_interval(values: Sequence[float]) -> tuple[float, Interval | None]:
    """Median of independent values, and its interval where there are `LEAST_UNITS` of them or more."""
    ordered = sorted(values)
    middle = float(np.median(ordered))
    if len(ordered) < LEAST_UNITS:
        return middle, None
    k = _sign_test_rank(len(ordered))
    return middle, (ordered[k], ordered[-1 - k])


def _sign_test_rank(n: int) -> int:
    """How many of n ordered values may be left out at each end of an interval of the median."""
    tail, k = 0.5**n, 0
    while 2.0 * (tail := tail + math.comb(n, k + 1) * 0.5**n) <= 1.0 - CONFIDENCE:
        k += 1
    return k


def _contrast(
    errors: dict[str, dict[str, dict[str, float]]], arm: str, base: str
) -> tuple[int, float, float, float, Interval | None, int, int] | None:
    logs = log_ratios(errors, arm, base)
    if not logs:
        return None
    own, other = ([float(np.median([*errors[a][u].values()])) for u in logs] for a in (arm, base))
    middle, interval = median_interval(list(logs.values()))
    ratios = np.exp(list(logs.values()))
    return (
        len(logs), float(np.median(own)), float(np.median(other)), float(np.exp(middle)),
        None if interval is None else (float(np.exp(interval[0])), float(np.exp(interval[1]))),
        int((ratios < 1.0 - EVEN).sum()), int((ratios > 1.0 + EVEN).sum()),
    )  # fmt: skip


def _share(errors: dict[str, dict[str, dict[str, float]]]) -> tuple[float | None, Interval | None]:
    own, best = (log_ratios(errors, arm, BASELINE) for arm in (ADAPTIVE, ORACLE))
    units = [unit for unit in own if unit in best]
    if not units:
        return None, None
    logs = np.array([[own[unit], best[unit]] for unit in units])
    gain_own, gain_best = 1.0 - np.exp(np.median(logs, axis=0))
    if gain_best <= EVEN:
        return None, None
    share = float(gain_own / gain_best)
    if len(units) < LEAST_UNITS:
        return share, None
    gains = 1.0 - np.exp(resampled(logs))
    if (gains[:, 1] <= 0.0).mean() > 0.5 * (1.0 - CONFIDENCE):
        return share, None
    samples = gains[:, 0] / np.maximum(gains[:, 1], 1e-9)
    # A sample, not a mean of two: a gain is minus infinite where half of the replays failed.
    low, high = np.percentile(samples, [2.5, 97.5], method="inverted_cdf")
    return share, (float(low), float(high))
