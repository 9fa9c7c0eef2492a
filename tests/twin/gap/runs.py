"""Short drives of the twin that tests of the diagnosis share."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

SEGMENTS = (
    (0.5, 0.0, 0.0), (3.0, 0.8, 0.4), (3.0, 1.2, -0.5), (2.5, 0.5, 0.0), (2.0, 0.0, 0.6), (3.0, 1.4, 0.0),
    (2.0, 0.5, 0.5), (3.0, 1.0, -0.4), (1.0, 0.0, 0.0),
)  # fmt: skip
DRIVE = Scenario(
    "exciting", 20.0, route=(RouteLeg("loose_sand"),), drive=tuple(DriveSegment(*s) for s in SEGMENTS)
)
GROUND = ("soil_strength/shear", "soil_strength/bearing")
SPREAD = 0.05
"""1 sigma of the ground's strength from run to run."""
MOVING = (*GROUND, "wheel_radius/scale", "track_width/scale")
"""Effects on the motion that the tests use: present in every run, so that all share one compiled graph."""
ABSENT = 1e-12


def run(number: int, effects: Mapping[str, float] | None = None, drive: Scenario = DRIVE) -> Recording:
    """A run without a truth channel; the ground's strength varies from run to run."""
    rng = np.random.default_rng(number)
    own = dict.fromkeys(MOVING, ABSENT)
    own.update({key: SPREAD * float(rng.standard_normal()) for key in GROUND})
    for key, value in (effects or {}).items():
        own[key] = own.get(key, 0.0) + value
    recording = simulate(drive, seed=number, effects=own)
    return dataclasses.replace(recording, name=f"run{number}", truth=None, truth_channels=())


def runs(first: int, count: int, effects: Mapping[str, float] | None = None) -> list[Recording]:
    """Several of them."""
    return [run(first + i, effects) for i in range(count)]
