"""Slip and side-slip over stretches of several metres, wheels against the estimate under good fixes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.fusion.estimate.estimate import State

LEAST_M, SIGMAS, MOST_M, MOST_S = 4.0, 20.0, 40.0, 60.0
"""A stretch ends after 4 m and twenty sigma of the position, at most 40 m; one of 60 s is dropped."""
MOST_SLIP = 1.0


@dataclass(frozen=True)
class SlipStretch:
    """Slip, side-slip (lateral over forward distance) and their 1 sigma."""

    slip: float
    side: float
    sigma: float


class StretchMeter:
    """Sums motion of wheels and estimate; `add` gives a stretch when it is long enough."""

    def __init__(self) -> None:
        self._before: State | None = None
        self._begin()

    def _begin(self) -> None:
        self._seconds = self._rolled_m = self._path_m = self._along_m = self._across_m = 0.0

    def restart(self) -> None:
        """The motion was interrupted, or fixes are missing."""
        self._before = None
        self._begin()

    def add(self, state: State, rolled_m: float) -> SlipStretch | None:
        """The motion up to `state`, in which the wheels rolled `rolled_m`."""
        before, self._before = self._before, state
        if before is None or not math.isfinite(rolled_m):
            self._begin()
            return None
        turned = quaternion_to_matrix(before.quaternion) + quaternion_to_matrix(state.quaternion)
        moved = state.position_m - before.position_m
        forward, left = turned[:, 0], turned[:, 1]
        self._along_m += float(moved @ forward) / math.sqrt(float(forward @ forward))
        self._across_m += float(moved @ left) / math.sqrt(float(left @ left))
        self._rolled_m += rolled_m
        self._path_m += abs(rolled_m)
        self._seconds += (state.t_ns - before.t_ns) * 1e-9
        sigma_m = math.sqrt(0.5 * float(state.covariance[0, 0] + state.covariance[1, 1]))
        if abs(self._rolled_m) < min(max(LEAST_M, SIGMAS * sigma_m), MOST_M):
            if self._seconds > MOST_S:
                self._begin()
            return None
        slip, side = 1.0 - self._along_m / self._rolled_m, self._across_m / self._path_m
        sigma = math.sqrt(2.0) * sigma_m / abs(self._rolled_m)
        self._begin()
        if abs(slip) > MOST_SLIP or abs(side) > MOST_SLIP:
            return None
        return SlipStretch(slip, side, sigma)
