"""Short drives of the twin that tests of the diagnosis share."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.recording import Recording
from terrafusion.twin.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

SEGMENTS = (
    (1.0, 0.0, 0.0), (3.0, 0.8, 0.4), (4.0, 1.2, -0.5), (3.0, 0.5, 0.0), (3.0, 1.0, 0.0), (3.0, 0.0, 0.6),
    (4.0, 1.4, 0.0), (3.0, 0.5, 0.5), (3.0, 1.0, -0.4), (3.0, 0.0, 0.0),
)  # fmt: skip
DRIVE = Scenario(
    "exciting", 30.0, route=(RouteLeg("loose_sand"),), drive=tuple(DriveSegment(*s) for s in SEGMENTS)
)


def run(number: int, effects: Mapping[str, float] | None = None, spread: float = 0.05) -> Recording:
    """A run without a truth channel; the ground's strength varies from run to run."""
    rng = np.random.default_rng(number)
    own = {
        "soil_strength/shear": float(spread * rng.standard_normal()),
        "soil_strength/bearing": float(spread * rng.standard_normal()),
    }
    for key, value in (effects or {}).items():
        own[key] = own.get(key, 0.0) + value
    recording = simulate(DRIVE, seed=number, effects=own)
    return dataclasses.replace(recording, name=f"run{number}", truth=None, truth_channels=())


def runs(first: int, count: int, effects: Mapping[str, float] | None = None) -> list[Recording]:
    """Several of them."""
    return [run(first + i, effects) for i in range(count)]
