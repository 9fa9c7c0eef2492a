"""Runs of the field table condensed: a line for each log, test and mode, and ratios between modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from terrafusion.fusion.scores.field_table import Run

OWN = "adaptive"
"""The mode that is compared; all others are baselines."""
EVEN = 0.03
"""Ratios this close to 1 count as neither better nor worse."""


@dataclass(frozen=True)
class Line:
    """One log, test and mode: medians over its runs.

    `ratio` is its error over that of the best baseline of the same log and
    test, `baseline` the name of that; `diverged` how many runs did.
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
    baseline: str
    diverged: int
    top_speed_mps: float
    path_ratio: float | None
    realtime: float
    latency_p99_ms: float


def condense(runs: Sequence[Run]) -> list[Line]:
    """Lines in the order of the runs; where a mode lacks a run that others have, it has fewer `runs`."""
    groups: dict[tuple[str, str], dict[str, list[Run]]] = {}
    for run in runs:
        groups.setdefault((run.log, run.test), {}).setdefault(run.mode, []).append(run)
    return [
        _line(mode, found, *_best_baseline(by_mode))
        for by_mode in groups.values()
        for mode, found in by_mode.items()
    ]


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
        row["mean_ratio"] = float(np.exp(np.log(np.maximum(ratios, 1e-9)).mean()))
        row["worst"] = float(ratios.max())
        row["percent"] = median([line.percent for line in found])
        out.append(row)
    return out


def in_order(test: str) -> tuple[int, str]:
    """Key by which "whole" comes before outages, and short ones before long ones."""
    return len(test), test


def median(values: Sequence[float | None]) -> float | None:
    """Median of the known ones; None where there is none."""
    known = [v for v in values if v is not None and np.isfinite(v)]
    return float(np.median(known)) if known else None


def _best_baseline(by_mode: dict[str, list[Run]]) -> tuple[float | None, str]:
    errors = {mode: median([r.error_m for r in runs]) for mode, runs in by_mode.items() if mode != OWN}
    known = {mode: error for mode, error in errors.items() if error is not None}
    best = min(known, key=lambda mode: known[mode], default="")
    return known.get(best), best


def _line(mode: str, runs: list[Run], best_m: float | None, baseline: str) -> Line:
    first, error = runs[0], median([r.error_m for r in runs])
    return Line(
        log=first.log,
        ground=first.ground,
        reference=first.reference,
        test=first.test,
        mode=mode,
        runs=len(runs),
        distance_m=float(np.median([r.distance_m for r in runs])),
        error_m=error,
        percent=median([r.percent for r in runs]),
        nees=median([r.nees for r in runs]),
        ratio=error / best_m if error is not None and best_m else None,
        baseline=baseline,
        diverged=sum(bool(r.diverged) for r in runs),
        top_speed_mps=float(np.max([r.top_speed_mps for r in runs])),
        path_ratio=median([r.path_ratio for r in runs]),
        realtime=float(np.median([r.realtime for r in runs])),
        latency_p99_ms=float(np.median([r.latency_p99_ms for r in runs])),
    )
