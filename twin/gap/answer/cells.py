"""Cells of the gap map: channels by regimes of the commands by bands of frequency."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.samples import Indices
from terrafusion.twin.gap.rollout.nuisance import CHANNEL_NAMES, commanded_acceleration, commanded_twist
from terrafusion.twin.gap.rollout.residuals import WhitenedRun

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


@dataclass(frozen=True, eq=False)
class RunCells:
    """Samples of a run by cell; the K cells are channels by regimes by bands, flattened.

    Attributes:
        order: (n,) samples by channel, regime and interval of `SLOW_S`.
        first, size, place: (G,) first sample of each such interval, number of them, and channel and regime as
            one number.
        count, samples: (K,) effective and whole number of samples of each cell.
    """

    order: Indices
    first: Indices
    size: Indices
    place: Indices
    count: Array
    samples: Array

    @classmethod
    def of(cls, run: WhitenedRun, model: Model, names: Sequence[str]) -> Self:
        """Of a run, among the channels of these names."""
        channel = np.array([names.index(CHANNEL_NAMES[o.channel]) for o in run.log.observed])
        place = channel[run.channel] * len(REGIMES) + regimes(run, model)
        interval = np.floor(run.time_s / SLOW_S).astype(np.int64)
        keys = np.stack([run.channel, place, interval])
        order = np.lexsort(keys[::-1])
        starts = np.append(True, np.diff(keys[:, order], axis=1).any(axis=0))
        first = np.flatnonzero(starts)
        size, of_interval = np.diff(np.append(first, len(order))), place[order][first]
        total, one = len(names) * len(REGIMES), np.ones(len(size))
        intervals, samples = (np.bincount(of_interval, weight, total) for weight in (one, size))
        count = np.stack([intervals, samples - intervals], axis=1).ravel()
        return cls(order, first, size, of_interval, count, np.repeat(samples, len(BANDS)))

    def squares(self, errors: Array) -> Array:
        """Sums of squares (K, N) of errors (n, N): of the means of all intervals, and about them."""
        errors = errors[self.order]
        slow = np.add.reduceat(errors, self.first) ** 2 / self.size[:, None]
        fast = np.add.reduceat(errors**2, self.first) - slow
        out = np.zeros((len(self.count) // len(BANDS), len(BANDS), errors.shape[1]))
        np.add.at(out, self.place, np.stack([slow, fast], axis=1))
        return out.reshape(len(self.count), -1)


def regimes(run: WhitenedRun, model: Model) -> Indices:
    """Index (n,) of the regime of each sample."""
    t_s, twist = commanded_twist(run.log, model)
    columns = (twist[:, 0], twist[:, 1], commanded_acceleration(twist[:, 0]))
    v, r, a = (np.interp(run.time_s, t_s, column) for column in columns)
    out = np.full(len(run.time_s), len(REGIMES) - 1)
    for i in reversed(range(len(REGIMES))):
        out[np.asarray(REGIMES[i][1](v, r, a))] = i
    return out
