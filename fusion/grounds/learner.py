"""Ground memory beside a drive: recognises grounds, and learns them while fixes are good."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from datetime import UTC, datetime
from typing import Protocol

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.grounds.ground import SLIPPERY_MODELS
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.grounds.signature import SignatureExtractor
from terrafusion.fusion.grounds.stretches import SlipStretch, StretchMeter
from terrafusion.fusion.terrain.features import Window

SURE = 0.5
"""Least share of the windows of a stretch that one ground must have for the stretch to count for it."""
USABLE = 0.1
"""Most uncertain slip of a stretch that is used."""
CLOCKED_NS = 946_684_800_000_000_000
"""Stamps before the year 2000 are no dates."""


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

    def update(self, window: Window, state: State, rolled_m: float, friction: FrictionBank | None) -> None:
        """One window that ends at `state`, in which the wheels rolled `rolled_m` since the last one."""
        memory, good = self.memory, state.status == "running"
        known = friction.probabilities() if friction is not None and good else None
        slide = math.nan if known is None else float(known[:SLIPPERY_MODELS].sum())
        signature = self._extractor.extract(window, slide)
        if np.isfinite(signature).any():
            memory.recognise(signature, window.ground_speed_mps() * max(window.dt_s, 0.0))
            if good:
                memory.learn(_date(state.t_ns), known)
        if not good or (friction is not None and friction.leads):  # skidding wheels measure no slip
            self._meter.restart()
            self._passed.clear()
            return
        self._passed.append(int(memory.belief.argmax()))
        stretch = self._meter.add(state, rolled_m)
        if stretch is not None:
            self._learn_stretch(stretch)
            self._passed.clear()

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
