"""The twin run on a log with many sets of effects side by side, and what the sensors then read.

The run is that of `identify.predict`: open loop from window to window, inner states carried on, the pose set
anew in each window. An effect that is in a compiled graph costs in every run of it, so each graph holds few;
which they are follows from the candidates alone: graphs are compiled once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.drive import told
from terrafusion.twin.effects.sensed import DEAD_TIME, as_driven
from terrafusion.twin.engine.lanes import Fleet, blank_what_diverged
from terrafusion.twin.engine.plant import Plant
from terrafusion.twin.engine.reader import reader
from terrafusion.twin.gap.candidates import Candidates
from terrafusion.twin.gap.rows import samples_of
from terrafusion.twin.identify.inputs import DT_S
from terrafusion.twin.identify.log import Log
from terrafusion.twin.identify.model import Model
from terrafusion.twin.identify.predict import LEAD_S, POSE, plant_of, run_up
from terrafusion.twin.identify.readings import along
from terrafusion.twin.layout import INDEX, STATES, VEHICLE_PARAMETERS, WHEELS, mounting_vector
from terrafusion.twin.measurement import measured

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Effects = Mapping[str, float]

GROUND = ("soil_strength/shear", "soil_strength/bearing", "motion_resistance/rolling")
"""Parameters by which ground differs from run to run: every graph has them."""
TOGETHER = 8
"""Other effects in one graph: as many as vectors hold runs."""
AS_IT_IS = ""
"""Stands for the twin without a further effect, in the first group."""
TINY = 1e-12
"""Share of its scale that an absent effect has in a run: all runs of a group share one compiled graph."""


def groups(candidates: Candidates) -> list[tuple[str, ...]]:
    """The twin as it is and the effects that move the robot, as they share graphs."""
    keys = (AS_IT_IS, *candidates.moving)
    return [keys[first : first + TOGETHER] for first in range(0, len(keys), TOGETHER)]


def plants_of(
    log: Log, model: Model, candidates: Candidates, sets: Sequence[Effects], group: Sequence[str]
) -> list[Plant]:
    """The twin with each set of effects; those of the group and of the ground are in its graph."""
    base, _ = plant_of(log, dataclasses.replace(model, effects={}), [])
    scales = dict(zip(candidates.keys, candidates.scale, strict=True))
    late, out = VEHICLE_PARAMETERS.index("dead_time_applied_s"), []
    for some in sets:
        named = {*group, *GROUND, *some} & {*candidates.moving}
        vehicle = base.vehicle.copy()
        vehicle[late] += some.get(DEAD_TIME, 0.0)
        present = {k: some.get(k, 0.0) or TINY * float(scales[k]) for k in sorted(named)}
        out.append(Plant(vehicle, base.route, present))
    return out


def inputs_of(log: Log, model: Model, sets: Sequence[Effects]) -> list[Array]:
    """What the twin is told (N + 1, U) with each set of effects; those that hear it alike share the array."""
    known: dict[float, Array] = {}
    out = []
    for some in sets:
        late = some.get(DEAD_TIME, 0.0)
        late = late if log.follows else as_driven(model.vehicle, {DEAD_TIME: late}).drive.dead_time_s
        if late not in known:
            known[late] = np.ascontiguousarray(told(log.sides, DT_S, late))
        out.append(known[late])
    return out


def driven(log: Log, plants: Sequence[Plant], inputs: Sequence[Array], start: Array, every: int = 1) -> Array:
    """States (B, N, X) at every so many-th sample of all windows, a run a plant."""
    fleet, windows = Fleet.of(plants, DT_S), [(int(a), int(b)) for a, b in log.windows]
    out = np.empty((len(plants), len(samples_of(log, every)), len(STATES)))
    x = _led_in(log, fleet, inputs)
    pose, done = [INDEX[name] for name in POSE], 0
    for (begin, end), guess in zip(windows, start, strict=True):
        count = (end - begin) // every + 1
        part = out[:, done : done + count]
        part[:, 0], part[:, 0, pose] = x, guess
        whole = begin + (count - 1) * every
        fleet.drive([u[begin : whole + 1] for u in inputs], list(part), begin * DT_S, every)
        x, done = part[:, -1], done + count
    blank_what_diverged(out)
    return out


def _led_in(log: Log, fleet: Fleet, inputs: Sequence[Array]) -> Array:
    """States (B, X) at the first window."""
    known: dict[int, tuple[Array, Array]] = {}
    lead = []
    for plant, u in zip(fleet.plants, inputs, strict=True):
        if id(u) not in known:
            known[id(u)] = run_up(log, plant, u)
        lead.append(known[id(u)])
    whole = lead[0][1].shape[0] - 1
    out = np.empty((len(lead), 2, len(STATES)))
    out[:, 0] = [x for x, _ in lead]
    fleet.drive([before for _, before in lead], list(out), -LEAD_S, whole)
    return out[:, 1]


class Sensors:
    """The measurement graph with all effects, at the samples (N,) of the runs of one log."""

    def __init__(self, log: Log, model: Model, candidates: Candidates, samples: Rows) -> None:
        self.names, self.samples = tuple(sorted(candidates.keys)), samples
        self.mounting = mounting_vector(model.vehicle)
        route = plant_of(log, dataclasses.replace(model, effects={}), [])[0].route
        self.fixed = route.is_fixed()
        self.soil = route.soil[0] if self.fixed else along(route, route.soil, samples.astype(float) * DT_S)
        self._inputs: dict[int, tuple[Array, Array]] = {}

    def read(self, states: Array, plant: Plant, inputs: Array, effects: Effects) -> Array:
        """Outputs (N, Y) of the states (N, X) of a run that was told `inputs`."""
        values = np.array([effects.get(name, 0.0) for name in self.names])
        if id(inputs) not in self._inputs:
            self._inputs[id(inputs)] = inputs, inputs[self.samples]
        heard = self._inputs[id(inputs)][1]
        native = reader(self.names, self.fixed)
        if native is not None:
            return native(states, heard, self.soil, plant.vehicle, values, self.mounting)
        ground = np.tile(np.atleast_2d(self.soil), (len(states) if self.fixed else 1, len(WHEELS)))
        named = dict(zip(self.names, values, strict=True))
        return measured(states, heard, plant.vehicle, ground, self.mounting, named)
