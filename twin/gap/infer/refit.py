"""An effect fitted to the judged runs through the twin itself, and not its linearisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.infer.evidence import Bench
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.residuals import Evidence, carried_back, on_own_ground, whitened_error
from terrafusion.twin.gap.rollout.sensitivities import Ask, settled_predictions

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


@dataclass(frozen=True, eq=False)
class Tried:
    """Effects in the twin beside a judged run, by number, on its own ground (S,), in typical sizes; None: the
    ground that it had without them."""

    run: int
    effects: Mapping[str, float]
    ground: Array | None = None


def errors_of(bench: Bench, tried: Sequence[Tried]) -> list[Array | None]:
    """Whitened errors of the judged runs against the twin with these effects; None where it diverges."""
    grounds = [bench.raws[t.run].own if t.ground is None else t.ground for t in tried]
    driven = [on_own_ground(g, bench.drives, t.effects) for t, g in zip(tried, grounds, strict=True)]
    asks = [Ask(bench.runs[t.run].log, some) for t, (some, _) in zip(tried, driven, strict=True)]
    told = settled_predictions(asks, bench.model, bench.candidates, bench.jobs)

    def whitened(i: int) -> Array | None:
        y, k = told[i], tried[i].run
        if y is None:
            return None
        run, raw = bench.runs[k], bench.raws[k]
        error = [o.value - value for o, value in zip(run.log.observed, y, strict=True)]
        return whitened_error(raw, run, bench.noise, carried_back(raw, driven[i][1], error))

    with ThreadPoolExecutor(bench.jobs) as threads:
        return list(threads.map(whitened, range(len(tried))))
