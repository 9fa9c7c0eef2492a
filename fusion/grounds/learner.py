"""Ground memory beside a drive: recognises, learns while fixes are good, and watches its own predictions."""

from __future__ import annotations

import dataclasses
import math
from datetime import UTC, datetime
from typing import Protocol

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.grounds.ground import SLIPPERY_MODELS, Ground
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.grounds.signature import SignatureExtractor
from terrafusion.fusion.grounds.stretches import SlipStretch, StretchMeter
from terrafusion.fusion.terrain.features import Window

SURE = 0.5
"""Least mean belief in one ground for a stretch to count for it."""
FADES, COUNTS, MOST_EVIDENCE, LEAST_EVIDENCE = 0.98, 0.05, 2.0, -8.0
"""Evidence left after a window, what a window counts for as fixes of 30 s are scored together, and bounds: a
stale ground loses its say within some seconds, and may win it back."""
USABLE = 0.1
"""Most uncertain slip of a stretch that is used."""
CLOCKED_NS = 946_684_800_000_000_000
"""Stamps before the year 2000 are no dates."""


class FrictionBank(Protocol):
    """Friction limits scored by fixes; see `estimator.friction`."""

    @property
    def leads(self) -> bool:
        """Whether friction, and not the wheels, predicts the motion."""

    def base(self) -> Array:
        """Prior probabilities (10,) of the limits and of rolling, of any ground."""

    def scored(self) -> Array:
        """Probabilities (10,) by the fixes of this drive and `base`."""

    def expect(self, probabilities: Array) -> None:
        """Prior of the present ground."""


class GroundLearner:
    """Feeds a `GroundMemory` twice a second.

    Attributes:
        memory: the grounds, and the belief which one the robot is on.
    """

    def __init__(self, memory: GroundMemory | None = None) -> None:
        self.memory = GroundMemory() if memory is None else memory.copy()
        self._extractor, self._meter = SignatureExtractor(), StretchMeter()
        self._passed: list[Array] = []

    def update(
        self,
        window: Window,
        state: State,
        rolled_m: float,
        friction: FrictionBank | None,
    ) -> None:
        """One window that ends at `state`, in which the wheels rolled `rolled_m` since the last one."""
        memory, good = self.memory, state.status == "running"
        slide = math.nan
        if friction is not None and good:
            slide = float(friction.scored()[:SLIPPERY_MODELS].sum())
        signature = self._extractor.extract(window, slide)
        moved = window.ground_speed_mps() * max(window.dt_s, 0.0)
        if np.isfinite(signature).any():
            memory.recognise(signature, moved)
            if good:
                memory.learn(_date(state.t_ns))
        if good:
            self._learn_motion(state, rolled_m, friction, bool(np.isfinite(signature).any()))
        else:
            self._forget_stretch()
        if friction is not None:
            friction.expect(memory.friction_prior(friction.base()))

    def _learn_motion(
        self, state: State, rolled_m: float, friction: FrictionBank | None, moves: bool
    ) -> None:
        if friction is not None and moves:
            scored, belief = friction.scored(), self.memory.belief
            best = int(belief[1:].argmax()) if len(belief) > 1 else -1
            if best >= 0 and belief[1 + best] > SURE:
                ground = with_evidence(self.memory.grounds[best], scored, friction.base())
                self._replace(best, ground.slid(scored, float(belief[1 + best])))
        if friction is not None and friction.leads:  # wheels that skid measure no slip of the ground
            self._forget_stretch()
            return
        self._passed.append(self.memory.belief)
        stretch = self._meter.add(state, rolled_m)
        if stretch is not None:
            self._learn_stretch(stretch)
            self._passed.clear()

    def _learn_stretch(self, stretch: SlipStretch) -> None:
        k = len(self.memory.grounds)
        padded = [np.pad(b, (0, 1 + k - len(b))) for b in self._passed]
        belief = np.mean(padded, axis=0)
        if k == 0 or stretch.sigma > USABLE:
            return
        best = int(belief[1:].argmax())
        if belief[1 + best] < SURE:
            return
        ground = self.memory.grounds[best]
        entry = np.array([stretch.slip, stretch.side])
        self._replace(
            best,
            dataclasses.replace(
                ground, motion=ground.motion.plus(entry, float(belief[1 + best]), stretch.sigma**2)
            ),
        )

    def _replace(self, i: int, ground: Ground) -> None:
        self.memory.grounds[i] = ground

    def _forget_stretch(self) -> None:
        self._meter.restart()
        self._passed.clear()

    def best(self) -> tuple[Ground | None, float]:
        """The most probable ground, None for new ground, and its probability."""
        i = int(self.memory.belief.argmax())
        return (self.memory.grounds[i - 1] if i else None), float(self.memory.belief[i])


def with_evidence(ground: Ground, scored: Array, base: Array) -> Ground:
    """The ground with the evidence of one more window: its friction against that of no memory.

    `scored` (10,) are probabilities by fixes and `base` (10,) alone, so their ratio is the fixes' likelihood.
    """
    gained = math.log(max(float(ground.friction_prior(base) @ (scored / base)), 1e-6))
    evidence = min(max(FADES * ground.evidence + COUNTS * gained, LEAST_EVIDENCE), MOST_EVIDENCE)
    return dataclasses.replace(ground, evidence=evidence)


def _date(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns * 1e-9, UTC).strftime("%Y-%m-%d") if t_ns > CLOCKED_NS else ""
