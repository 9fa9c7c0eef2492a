"""Where: cells of channel, regime and band in which the judged runs err more than the references.

A cell's share is what it adds to the excess of squared errors. Its p-value holds for all cells together:
the greatest standardised excess over all cells, of other choices of runs (max-T, Westfall and Young 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.infer.detect import choices
from terrafusion.twin.gap.rollout.nuisance import NAMES, told_twist
from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

REGIMES = (
    ("standing", lambda v, r, a: np.abs(v) + 0.3 * np.abs(r) < 0.02),
    ("speeding up or braking", lambda v, r, a: np.abs(a) > 0.2),
    ("turning, slow", lambda v, r, a: (np.abs(r) > 0.1) & (np.abs(v) <= 0.7)),
    ("turning, fast", lambda v, r, a: (np.abs(r) > 0.1) & (np.abs(v) > 0.7)),
    ("straight, slow", lambda v, r, a: (np.abs(r) <= 0.1) & (np.abs(v) <= 0.7)),
    ("straight, fast", lambda v, r, a: (np.abs(r) <= 0.1) & (np.abs(v) > 0.7)),
)
"""Name and condition on told speed (m/s), turn rate (rad/s) and acceleration (m/s2); the first that holds."""
BANDS = ("below 0.5 Hz", "above 0.5 Hz")
SLOW_S = 2.0
"""Means over this long are the slow band."""
LEAST_ROWS = 5
LEAST_REFERENCES = 2
"""Fewer have no scatter from run to run."""


@dataclass(frozen=True)
class Cell:
    """One cell of the gap map."""

    channel: str
    regime: str
    band: str
    share: float
    p_value: float
    rms: float


def regimes(run: Evidence, model: Model) -> NDArray[np.int64]:
    """Number (n,) of the regime of each row."""
    t_s, twist = told_twist(run.log, model)
    rate = np.gradient(twist[:, 0], t_s)
    width = 51  # half a second
    rate = np.convolve(np.pad(rate, width // 2, mode="edge"), np.ones(width) / width, mode="valid")
    v, r, a = (np.interp(run.time_s, t_s, x) for x in (twist[:, 0], twist[:, 1], rate))
    out = np.full(len(run.time_s), len(REGIMES) - 1)
    for i in reversed(range(len(REGIMES))):
        out[np.asarray(REGIMES[i][1](v, r, a))] = i
    return out


def cells(run: Evidence, model: Model, errors: Array) -> dict[tuple[str, int, int], tuple[float, float]]:
    """Sum of squares and effective count of each cell of a run (channel, regime, band)."""
    regime, out = regimes(run, model), dict[tuple[str, int, int], tuple[float, float]]()
    for i, observed in enumerate(run.log.observed):
        name = NAMES[observed.channel]
        rows = np.flatnonzero(run.channel == i)
        rows = rows[np.argsort(run.time_s[rows], kind="stable")]
        e = errors[rows]
        block = np.floor(run.time_s[rows] / SLOW_S).astype(np.int64)
        key = regime[rows] + len(REGIMES) * (block - block.min())
        _, group, count = np.unique(key, return_inverse=True, return_counts=True)
        mean = np.bincount(group, e) / count
        for band, values in enumerate((np.sqrt(count)[group] * mean[group], e - mean[group])):
            weight = 1.0 / count[group] if band == 0 else 1.0 - 1.0 / count[group]
            square = values**2 * (1.0 / count[group] if band == 0 else 1.0)
            for k in range(len(REGIMES)):
                mine = regime[rows] == k
                old = out.get((name, k, band), (0.0, 0.0))
                out[name, k, band] = (old[0] + float(square[mine].sum()), old[1] + float(weight[mine].sum()))
    return out


def gap_map(
    runs: Sequence[Evidence], references: Sequence[Evidence], model: Model, errors: Sequence[Array], seed: int
) -> list[Cell]:
    """All cells with enough rows, most important first; none without references to compare with.

    Args:
        errors: whitened errors of runs, then references, theta and the common offset taken out.
    """
    if len(references) < LEAST_REFERENCES:
        return []
    every = [*runs, *references]
    table = [cells(run, model, e) for run, e in zip(every, errors, strict=True)]
    keys = [
        k for k in table[0] if all(k in t for t in table) and min(t[k][1] for t in table[: len(runs)]) >= 1.0
    ]
    keys = [k for k in keys if sum(t[k][1] for t in table) >= LEAST_ROWS]
    if not keys:
        return []
    square = np.array([[t[k][0] for k in keys] for t in table])
    count = np.array([[t[k][1] for k in keys] for t in table])
    own = np.arange(len(runs))
    excess = _excess(square, count, own)
    tops = [
        float(_excess(square, count, np.asarray(choice)).max())
        for choice in choices(len(every), len(runs), seed)
    ]
    floor = square[len(runs) :].sum(axis=0) / np.maximum(count[len(runs) :].sum(axis=0), 1e-9)
    over = np.maximum(square[own].sum(axis=0) - floor * count[own].sum(axis=0), 0.0)
    share = over / max(float(over.sum()), 1e-12)
    rms = np.sqrt(square[own].sum(axis=0) / np.maximum(count[own].sum(axis=0), 1e-9))
    found = [
        Cell(
            channel, REGIMES[regime][0], BANDS[band], float(share[i]),
            (1.0 + sum(t >= excess[i] for t in tops)) / (1.0 + len(tops)), float(rms[i]),
        )
        for i, (channel, regime, band) in enumerate(keys)
    ]  # fmt: skip
    return sorted(found, key=lambda c: (c.p_value > 0.05, -c.share, c.channel, c.regime, c.band))


def _excess(square: Array, count: Array, chosen: NDArray[np.int64]) -> Array:
    """Standardised excess (C,) of some runs' mean squares over those of the rest."""
    ratio = np.log(np.maximum(square, 1e-9) + 1.0) - np.log(np.maximum(count, 1e-9) + 1.0)
    rest = np.setdiff1d(np.arange(len(square)), chosen)
    spread = np.sqrt((ratio[rest].var(axis=0) * len(rest) + 0.05) / max(len(rest) - 1, 1))
    return (ratio[chosen].mean(axis=0) - ratio[rest].mean(axis=0)) / spread
