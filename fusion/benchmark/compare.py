"""Paired comparison of the arms: medians over drives, intervals by the bootstrap, wins and losses.

Two arms are compared on the same drives. The ratio of their errors is taken drive by drive; its median over
the independent units (seeds, or field logs, whose several outages make one number by their own median) is the
result. The interval is the percentile bootstrap's over units (Efron 1979, Ann. Statist. 7(1)), all arms
resampled together, so that shares of two gains keep their pairing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.fusion.benchmark.arms import BASE, ORACLE, OWN
from terrafusion.fusion.benchmark.measure import Row

Array = NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES = 4000
SEED = 0
LEAST_ERROR_M = 1e-3
"""Errors below a millimetre count as one: no ratio is made of what the truth itself does not hold."""
EVEN = 0.03
"""Ratios so close to 1 are neither won nor lost."""


@dataclass(frozen=True)
class Contrast:
    """One arm against another in one family on one plant.

    Attributes:
        units: independent drives (or logs) in which both have an error.
        error_m, base_m: median errors.
        ratio, interval: median of the paired ratios, error over base; None for one unit alone.
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
class Share:
    """How much of the oracle's gain over the fixed row the detected ground keeps; None where it has none."""

    family: str
    plant: str
    share: float | None
    interval: Interval | None


def groups_of(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Rows by family and plant, in their order."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.family, row.plant), []).append(row)
    return groups


def contrasts(rows: Sequence[Row], base: str = BASE) -> list[Contrast]:
    """Every arm against `base`, group by group."""
    out = []
    for (family, plant), group in groups_of(rows).items():
        errors = errors_by_unit(group)
        for arm in dict.fromkeys(row.arm for row in group):
            found = _contrast(errors, arm, base)
            if found is not None:
                out.append(Contrast(family, plant, arm, base, *found))
    return out


def shares(rows: Sequence[Row]) -> list[Share]:
    """Share of the oracle's gain, group by group."""
    return [Share(*key, *_share(errors_by_unit(group))) for key, group in groups_of(rows).items()]


def errors_by_unit(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """arm -> unit -> drive -> error in m; drives without an error are left out."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for row in rows:
        if row.error_m is not None:
            by_unit = out.setdefault(row.arm, {}).setdefault(row.unit, {})
            by_unit[row.drive] = max(row.error_m, LEAST_ERROR_M)
    return out


def log_ratios(errors: dict[str, dict[str, dict[str, float]]], arm: str, base: str) -> dict[str, float]:
    """Unit -> logarithm of the ratio: the median over the drives that both arms have."""
    out = {}
    for unit, own in errors.get(arm, {}).items():
        other = errors.get(base, {}).get(unit, {})
        logs = [np.log(error / other[drive]) for drive, error in own.items() if drive in other]
        if logs:
            out[unit] = float(np.median(logs))
    return out


def resampled(values: Array) -> Array:
    """Medians (R, k) of columns of `values` (n, k) over bootstrap samples of its rows."""
    rng = np.random.default_rng(SEED)
    rows = rng.integers(len(values), size=(RESAMPLES, len(values)))
    return np.asarray(np.median(values[rows], axis=1))


def interval_of(samples: Array) -> Interval:
    """Central 95 % of samples (R,)."""
    low, high = np.percentile(samples, [2.5, 97.5])
    return float(low), float(high)


def median_interval(values: Sequence[float]) -> tuple[float, Interval | None]:
    """Median of independent values, and its interval where there are two of them or more."""
    column = np.asarray(values, dtype=float)[:, None]
    return float(np.median(column)), interval_of(resampled(column)[:, 0]) if len(column) > 1 else None


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
    own, best = (log_ratios(errors, arm, BASE) for arm in (OWN, ORACLE))
    units = [unit for unit in own if unit in best]
    if not units:
        return None, None
    logs = np.array([[own[unit], best[unit]] for unit in units])
    gain_own, gain_best = 1.0 - np.exp(np.median(logs, axis=0))
    if gain_best <= EVEN:
        return None, None
    share = float(gain_own / gain_best)
    if len(units) < 2:
        return share, None
    gains = 1.0 - np.exp(resampled(logs))
    if (gains[:, 1] <= 0.0).mean() > 0.025:
        return share, None
    return share, interval_of(gains[:, 0] / np.maximum(gains[:, 1], 1e-9))
