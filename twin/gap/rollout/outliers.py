"""Clips outliers of the whitened errors (Huber 1964).

In field logs a wheel hits a stone, a fix jumps, a skid starts early: on asphalt every sixth whitened error of
a Warthog exceeds three sigma. Squared, such moments dominate a run, and their scatter from run to run hides
changes in all other samples. Only channels in which the references have such outliers are clipped: where the
noise is normal, a large error is a finding.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.rollout.residuals import (
    OUTLIER_SIGMAS,
    WhitenedRun,
    clip_outliers,
    explained_by_states,
)

HEAVY_TAILED = 0.02
"""A channel is clipped where more than this share (assumed) of the references' errors exceeds the limit."""
CHANGED = 1.5
"""Where the judged runs' usual error exceeds the references' by this factor (assumed), the runs have changed:
their limit is in their own sigmas."""
NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation of normal errors


def limit_outliers(
    runs: Sequence[WhitenedRun], references: Sequence[WhitenedRun], sigma: Array, jobs: int = 1
) -> tuple[list[WhitenedRun], list[WhitenedRun]]:
    """Judged runs and references, their errors within the limits of each channel.

    Args:
        sigma: (T,) first 1 sigma of the states (soil, offsets): what these explain is no outlier.
        jobs: threads.
    """
    channels = range(len(references[0].limit) if references else 0)
    every = (*runs, *references)
    fits, N = in_threads(jobs, lambda run: _fit_states(run, sigma), every), len(runs)

    def errors(some: slice, channel: int) -> Array:
        group = zip(every[some], fits[some], strict=True)
        return np.abs(np.concatenate([error[run.channel == channel] for run, (_, error) in group]))

    judged, normal = ([errors(some, i) for i in channels] for some in (slice(N), slice(N, None)))
    own, usual = (NORMAL_MAD * np.array([np.median(e) for e in some]) for some in (judged, normal))
    usual = np.maximum(usual, 1.0)  # where the twin is wrong, references err by more than their noise
    limit = OUTLIER_SIGMAS * usual
    heavy = [float(np.mean(e > most)) > HEAVY_TAILED for e, most in zip(normal, limit, strict=True)]
    limit[~np.array(heavy, dtype=bool)] = np.inf
    changed = np.where(own > CHANGED * usual, own / usual, 1.0) * limit
    clipped = [
        _clipped(run, gain, changed if i < N else limit)
        for i, (run, (gain, _)) in enumerate(zip(every, fits, strict=True))
    ]
    return clipped[:N], clipped[N:]


def _fit_states(run: WhitenedRun, sigma: Array) -> tuple[Array, Array]:
    """Gain (T, n) of the states, and the error (n,) that they do not explain."""
    J, e = run.by_state, run.error
    gain: Array = np.asarray(np.linalg.solve(run.state_information(sigma), J.T))
    return gain, e - explained_by_states(J, gain, e)


def _clipped(run: WhitenedRun, gain: Array, limit: Array) -> WhitenedRun:
    if not np.isfinite(limit).any():
        return run
    out, rows = dataclasses.replace(run, state_gain=gain, limit=limit), run.rows.astype(float)
    rows[:, -1] = clip_outliers(out, rows[:, -1])
    gram = run.gram.copy()
    gram[:, -1] = gram[-1, :] = rows.T @ rows[:, -1]
    return dataclasses.replace(out, gram=gram, rows=rows.astype(np.float32))
