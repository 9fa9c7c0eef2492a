"""Where the gap shows: cells of channel, regime and band in which the judged runs err more than the
references.

A cell's share is its part of the excess of squared errors. Its p-value holds for all cells together: the
greatest standardised excess over all cells, of other choices of runs (max-T, Westfall and Young 1993).
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.answer.shrinkage import own_error, without_states
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES, commanded_acceleration, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, physical_error

REGIMES = (
    ("standing", lambda v, r, a: np.abs(v) + 0.3 * np.abs(r) < 0.02),
    ("speeding up or braking", lambda v, r, a: np.abs(a) > 0.2),
    ("turning, slow", lambda v, r, a: (np.abs(r) > 0.1) & (np.abs(v) <= 0.7)),
    ("turning, fast", lambda v, r, a: (np.abs(r) > 0.1) & (np.abs(v) > 0.7)),
    ("straight, slow", lambda v, r, a: (np.abs(r) <= 0.1) & (np.abs(v) <= 0.7)),
    ("straight, fast", lambda v, r, a: (np.abs(r) <= 0.1) & (np.abs(v) > 0.7)),
)
"""Name and condition on commanded speed (m/s), turn rate (rad/s) and acceleration (m/s2); the first that
holds."""
BANDS = ("below 0.5 Hz", "above 0.5 Hz")
SLOW_S = 2.0  # means over this interval are the slow band
LEAST_SAMPLES = 5
PERMUTATIONS = 99  # most other choices of runs that the judged ones are compared with
LEAST_REFERENCES = 2  # fewer have no scatter from run to run


@dataclass(frozen=True)
class GapCell:
    """One cell of the gap map.

    Attributes:
        channel, regime, band: its place.
        share: of the excess of squared errors over the references'.
        p_value: of that excess, for all cells together.
        error, reference: root mean square of the judged runs' errors and of the references', in the channel's
            unit (`CHANNEL_UNITS`).
        sigmas: the same of the judged runs, in sigmas of the noise.
    """

    channel: str
    regime: str
    band: str
    share: float
    p_value: float
    error: float
    reference: float
    sigmas: float


def regimes(run: WhitenedRun, model: Model) -> NDArray[np.int64]:
    """Index (n,) of the regime of each sample."""
    t_s, twist = commanded_twist(run.log, model)
    columns = (twist[:, 0], twist[:, 1], commanded_acceleration(twist[:, 0]))
    v, r, a = (np.interp(run.time_s, t_s, column) for column in columns)
    out = np.full(len(run.time_s), len(REGIMES) - 1)
    for i in reversed(range(len(REGIMES))):
        out[np.asarray(REGIMES[i][1](v, r, a))] = i
    return out


def cells(run: WhitenedRun, model: Model, errors: Array) -> dict[tuple[str, int, int], Array]:
    """Sum of squares, effective and whole count (3,) of each cell of a run (channel, regime, band)."""
    regime, out = regimes(run, model), dict[tuple[str, int, int], Array]()
    for i, observed in enumerate(run.log.observed):
        name = CHANNEL_NAMES[observed.channel]
        rows = np.flatnonzero(run.channel == i)
        rows = rows[np.argsort(run.time_s[rows], kind="stable")]
        e = errors[rows]
        interval = np.floor(run.time_s[rows] / SLOW_S).astype(np.int64)
        key = regime[rows] + len(REGIMES) * (interval - interval.min())
        _, group, count = np.unique(key, return_inverse=True, return_counts=True)
        mean = np.bincount(group, e) / count
        for band, values in enumerate((np.sqrt(count)[group] * mean[group], e - mean[group])):
            weight = 1.0 / count[group] if band == 0 else 1.0 - 1.0 / count[group]
            square = values**2 * (1.0 / count[group] if band == 0 else 1.0)
            for k in range(len(REGIMES)):
                mine = regime[rows] == k
                more = np.array([square[mine].sum(), weight[mine].sum(), mine.sum()])
                out[name, k, band] = out.get((name, k, band), np.zeros(3)) + more
    return out


def gap_map(evidence: GapEvidence, sigma: Array, robot: RobotOffsets, seed: int) -> list[GapCell]:
    """All cells with enough samples, most important first; none with fewer than `LEAST_REFERENCES`."""
    runs, R = [*evidence.runs, *evidence.references], len(evidence.runs)
    if len(evidence.references) < LEAST_REFERENCES:
        return []
    errors = [without_states(run, sigma, own_error(run, robot)) for run in runs]
    by_run = [cells(run, evidence.model, e) for run, e in zip(runs, errors, strict=True)]
    keys = [
        key for key in by_run[0]
        if all(key in found for found in by_run) and min(found[key][1] for found in by_run[:R]) >= 1.0
        and sum(found[key][1] for found in by_run) >= LEAST_SAMPLES
    ]  # fmt: skip
    if not keys:
        return []
    square, count, _ = np.array([[found[key] for key in keys] for found in by_run]).transpose(2, 0, 1)
    excess = _excess(square, count, np.arange(R))
    tops = [
        float(_excess(square, count, np.asarray(choice)).max()) for choice in permutations(len(runs), R, seed)
    ]
    own, size = square[:R].sum(axis=0), count[:R].sum(axis=0)
    floor = square[R:].sum(axis=0) / np.maximum(count[R:].sum(axis=0), 1e-9)
    over = np.maximum(own - floor * size, 0.0)
    share, sigmas = over / max(float(over.sum()), 1e-12), np.sqrt(own / np.maximum(size, 1e-9))
    physical = [physical_error(run, evidence.noise, e) for run, e in zip(runs, errors, strict=True)]
    by_run = [cells(run, evidence.model, e) for run, e in zip(runs, physical, strict=True)]
    sums = np.array([[found[key] for key in keys] for found in by_run])
    judged, normal = (
        np.sqrt(some[:, :, 0].sum(axis=0) / np.maximum(some[:, :, 2].sum(axis=0), 1.0))
        for some in (sums[:R], sums[R:])
    )
    found = [
        GapCell(
            channel, REGIMES[regime][0], BANDS[band], float(share[i]),
            (1.0 + sum(t >= excess[i] for t in tops)) / (1.0 + len(tops)),
            float(judged[i]), float(normal[i]), float(sigmas[i]),
        )
        for i, (channel, regime, band) in enumerate(keys)
    ]  # fmt: skip
    return sorted(found, key=lambda c: (c.p_value > 0.05, -c.share, c.channel, c.regime, c.band))


def permutations(total: int, size: int, seed: int) -> list[tuple[int, ...]]:
    """Choices of `size` out of `total` runs other than the first ones, at most `PERMUTATIONS`."""
    own = tuple(range(size))
    if math.comb(total, size) <= PERMUTATIONS + 1:
        return [c for c in itertools.combinations(range(total), size) if c != own]
    rng, found = np.random.default_rng(seed), dict[tuple[int, ...], None]()
    while len(found) < PERMUTATIONS:
        some = tuple(sorted(int(i) for i in rng.choice(total, size, replace=False)))
        if some != own:
            found[some] = None
    return list(found)


def _excess(square: Array, count: Array, chosen: NDArray[np.int64]) -> Array:
    """Standardised excess (C,) of some runs' mean squares over those of the rest."""
    ratio = np.log(np.maximum(square, 1e-9) + 1.0) - np.log(np.maximum(count, 1e-9) + 1.0)
    rest = np.setdiff1d(np.arange(len(square)), chosen)
    spread = np.sqrt((ratio[rest].var(axis=0) * len(rest) + 0.05) / max(len(rest) - 1, 1))
    return (ratio[chosen].mean(axis=0) - ratio[rest].mean(axis=0)) / spread
