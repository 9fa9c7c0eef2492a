"""Runs of the field table condensed: a line for each log, test and mode, and ratios between modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from terrafusion.datasets.core.bootstrap import percentile_interval
from terrafusion.fusion.benchmark.compare import known_median

if TYPE_CHECKING:
    from tests.studies.field_table.table import Run

OWN = "adaptive"
"""The mode that is compared; all others are baselines."""
EVEN = 0.03
"""Ratios this close to 1 count as neither better nor worse."""
DRAWS = 400
"""Of the bootstrap of a ratio."""


@dataclass(frozen=True)
class Line:
    """One log, test and mode: medians over its runs.

    `ratio` is its error over that of the best baseline of the same log and
    test, `baseline` the name of that, `ratio_low` and `ratio_high` the 95 %
    interval that outages and noise leave (None where there is one run);
    `diverged` how many runs did.
    """

    log: str
    ground: str
    reference: str
    test: str
    mode: str
    runs: int
    distance_m: float
    error_m: float | None
    percent: float | None
    nees: float | None
    ratio: float | None
    ratio_low: float | None
    ratio_high: float | None
    baseline: str
    diverged: int
    top_speed_mps: float
    path_ratio: float | None
    realtime: float
    latency_p99_ms: float


def condense(runs: Sequence[Run]) -> list[Line]:
    """Lines in the order of the runs; where a mode lacks a run that others have, it has fewer `runs`."""
    out = []
    for by_mode in _rows(runs):
        baseline = _best_baseline(by_mode)
        out += [_line(mode, found, baseline, by_mode.get(baseline, [])) for mode, found in by_mode.items()]
    return out


def ratio_of(own: Sequence[Run], other: Sequence[Run]) -> tuple[float | None, float | None, float | None]:
    """Median error over that of another mode, and the ends of its 95 % interval.

    The interval is a bootstrap over what the two ran both: outages (or drives) are drawn anew, then the
    noise of each (Davison and Hinkley 1997, Bootstrap Methods, sec. 3.8). None where nothing can be drawn.
    """
    top, below = known_median([r.error_m for r in own]), known_median([r.error_m for r in other])
    ratio = top / below if top is not None and below else None
    theirs = {(r.drive, r.start_s, r.seed): r.error_m for r in other}
    pairs: dict[tuple[int, float | None], list[tuple[float, float]]] = {}
    for run in own:
        error = theirs.get((run.drive, run.start_s, run.seed))
        if run.error_m is not None and error is not None:
            pairs.setdefault((run.drive, run.start_s), []).append((run.error_m, error))
    clusters = [np.array(found) for found in pairs.values()]
    if ratio is None or sum(map(len, clusters)) < 2:
        return ratio, None, None
    rng, draws, both = np.random.default_rng(0), list[np.ndarray](), np.empty((DRAWS, 2))
    for _ in range(DRAWS):
        chosen = [clusters[j] for j in rng.integers(len(clusters), size=len(clusters))]
        draws.append(
            np.concatenate([c[rng.integers(len(c), size=len(c))] if len(c) > 1 else c for c in chosen])
        )
    for size in {len(draw) for draw in draws}:  # medians of many draws at once
        alike = [i for i, draw in enumerate(draws) if len(draw) == size]
        both[alike] = np.median([draws[i] for i in alike], axis=1)
    drawn = both[:, 0] / np.maximum(both[:, 1], 1e-9)
    return ratio, *percentile_interval(drawn)


def verdicts(lines: Sequence[Line]) -> list[dict[str, str | int | float | None]]:
    """By ground and test: in how many logs `OWN` is better or worse, mean (geometric) and largest ratio."""
    groups: dict[tuple[str, str], list[Line]] = {}
    for line in lines:
        if line.mode == OWN and line.ratio is not None:
            groups.setdefault((line.ground or "not labelled", line.test), []).append(line)
    out: list[dict[str, str | int | float | None]] = []
    for (ground, test), found in sorted(groups.items(), key=lambda item: (item[0][0], in_order(item[0][1]))):
        ratios = np.array([line.ratio for line in found], dtype=float)
        row: dict[str, str | int | float | None] = {"ground": ground, "test": test, "logs": len(found)}
        row |= {"better": int((ratios < 1 - EVEN).sum()), "worse": int((ratios > 1 + EVEN).sum())}
        row["significantly_worse"] = sum((line.ratio_low or 0.0) > 1 + EVEN for line in found)
        row["mean_ratio"] = float(np.exp(np.log(np.maximum(ratios, 1e-9)).mean()))
        row["worst"] = float(ratios.max())
        row["percent"] = known_median([line.percent for line in found])
        out.append(row)
    return out


@dataclass(frozen=True)
class BaselineComparison:
    """`OWN` against one baseline on one kind of ground: `rows` are logs and tests; `better` and `worse` by
    more than `EVEN`, `significantly_worse` with the whole interval."""

    ground: str
    baseline: str
    rows: int
    mean_ratio: float
    better: int
    worse: int
    significantly_worse: int
    worst: float


def compare_with_baselines(runs: Sequence[Run]) -> list[BaselineComparison]:
    """`OWN` against every baseline, by ground."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for by_mode in _rows(runs):
        for mode, theirs in by_mode.items():
            ratio, low, _ = ratio_of(by_mode.get(OWN, []), theirs) if mode != OWN else (None, None, None)
            if ratio is not None:
                found.setdefault((theirs[0].ground or "not labelled", mode), []).append((ratio, low or 0.0))
    out = []
    for (ground, baseline), pairs in sorted(found.items()):
        ratios, lows = np.array(pairs).T
        mean = float(np.exp(np.log(np.maximum(ratios, 1e-9)).mean()))
        beyond = ratios < 1 - EVEN, ratios > 1 + EVEN, lows > 1 + EVEN
        better, worse, significantly = (int(rows.sum()) for rows in beyond)
        out.append(
            BaselineComparison(
                ground, baseline, len(pairs), mean, better, worse, significantly, float(ratios.max())
            )
        )
    return out


def in_order(test: str) -> tuple[int, str]:
    """Key by which "whole" comes before outages, and short ones before long ones."""
    return len(test), test


def _rows(runs: Sequence[Run]) -> list[dict[str, list[Run]]]:
    """The runs of each log and test by mode."""
    groups: dict[tuple[str, str], dict[str, list[Run]]] = {}
    for run in runs:
        groups.setdefault((run.log, run.test), {}).setdefault(run.mode, []).append(run)
    return list(groups.values())


def _best_baseline(by_mode: dict[str, list[Run]]) -> str:
    errors = {mode: known_median([r.error_m for r in runs]) for mode, runs in by_mode.items() if mode != OWN}
    known = {mode: error for mode, error in errors.items() if error is not None}
    return min(known, key=lambda mode: known[mode], default="")


def _line(mode: str, runs: list[Run], baseline: str, best: list[Run]) -> Line:
    first, error = runs[0], known_median([r.error_m for r in runs])
    ratio, low, high = ratio_of(runs, best) if mode != baseline else (1.0 if error else None, None, None)
    return Line(
        log=first.log,
        ground=first.ground,
        reference=first.reference,
        test=first.test,
        mode=mode,
        runs=len(runs),
        distance_m=float(np.median([r.distance_m for r in runs])),
        error_m=error,
        percent=known_median([r.percent for r in runs]),
        nees=known_median([r.nees for r in runs]),
        ratio=ratio,
        ratio_low=low,
        ratio_high=high,
        baseline=baseline,
        diverged=sum(bool(r.diverged) for r in runs),
        top_speed_mps=float(np.max([r.top_speed_mps for r in runs])),
        path_ratio=known_median([r.path_ratio for r in runs]),
        realtime=float(np.median([r.realtime for r in runs])),
        latency_p99_ms=float(np.median([r.latency_p99_ms for r in runs])),
    )
