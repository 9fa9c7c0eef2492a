"""Paired comparison of methods: median error ratios with intervals, wins and losses.

The errors of two methods are divided run by run; the result is the median ratio over independent units
(seeds; for a field log the median over its outages). Its interval is that of the sign test, between two
ordered ratios (Thompson 1936, Ann. Math. Statist. 7(3)): distribution-free, from `LEAST_UNITS` units on. The
interval of a share of two gains is the percentile bootstrap's over units, both methods resampled together.

A failed replay has an infinite error. Runs on which the baseline failed are left out.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.bootstrap import resampled_rows
from terrafusion.fusion.benchmark.methods import ADAPTIVE, BASELINE, ORACLE
from terrafusion.fusion.benchmark.run_score import RunScore

Interval = tuple[float, float]
Errors = dict[str, dict[str, dict[str, float]]]
"""Method -> unit -> run -> error in m, infinite for a failed replay."""

RESAMPLES = 4000
SEED = 0
CONFIDENCE = 0.95
LEAST_UNITS = 6
"""Fewer have no 95 % interval: all five fall on one side of the median once in 16 times, all six in 32."""
LEAST_ERROR_M = 1e-3
"""Smaller errors count as a millimetre, the accuracy of the truth."""
EVEN = 0.03
"""Ratios this close to 1 count as neither won nor lost."""


@dataclass(frozen=True)
class Contrast:
    """One method against another in one family on one plant.

    Attributes:
        method, baseline: names of the two methods.
        units: independent runs (or logs) in which both have an error.
        error_m, baseline_m: median errors; infinite if half of the replays failed.
        ratio, interval: median of the paired ratios, error over baseline; none below `LEAST_UNITS`.
        wins, losses: units whose ratio is below or above 1 by more than `EVEN`.
    """

    family: str
    plant: str
    method: str
    baseline: str
    units: int
    error_m: float
    baseline_m: float
    ratio: float
    interval: Interval | None
    wins: int
    losses: int


JSON_KEYS = {"method": "arm", "baseline": "base", "baseline_m": "base_m"}
"""Keys of benchmark.json that are not the names of their fields."""


def as_json(score: RunScore | Contrast) -> dict[str, Any]:
    """A score or contrast as in benchmark.json."""
    return {JSON_KEYS.get(key, key): value for key, value in dataclasses.asdict(score).items()}


@dataclass(frozen=True)
class GainShare:
    """Share of the oracle's gain over fixed noise that the detected ground reaches; None without a gain."""

    family: str
    plant: str
    share: float | None
    interval: Interval | None


def groups_of(rows: Sequence[RunScore]) -> dict[tuple[str, str], list[RunScore]]:
    """Scores by family and plant, in their order."""
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for row in rows:
        groups.setdefault((row.family, row.plant), []).append(row)
    return groups


def contrasts(rows: Sequence[RunScore], baseline: str = BASELINE) -> list[Contrast]:
    """Every method against `baseline`, group by group."""
    groups = groups_of(rows).items()
    found = (
        _contrast(key, errors_by_unit(group), method, baseline)
        for key, group in groups
        for method in dict.fromkeys(row.method for row in group)
    )
    return [contrast for contrast in found if contrast is not None]


def shares(rows: Sequence[RunScore]) -> list[GainShare]:
    """Share of the oracle's gain, group by group."""
    return [GainShare(*key, *_share(errors_by_unit(group))) for key, group in groups_of(rows).items()]


def errors_by_unit(rows: Sequence[RunScore]) -> Errors:
    """The errors of runs; those without one are left out."""
    out: Errors = {}
    for row in rows:
        broken = row.failed or (row.diverged and row.error_m is None)
        error = math.inf if broken else row.error_m
        if error is not None:
            by_unit = out.setdefault(row.method, {}).setdefault(row.unit, {})
            by_unit[row.drive] = max(error, LEAST_ERROR_M)
    return out


def log_ratios(errors: Errors, method: str, baseline: str) -> dict[str, float]:
    """Unit -> logarithm of the ratio: median over the common runs in which the baseline did not fail."""
    out = {}
    for unit, own in errors.get(method, {}).items():
        other = errors.get(baseline, {}).get(unit, {})
        logs = [
            math.log(error / other[drive])
            for drive, error in own.items()
            if other.get(drive, math.inf) < math.inf
        ]
        if logs:
            out[unit] = float(np.median(logs))
    return out


def known_median(values: Sequence[float | None]) -> float | None:
    """Median of the finite values; None if there is none."""
    known = [v for v in values if v is not None and np.isfinite(v)]
    return float(np.median(known)) if known else None


def median_interval(values: Sequence[float]) -> tuple[float, Interval | None]:
    """Median of independent values, and its interval from `LEAST_UNITS` values on."""
    ordered = sorted(values)
    middle = float(np.median(ordered))
    if len(ordered) < LEAST_UNITS:
        return middle, None
    from scipy.stats import binom

    k = int(binom.ppf(0.5 * (1.0 - CONFIDENCE), len(ordered), 0.5)) - 1  # values outside, at each end
    return middle, (ordered[k], ordered[-1 - k])


def _contrast(group: tuple[str, str], errors: Errors, method: str, baseline: str) -> Contrast | None:
    logs = log_ratios(errors, method, baseline)
    if not logs:
        return None
    own, other = ([float(np.median([*errors[a][u].values()])) for u in logs] for a in (method, baseline))
    middle, interval = median_interval(list(logs.values()))
    ratios = np.exp(list(logs.values()))
    return Contrast(
        *group, method, baseline, len(logs), float(np.median(own)), float(np.median(other)),
        float(np.exp(middle)),
        None if interval is None else (float(np.exp(interval[0])), float(np.exp(interval[1]))),
        int((ratios < 1.0 - EVEN).sum()), int((ratios > 1.0 + EVEN).sum()),
    )  # fmt: skip


def _share(errors: Errors) -> tuple[float | None, Interval | None]:
    own, best = (log_ratios(errors, method, BASELINE) for method in (ADAPTIVE, ORACLE))
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
    gains = 1.0 - np.exp(np.median(logs[resampled_rows(len(logs), RESAMPLES, SEED)], axis=1))
    if (gains[:, 1] <= 0.0).mean() > 0.5 * (1.0 - CONFIDENCE):
        return share, None
    samples = gains[:, 0] / np.maximum(gains[:, 1], 1e-9)
    # A sample, not a mean of two: a gain is minus infinity if half of the replays failed.
    low, high = np.percentile(samples, [2.5, 97.5], method="inverted_cdf")
    return share, (float(low), float(high))
