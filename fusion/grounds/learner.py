"""Ground memory beside a drive: recognises grounds, and learns them while fixes are good.

A ground is learned by slip and side-slip over stretches of several metres, wheels against the estimate.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import quaternion_to_matrix
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.grounds.ground import MOST_SLIP, SLIPPERY_MODELS
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.grounds.signature import SignatureExtractor
from terrafusion.fusion.terrain.features import Window

SURE = 0.5
"""Least share of the windows of a stretch that one ground must have for the stretch to count for it."""
USABLE = 0.1
"""Most uncertain slip of a stretch that is used."""
CLOCKED_NS = 946_684_800_000_000_000
"""Stamps before the year 2000 are no dates."""
LEAST_M, SIGMAS, MOST_M, MOST_S = 4.0, 20.0, 40.0, 60.0
"""A stretch ends after 4 m and twenty sigma of the position, at most 40 m; one of 60 s is dropped."""


class FrictionBank(Protocol):
    """Friction limits scored by fixes; see `estimator.friction`."""

    @property
    def leads(self) -> bool:
        """Whether friction, and not the wheels, predicts the motion."""

    def probabilities(self) -> Array:
        """Probabilities (10,) of the limits and, last, of rolling, by the fixes of this drive."""


class GroundLearner:
    """Feeds a `GroundMemory` twice a second.

    Attributes:
        memory: the grounds, and the belief which one the robot is on.
    """

    def __init__(self, memory: GroundMemory | None = None) -> None:
        self.memory = GroundMemory() if memory is None else memory.copy()
        self._extractor, self._meter = SignatureExtractor(), StretchMeter()
        self._passed: list[int] = []  # most probable ground of each window of the stretch

    def update(
        self, window: Window, state: State, rolled_m: float, friction: FrictionBank | None
    ) -> int | None:
        """One window that ends at `state`, in which the wheels rolled `rolled_m` since the last one.

        Returns:
            place of a ground in the memory that a new one has taken.
        """
        replaced, memory, good = None, self.memory, state.status == "running"
        known = friction.probabilities() if friction is not None and good else None
        slide = math.nan if known is None else float(known[:SLIPPERY_MODELS].sum())
        signature = self._extractor.extract(window, slide)
        if np.isfinite(signature).any():
            memory.recognise(signature, window.ground_speed_mps() * max(window.dt_s, 0.0))
            if good:
                replaced = memory.learn(_date(state.t_ns), known)
        if not good or (friction is not None and friction.leads):  # skidding wheels measure no slip
            self._meter.restart()
            self._passed.clear()
            return replaced
        self._passed.append(int(memory.belief.argmax()))
        stretch = self._meter.add(state, rolled_m)
        if stretch is not None:
            self._learn_stretch(stretch)
            self._passed.clear()
        return replaced

    def _learn_stretch(self, stretch: SlipStretch) -> None:
        best, windows = Counter(self._passed).most_common(1)[0]
        share = windows / len(self._passed)
        if best == 0 or share < SURE or stretch.sigma > USABLE:
            return
        ground, entry = self.memory.grounds[best - 1], np.array([stretch.slip, stretch.side])
        self.memory.grounds[best - 1] = dataclasses.replace(
            ground, motion=ground.motion.plus(entry, share, stretch.sigma**2)
        )


def _date(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns * 1e-9, UTC).strftime("%Y-%m-%d") if t_ns > CLOCKED_NS else ""


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
