"""Noise that is louder in places than the references' is on average.

A faster drive shakes the sensors more: on the twin's own runs the variance of a gyro grew by a hundred from a
slow drive to a fast one. Judged by the noise of the references, that would be a gap. How loud a stretch of a
run is shows in the differences of successive white errors, which slow errors hardly change.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.gap.data.samples import Indices, sample_map, with_observed
from terrafusion.twin.gap.rollout.measured_turns import NORMAL_MEDIAN
from terrafusion.twin.gap.rollout.residuals import RunResiduals, WhitenedRun

STRETCH = 32  # samples over which noise is taken to be equally loud (assumed)
LOUD = 3.0  # times the references' variance from which a stretch counts as louder: above its own scatter


def reference_loudness(references: Sequence[WhitenedRun]) -> Array:
    """Mean variance (C,) of the noise by channel, at least the one that white errors have."""
    found: list[list[float]] = [[] for _ in (references[0].log.observed if references else ())]
    for channel, _, variance in (stretch for run in references for stretch in _stretches(run)):
        found[channel].append(variance)
    return np.array([max(1.0, float(np.mean(own))) if own else 1.0 for own in found])


def with_loud_noise(run: RunResiduals, white: WhitenedRun, usual: Array) -> RunResiduals:
    """The run with a larger sigma where its noise is louder than usual (C,), itself if it is nowhere."""
    sigma = [o.sigma.copy() for o in run.log.observed]
    loud = False
    for channel, rows, variance in _stretches(white) if len(usual) else ():
        if variance > LOUD * usual[channel]:
            sigma[channel][rows] *= np.sqrt(variance / usual[channel])
            loud = True
    if not loud:
        return run
    observed = [dataclasses.replace(o, sigma=s) for o, s in zip(run.log.observed, sigma, strict=True)]
    return dataclasses.replace(run, log=with_observed(run.log, observed))


def _stretches(run: WhitenedRun) -> Iterator[tuple[int, Indices, float]]:
    """Channel, rows in it and variance of the noise of each stretch."""
    place, error = 0, run.error
    for channel, _, rows in sample_map(run.log).blocks:
        own = error[place : place + len(rows)]
        place += len(rows)
        parts = max(len(rows) // STRETCH, 1)
        size, longer = divmod(len(rows), parts)  # so many stretches are longer by a sample
        first = longer * (size + 1)
        for n, at in ((size + 1, slice(first)), (size, slice(first, None))):
            if n > 2:
                square = np.median(np.square(np.diff(own[at].reshape(-1, n))), axis=1)
                for some, variance in zip(rows[at].reshape(-1, n), square, strict=True):
                    yield channel, some, 0.5 * float(variance) / NORMAL_MEDIAN
