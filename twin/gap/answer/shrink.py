"""How far the gap shrinks on runs the effect was not fitted on.

Each judged run is left out in turn, the effect fitted on the others, the twin run with it on the one left
out, and theta and poses adapted anew in both arms. One run alone is scored on itself, without an interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.infer.evidence import Bench
from terrafusion.twin.gap.infer.posterior import Pool
from terrafusion.twin.gap.infer.refit import Refit, Tried, effects_at, errors_of
from terrafusion.twin.gap.null.null import Null
from terrafusion.twin.gap.null.score import Score
from terrafusion.twin.gap.rollout.nuisance import NAMES
from terrafusion.twin.gap.rollout.residuals import Evidence

Array = NDArray[np.float64]

METRIC = "mean squared whitened error with soil, offsets and pose adapted, on runs left out of the fit"
ABOVE_FLOOR = 3.0
"""A share is told when the gap stands so many standard deviations of the floor above it."""
FREE = 10.0
"""Theta is set this much freer where it alone is recalibrated."""


@dataclass(frozen=True, eq=False)
class Shrink:
    """The gap before and after, see the answer's contract; arrays hold one entry a run."""

    before: float
    after: float
    floor: float | None
    share: float | None
    interval: tuple[float, float] | None
    recalibrated: float
    channels: dict[str, tuple[float, float, float | None]]
    left: list[Array]
    was: list[Array]


def adapted(run: Evidence, sigma: Array, error: Array) -> Array:
    """The error (n,) after the best theta of its prior is taken out."""
    T = run.states
    J = run.rows[:, :T].astype(float)
    return error - J @ np.linalg.solve(run.gram[:T, :T] + np.diag(sigma**-2.0), J.T @ error)


def own_error(run: Evidence, null: Null) -> Array:
    """The run's whitened error (n,) less what all references have in common."""
    return run.rows[:, -1].astype(float) - run.rows[:, run.states : -1].astype(float) @ null.offset


def shrink(bench: Bench, scores: Sequence[Score], sigma: Array, null: Null, fit: Refit | None) -> Shrink:
    """Shrink by a fitted effect; without one, nothing shrinks."""
    was = [own_error(run, null) for run in bench.runs]
    now = _left_out(bench, scores, null, fit, was)
    before = [_square(adapted(r, sigma, e)) for r, e in zip(bench.runs, was, strict=True)]
    after = [_square(adapted(r, sigma, e)) for r, e in zip(bench.runs, now, strict=True)]
    free = [_square(adapted(r, FREE * sigma, e)) for r, e in zip(bench.runs, was, strict=True)]
    floors = [_square(adapted(r, sigma, own_error(r, null))) for r in bench.references]
    floor = float(np.mean(floors)) if floors else None
    spread = float(np.std(floors, ddof=1)) if len(floors) > 1 else None
    share, interval = _share(np.array(before), np.array(after), floor, spread)
    return Shrink(
        float(np.mean(before)), float(np.mean(after)), floor, share, interval, float(np.mean(free)),
        _by_channel(bench, sigma, null, was, now), now, was,
    )  # fmt: skip


def _square(error: Array) -> float:
    return float(error @ error) / max(len(error), 1)


def _left_out(
    bench: Bench, scores: Sequence[Score], null: Null, fit: Refit | None, was: list[Array]
) -> list[Array]:
    """Errors of each run with the effect as the other runs have it."""
    if fit is None:
        return was
    whole, _, _ = Pool.of(scores, null).fit(fit.columns)

    tried = []
    for i in range(len(bench.runs)):
        others = [s for k, s in enumerate(scores) if k != i] or list(scores)
        value, _, _ = Pool.of(others, null).fit(fit.columns)
        value = fit.value + (value - whole)  # the linear change on top of what the twin itself was fitted to
        ground = fit.grounds[i] if fit.grounds else None
        tried.append(Tried(i, effects_at(bench, fit.columns, value), ground))
    out = []
    for run, error, as_it_was in zip(bench.runs, errors_of(bench, tried), was, strict=True):
        common = run.rows[:, run.states : -1].astype(float) @ null.offset
        out.append(as_it_was if error is None else error - common)
    return out


def _share(
    before: Array, after: Array, floor: float | None, spread: float | None
) -> tuple[float | None, tuple[float, float] | None]:
    if (
        floor is None
        or spread is None
        or before.mean() - floor <= ABOVE_FLOOR * spread / np.sqrt(len(before))
    ):
        return None, None
    share = float((before.mean() - after.mean()) / (before.mean() - floor))
    if len(before) < 2:
        return share, None
    from scipy.special import stdtrit

    each = (before - after) / (before.mean() - floor)
    half = float(stdtrit(len(each) - 1, 0.975) * each.std(ddof=1) / np.sqrt(len(each)))
    return share, (share - half, share + half)


def _by_channel(
    bench: Bench, sigma: Array, null: Null, was: list[Array], now: list[Array]
) -> dict[str, tuple[float, float, float | None]]:
    """Root-mean-square whitened error of each channel: before, after, and in the references."""
    arms = [[adapted(r, sigma, e) for r, e in zip(bench.runs, errors, strict=True)] for errors in (was, now)]
    still = [adapted(r, sigma, own_error(r, null)) for r in bench.references]
    out = {}
    for name in dict.fromkeys(NAMES[c] for c in bench.channels):
        mine = [i for i, c in enumerate(bench.channels) if NAMES[c] == name]

        def rms(runs: Sequence[Evidence], errors: Sequence[Array], mine: list[int] = mine) -> float | None:
            parts = [e[np.isin(r.channel, mine)] for r, e in zip(runs, errors, strict=True)]
            joined = np.concatenate(parts) if parts else np.zeros(0)
            return float(np.sqrt(np.mean(joined**2))) if len(joined) else None

        first, second = rms(bench.runs, arms[0]), rms(bench.runs, arms[1])
        out[name] = (first or 0.0, second or 0.0, rms(bench.references, still))
    return out
