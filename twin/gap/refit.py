"""An effect fitted to the judged runs through the twin itself, and not its linearisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.evidence import Bench
from terrafusion.twin.gap.residuals import Evidence, Raw, carried_back, on_own_ground, whitened_error
from terrafusion.twin.gap.score import Score
from terrafusion.twin.gap.side_by_side import TOGETHER
from terrafusion.twin.gap.signatures import settled_predictions

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Refit:
    """An effect (or several) fitted to the judged runs.

    Attributes:
        columns: indices of the parameters.
        value, covariance: (k,) and (k, k) in typical sizes.
        explained: how much of the gap's square it takes away.
        squares: (P,) of the deviations that it leaves (`Alone.squares`); none where the fit failed.
        errors: whitened errors of each run at the value; none where the fit failed.
        grounds: (S,) of each run beside it, typical sizes from the model's.
        failure: what went wrong, in words; "" where nothing did.
    """

    columns: tuple[int, ...]
    value: Array
    covariance: Array
    explained: float
    errors: list[Array]
    grounds: tuple[Array, ...]
    squares: Array
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


def errors_of(
    bench: Bench,
    runs: Sequence[int],
    sets: Sequence[Mapping[str, float]],
    grounds: Sequence[Sequence[Array]],
) -> list[list[Array | None]]:
    """`errors_with` of several judged runs, by number, each with its own `grounds`, in threads."""
    parts = max(1, min(bench.jobs, len(sets) // (2 * TOGETHER)))  # a run by itself fills no vector
    size = max(1, -(-len(sets) // parts))
    tasks = [(k, slice(i, i + size)) for k in range(len(runs)) for i in range(0, len(sets), size)]

    def one(task: tuple[int, slice]) -> list[Array | None]:
        k, part = task
        return errors_with(bench, bench.runs[runs[k]], bench.raws[runs[k]], sets[part], grounds[k][part])

    out: list[list[Array | None]] = [[] for _ in runs]
    with ThreadPoolExecutor(bench.jobs) as threads:
        for (k, _), errors in zip(tasks, threads.map(one, tasks), strict=True):
            out[k] += errors
    return out


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
    told = settled_predictions(run.log, bench.model, bench.candidates, [some for some, _ in driven])
    out: list[Array | None] = []
    for (_, own), y in zip(driven, told, strict=True):
        if y is None:
            out.append(None)
            continue
        error = [o.value - value for o, value in zip(run.log.observed, y, strict=True)]
        out.append(whitened_error(raw, run, bench.noise, carried_back(raw, own, error)))
    return out
