"""Errors beyond what noise makes of them count as much as its limit, and no more (Huber 1964).

In the field a wheel hits a stone, a fix jumps, a skid starts a moment early: of a Warthog on asphalt every
sixth whitened error is beyond three sigma. Squared, such moments decide what a run says; their scatter from
run to run then hides changes that all other rows show. Only channels are bounded in which the references
themselves have such moments: where noise is normal, a large error is news.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.rollout.residuals import (
    OUTLIER_SIGMAS,
    ROBUST_STEPS,
    Evidence,
    explained,
    within_limits,
)

Array = NDArray[np.float64]

HEAVY = 0.02
"""A channel is bounded where more than this share of the references' errors is beyond the limit."""
STRONG = 1.5
"""Where half of the judged runs' errors exceed by this factor what noise makes of them, the runs themselves
have changed: their limit is in their own sigmas."""
NORMAL = 1.4826
"""Standard deviation over median absolute deviation of normal errors."""


def bounded(
    runs: Sequence[Evidence], references: Sequence[Evidence], sigma: Array, jobs: int = 1
) -> tuple[list[Evidence], list[Evidence]]:
    """Judged runs and references, their errors within the limits of each channel.

    Args:
        sigma: (T,) first 1 sigma of the states (ground, offsets): what these explain is no outlier.
        jobs: threads.
    """
    channels = range(len(references[0].limit) if references else 0)
    every = (*runs, *references)
    with ThreadPoolExecutor(jobs) as pool:
        adapted = pool.map(lambda run: _adapted(run, sigma), every)
        left = dict(zip(map(id, every), adapted, strict=True))

    def errors(group: Sequence[Evidence], channel: int) -> Array:
        parts = [left[id(run)][1][run.channel == channel] for run in group]
        return np.abs(np.concatenate(parts))

    heavy = [float(np.mean(errors(references, i) > OUTLIER_SIGMAS)) > HEAVY for i in channels]
    own = [NORMAL * float(np.median(errors(runs, i))) for i in channels]
    normal = np.where(heavy, OUTLIER_SIGMAS, np.inf)
    changed = np.where(np.array(own) > STRONG, own, 1.0) * normal
    return (
        [_bounded(run, left[id(run)][0], changed) for run in runs],
        [_bounded(run, left[id(run)][0], normal) for run in references],
    )


def _adapted(run: Evidence, sigma: Array) -> tuple[Array, Array]:
    """Gain (T, n) of the states, and what they leave (n,) of the error."""
    J, e = run.rows[:, : run.states].astype(float), run.rows[:, -1].astype(float)
    gain = np.linalg.solve(run.gram[: run.states, : run.states] + np.diag(sigma**-2.0), J.T)
    return gain, e - explained(J, gain, e, OUTLIER_SIGMAS, ROBUST_STEPS)


def _bounded(run: Evidence, gain: Array, limit: Array) -> Evidence:
    if not np.isfinite(limit).any():
        return run
    out, rows = dataclasses.replace(run, gain=gain, limit=limit), run.rows.astype(float)
    rows[:, -1] = within_limits(out, rows[:, -1])
    gram = run.gram.copy()
    gram[:, -1] = gram[-1, :] = rows.T @ rows[:, -1]
    return dataclasses.replace(out, gram=gram, rows=rows.astype(np.float32))
