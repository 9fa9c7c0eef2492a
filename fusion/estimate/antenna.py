"""Where the antenna was taken to be, over a drive in which the estimator learned it."""

from __future__ import annotations

import bisect
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs


@dataclass(frozen=True)
class AntennaPlaces:
    """Lever arms (3,) m, body axes, each from its time on; the first holds before, too."""

    since_ns: tuple[int, ...]
    lever_m: tuple[tuple[float, ...], ...]

    @classmethod
    def fixed(cls, lever_m: tuple[float, ...]) -> AntennaPlaces:
        """One place for the whole drive."""
        return cls((0,), (lever_m,))

    def then(self, t_ns: int, lever_m: tuple[float, ...]) -> AntennaPlaces:
        """The same with another place from `t_ns` on."""
        if lever_m == self.lever_m[-1]:
            return self
        known = bisect.bisect_left(self.since_ns, t_ns)
        return AntennaPlaces((*self.since_ns[:known], t_ns), (*self.lever_m[:known], lever_m))

    def at(self, t_ns: TimesNs) -> Array:
        """Lever arms (N, 3) at the times (N,)."""
        row = np.searchsorted(np.array(self.since_ns), t_ns, side="right") - 1
        return np.array(self.lever_m, dtype=float)[np.maximum(row, 0)]
