"""Refits: the most probable effects once more, through the twin itself and not its linearisation.

Gauss-Newton in the scores: the twin is run with the effect, the errors that are left are scored again, and
the coefficients move along the linear information. Bounded by the effect's range; a run that diverges or a
step that does not help ends the fit where it stands, and that is reported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.evidence import Bench
from terrafusion.twin.gap.null import Null
from terrafusion.twin.gap.poses import all_settled
from terrafusion.twin.gap.posterior import Pool
from terrafusion.twin.gap.residuals import Evidence, Raw, carried_back, on_own_ground, whitened_error
from terrafusion.twin.gap.score import Score
from terrafusion.twin.gap.signatures import predictions

Array = NDArray[np.float64]

STEPS = 3
SIZE = 10.0
"""1 sigma of an effect's size in a refit, typical sizes: wide, the data decide."""


@dataclass(frozen=True, eq=False)
class Refit:
    """An effect (or several) fitted to the judged runs.

    Attributes:
        columns: indices of the parameters.
        value, covariance: (k,) and (k, k) in typical sizes.
        trial: (k,) where the next step would go.
        explained: how much of the gap's square it takes away.
        errors: whitened errors of each run at the value.
        failure: what went wrong, in words; "" where nothing did.
    """

    columns: tuple[int, ...]
    value: Array
    trial: Array
    covariance: Array
    explained: float
    errors: list[Array]
    failure: str


def scored(run: Evidence, sigma: Array, error: Array, A: Array) -> Score:
    """The score of another whitened error (n,) of the run."""
    T = run.states
    rows = run.rows[:, :-1].astype(float)
    inner = rows.T @ error
    H = run.gram[:T, :T] + np.diag(sigma**-2.0)
    solved = np.linalg.solve(H, inner[:T])
    b = inner[T:] - run.gram[T:-1, :T] @ solved
    return Score(b, A, float(error @ error - inner[:T] @ solved), len(error))


def effects_at(bench: Bench, columns: Sequence[int], value: Array) -> dict[str, float]:
    """Parameters by key of coefficients in typical sizes, on top of the twin's own, within their ranges."""
    c = bench.candidates
    out = {}
    for i, v in zip(columns, value, strict=True):
        base = bench.model.effects.get(c.keys[i], 0.0)
        out[c.keys[i]] = float(np.clip(base + v * c.scale[i], c.low[i], c.high[i]))
    return out


def refit_all(
    bench: Bench,
    scores: Sequence[Score],
    sigma: Array,
    null: Null,
    pool: Pool,
    chosen: Sequence[Sequence[int]],
) -> list[Refit]:
    """Refits of several sets of columns, side by side."""
    fits = [_linear(bench, pool, tuple(columns)) for columns in chosen]
    active = list(range(len(fits)))
    for _ in range(STEPS):
        if not active:
            break
        sets = [effects_at(bench, fits[i].columns, fits[i].trial) for i in active]
        with ThreadPoolExecutor(bench.jobs) as threads:
            errors = list(threads.map(errors_with, repeat(bench), bench.runs, bench.raws, repeat(sets)))
        still = []
        for n, i in enumerate(active):
            mine = [run[n] for run in errors]
            if any(e is None for e in mine):
                fits[i] = dataclasses.replace(fits[i], failure="the twin diverges with the fitted value")
                continue
            better = _step(bench, scores, sigma, null, pool, fits[i], [e for e in mine if e is not None])
            if better is not None:
                fits[i] = better
                still.append(i)
            elif not fits[i].errors:
                fits[i] = dataclasses.replace(fits[i], failure="the linear fit does not hold in the twin")
        active = still
    return fits


def _linear(bench: Bench, pool: Pool, columns: tuple[int, ...]) -> Refit:
    value, covariance, explained = pool.fit(columns, SIZE)
    value = _bounded(bench, columns, value)
    at = np.asarray(columns)
    explained = float(2.0 * value @ pool.gain[at] - value @ pool.information[np.ix_(at, at)] @ value)
    return Refit(columns, value, value, covariance, explained, [], "")


def _bounded(bench: Bench, columns: Sequence[int], value: Array) -> Array:
    c = bench.candidates
    at = np.asarray(columns)
    base = np.array([bench.model.effects.get(c.keys[i], 0.0) for i in columns])
    return np.clip(value, (c.low[at] - base) / c.scale[at], (c.high[at] - base) / c.scale[at])


def errors_with(
    bench: Bench,
    run: Evidence,
    raw: Raw,
    sets: Sequence[Mapping[str, float]],
    grounds: Sequence[Array] | None = None,
) -> list[Array | None]:
    """Whitened errors of a run against the twin with each set of effects; None where it diverges.

    Args:
        grounds: the run's ground (S,) beside each set, in typical sizes; None: `raw.own`.
    """
    grounds = [raw.own] * len(sets) if grounds is None else grounds
    driven = [on_own_ground(own, bench.drives, some) for own, some in zip(grounds, sets, strict=True)]
    told = predictions(run.log, bench.model, bench.candidates, driven, run.log.start)
    out: list[Array | None] = []
    for own, y in zip(grounds, all_settled(run.log, told), strict=True):
        if y is None:
            out.append(None)
            continue
        error = [o.value - value for o, value in zip(run.log.observed, y, strict=True)]
        out.append(whitened_error(raw, run, bench.noise, carried_back(raw, own, error)))
    return out


def _step(
    bench: Bench,
    scores: Sequence[Score],
    sigma: Array,
    null: Null,
    pool: Pool,
    fit: Refit,
    errors: list[Array],
) -> Refit | None:
    """The fit at its trial value, as the twin has it; None where that explains less than before."""
    at = np.asarray(fit.columns)
    square, gain = 0.0, np.zeros(len(at))
    for run, first, error in zip(bench.runs, scores, errors, strict=True):
        x, U = null.standardised(scored(run, sigma, error, first.A))
        weighted = null.inverse @ x
        square += float(x @ weighted)
        gain += U[:, at].T @ weighted
    explained = pool.square - square
    if fit.errors and explained < fit.explained:
        return None
    if not fit.errors and explained < 0.0:
        return None
    trial = _bounded(bench, fit.columns, fit.trial + fit.covariance @ (gain - fit.trial / SIZE**2))
    return Refit(fit.columns, fit.trial, trial, fit.covariance, explained, errors, "")
