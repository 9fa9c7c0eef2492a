"""Drives many runs without sensors, several at once in the lanes of the engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine.integrate import raise_if_diverged
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.run_setup import RunSetup
from terrafusion.twin.scenario.commands import SETTLE_S, DrivenStates, open_loop, settled, settling
from terrafusion.twin.sensors.effects import as_driven

T = TypeVar("T")

TOGETHER = 8
"""Runs whose states are held at a time, which bounds the memory: 16 MB for 60 s at 100 Hz."""


def attempt(work: Callable[..., T], *inputs: Any) -> T | Exception:
    """`work(*inputs)`, or the exception it raises or finds among its inputs: other runs go on."""
    failed = next((value for value in inputs if isinstance(value, Exception)), None)
    if failed is not None:
        return failed
    try:
        return work(*inputs)
    except Exception as error:
        return error


def drive_many(setups: Sequence[RunSetup | Exception]) -> list[DrivenStates | Exception]:
    """The motions of runs of one vehicle and one scenario but for speeds and ground, in their order.

    The same numbers as `RunSetup.drive` run by run, which is how scenarios with waypoints are driven.
    A run that could not be set up, or that diverges, has its exception in place of a motion.
    """
    ready = [setup for setup in setups if isinstance(setup, RunSetup)]
    if not ready or ready[0].scenario.waypoints:
        return [attempt(RunSetup.drive, setup) for setup in setups]
    together = attempt(_batched, ready)
    if isinstance(together, Exception):  # then each alone, so that only those fail that must
        return [attempt(RunSetup.drive, setup) for setup in setups]
    driven = iter(together)
    return [setup if isinstance(setup, Exception) else next(driven) for setup in setups]


def _batched(setups: Sequence[RunSetup]) -> list[DrivenStates | Exception]:
    dt_s = 1.0 / setups[0].vehicle.sensors.imu.rate_hz
    plants = [setup.plant for setup in setups]
    rests = [settling(setup.scenario, dt_s) for setup in setups]
    still = rests[0][1]
    rested = integrate_many(
        np.stack([x for x, _ in rests]), still, dt_s, plants, t0_s=-SETTLE_S, every=len(still) - 1
    )
    starts = [settled(setup.scenario, states[-1]) for setup, states in zip(setups, rested, strict=True)]
    commands = [open_loop(s.scenario, s.t_s, as_driven(s.vehicle, s.effects)) for s in setups]
    motions = integrate_many(np.stack(starts), np.stack([inputs for _, inputs in commands]), dt_s, plants)
    return [attempt(_driven, *each, dt_s) for each in zip(commands, motions, strict=True)]


def _driven(commands: tuple[Array, Array], states: Array, dt_s: float) -> DrivenStates:
    if not np.isfinite(states[-1]).all():  # a run that diverged is blank to its end
        raise_if_diverged(states, 0.0, dt_s)
    return DrivenStates(*commands, states)
