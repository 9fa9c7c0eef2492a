"""Which samples of the twin's run each row of a log is made of, and which rows belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.predict import averaging

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

EVERY = 5
"""Derivatives are kept at every so many-th sample of the run: they enter as weights only."""


@dataclass(frozen=True, eq=False)
class Layout:
    """What follows from the stamps of a log; lists hold one entry a channel.

    Attributes:
        blocks: channel, window and rows of each stretch of a channel within one window, in all rows' order.
        alike: stretches of a channel whose rows are as far apart: channel, rows (g, m) of each, and where
            they are (g, m) among all rows.
        fine, coarse: samples (n, k) of the run, or of its `EVERY`-th ones, that make a row, with weights.
    """

    blocks: list[tuple[int, int, Rows]]
    alike: list[tuple[int, Rows, Rows]]
    fine: list[tuple[Rows, Array]]
    coarse: list[tuple[Rows, Array]]


_KNOWN: WeakKeyDictionary[PreparedLog, Layout] = WeakKeyDictionary()


def layout(log: PreparedLog) -> Layout:
    """The layout of a log, found once."""
    known = _KNOWN.get(log)
    if known is None:
        shift = np.cumsum(np.append(0, np.diff(log.windows, axis=1).ravel() + 1))
        fine = [weighty(*averaging(o, log, shift)) for o in log.observed]
        blocks = _blocks(log)
        coarse = [_coarse(o, log) for o in log.observed]
        known = _KNOWN[log] = Layout(blocks, _alike(log, blocks), fine, coarse)
    return known


def samples_of(log: PreparedLog, every: int) -> Rows:
    """Grid samples of all windows, one after the other; a border belongs to both."""
    return np.concatenate([np.arange(first, last + 1, every) for first, last in log.windows])


def among_all(log: PreparedLog) -> Rows:
    """Which of all samples of the windows are the `EVERY`-th ones."""
    counts = np.diff(log.windows, axis=1).ravel() + 1
    begins = np.cumsum(counts) - counts
    return np.concatenate([b + np.arange(0, n, EVERY) for b, n in zip(begins, counts, strict=True)])


def coarse_counts(log: PreparedLog) -> Rows:
    """Number (W,) of `EVERY`-th samples of each window."""
    return np.diff(log.windows, axis=1).ravel() // EVERY + 1


def means(of: tuple[Rows, Array], values: Array) -> Array:
    """Weighted means (n, ...) of values (N, ...) at the samples."""
    at, weight = of
    lead = (-1,) + (1,) * (values.ndim - 1)
    out = weight[:, 0].reshape(lead) * values[at[:, 0]]
    for k in range(1, at.shape[1]):
        out += weight[:, k].reshape(lead) * values[at[:, k]]
    return np.asarray(out)


def weighty(at: Rows, weight: Array) -> tuple[Rows, Array]:
    """The same samples without those of weight zero, as far as every row has some."""
    order = np.argsort(weight == 0.0, axis=1, kind="stable")
    order = order[:, : max(1, int((weight != 0.0).sum(axis=1).max(initial=1)))]
    return np.take_along_axis(at, order, axis=1), np.take_along_axis(weight, order, axis=1)


def _blocks(log: PreparedLog) -> list[tuple[int, int, Rows]]:
    out = []
    for i, observed in enumerate(log.observed):
        of = window_of(observed, log.windows)
        out += [(i, int(k), np.flatnonzero(of == k)) for k in np.unique(of)]
    return out


def _alike(log: PreparedLog, blocks: Sequence[tuple[int, int, Rows]]) -> list[tuple[int, Rows, Rows]]:
    found: dict[tuple[int, bytes], list[Rows]] = {}
    place = 0
    for i, _, rows in blocks:
        steps = np.diff(log.observed[i].slot[rows])
        found.setdefault((i, steps.tobytes()), []).append(np.stack([rows, place + np.arange(len(rows))]))
        place += len(rows)
    return [(i, *np.stack(some, axis=1)) for (i, _), some in found.items()]


def _coarse(observed: Observed, log: PreparedLog) -> tuple[Rows, Array]:
    """Coarse samples (n, 6) that a row depends on and their weights: a mean of three linear
    interpolations."""
    step, counts = EVERY * DT_S, coarse_counts(log)
    offset = np.cumsum(counts) - counts
    k = np.clip(window_of(observed, log.windows), 0, len(log.windows) - 1)
    ats, weights = [], []
    for share, weight in ((0.0, 1.0 / 6.0), (0.5, 2.0 / 3.0), (1.0, 1.0 / 6.0)):  # Simpson's rule
        t_s = observed.begin_s + share * (observed.end_s - observed.begin_s)
        place = np.clip((t_s - log.windows[k, 0] * DT_S) / step, 0.0, counts[k] - 1.0)
        low = np.minimum(place.astype(np.int64), np.maximum(counts[k] - 2, 0))
        ats += [offset[k] + low, offset[k] + np.minimum(low + 1, counts[k] - 1)]
        weights += [weight * (1.0 - (place - low)), weight * (place - low)]
    return np.stack(ats, axis=1), np.stack(weights, axis=1)
