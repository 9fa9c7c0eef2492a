"""Where the antenna was taken to be over a drive in which the estimator learned it; lateness of its fixes."""

import bisect
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs

MOST = 1000
"""Places that are held: over an hour of learning. Of more, those that lasted shortest are dropped."""


@dataclass(frozen=True)
class AntennaPlaces:
    """Lever arms (3,) m, body axes, and lateness of the fixes' stamps, ns, each from its time on; the first
    holds before, too.
    """

    since_ns: tuple[int, ...]
    lever_m: tuple[tuple[float, ...], ...]
    late_ns: tuple[int, ...] = (0,)

    @classmethod
    def fixed(cls, lever_m: tuple[float, ...]) -> "AntennaPlaces":
        """One place for the whole drive."""
        return cls((0,), (lever_m,))

    def then(self, t_ns: int, lever_m: tuple[float, ...], late_ns: int = 0) -> "AntennaPlaces":
        """The same with another place and lateness from `t_ns` on."""
        if lever_m == self.lever_m[-1] and late_ns == self.late_ns[-1]:
            return self
        n = bisect.bisect_left(self.since_ns, t_ns)
        held = list(range(n))
        if n >= MOST:
            gaps_ns = [self.since_ns[i + 1] - self.since_ns[i - 1] for i in held[1:-1]]
            del held[1 + gaps_ns.index(min(gaps_ns))]
        since_ns = *(self.since_ns[i] for i in held), t_ns
        levers_m = *(self.lever_m[i] for i in held), lever_m
        return AntennaPlaces(since_ns, levers_m, (*(self.late_ns[i] for i in held), late_ns))

    def at(self, t_ns: TimesNs) -> Array:
        """Lever arms (N, 3) at the times (N,)."""
        return np.array(self.lever_m, dtype=float)[self._rows(t_ns)]

    def used(self, t_ns: TimesNs) -> tuple[Array, Array]:
        """Lever arms (N, 3), m, and delays (N,), s, in use at the times (N,)."""
        return self.at(t_ns), np.array(self.late_ns)[self._rows(t_ns)] * 1e-9

    def measured_ns(self, stamp_ns: TimesNs) -> TimesNs:
        """When fixes with the stamps (N,) were measured."""
        return stamp_ns - np.array(self.late_ns, dtype=np.int64)[self._rows(stamp_ns)]

    def later_shift(self, t_ns: TimesNs) -> tuple[Array, Array]:
        """How far the levers (N, 3), m, and delays (N,), s, at the times (N,) are from the newest ones."""
        late_ns = np.array(self.late_ns, dtype=np.int64)
        return self.at(t_ns) - np.array(self.lever_m[-1]), (late_ns[self._rows(t_ns)] - late_ns[-1]) * 1e-9

    def _rows(self, t_ns: TimesNs) -> NDArray[np.int64]:
        found = np.searchsorted(np.array(self.since_ns), t_ns, side="right")
        return np.maximum(found.astype(np.int64) - 1, 0)
