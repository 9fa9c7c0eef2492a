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
Moved = tuple[tuple[str, float], ...]
"""Effects of a set that move the robot, with their values."""

GROUND = ("soil_strength/shear", "soil_strength/bearing", "motion_resistance/rolling")
"""Parameters by which ground differs from run to run: every graph has them."""
TOGETHER = 8
"""Other effects in one graph: as many as vectors hold runs."""
AS_IT_IS = ""
"""Stands for the twin without a further effect, in the first group."""
ORDER = 3
"""Of the integrator's steps: on loose sand, where all is most sensitive, answers differ from those with steps
of fourth order by no more than these do from those with half the step (docs/gap.md)."""
WHOLE = 1.8
"""Time of a run in the graph of all effects, in that of one of a group (measured)."""
TINY = 1e-12
"""Share of its scale that an absent effect has in a run: all runs of a group share one compiled graph."""


def groups(candidates: Candidates) -> list[tuple[str, ...]]:
    """The twin as it is and the effects that move the robot, as they share graphs."""
    keys = (AS_IT_IS, *candidates.moving)
    return [keys[first : first + TOGETHER] for first in range(0, len(keys), TOGETHER)]


def graphs(candidates: Candidates, runs: Sequence[Moved]) -> dict[tuple[str, ...], list[int]]:
    """Runs, by number, by the group of effects whose graph drives them.

    A graph of all effects takes all runs together, those of groups cost less a run: what is cheaper, counted
    in vectors of `TOGETHER` runs.
    """
    named = [{k for k, _ in run} - {*GROUND} for run in runs]
    if not any(named):
        return {(): list(range(len(runs)))}
    apart: dict[tuple[str, ...], list[int]] = {}
    for i in sorted(range(len(runs)), key=lambda i: not named[i]):
        of = [g for g in (groups(candidates) if named[i] else apart) if named[i] <= {*g}]
        group = max(of, key=lambda g: -len(apart.get(g, ())) % TOGETHER, default=candidates.moving)
        apart.setdefault(group, []).append(i)
    vectors = sum(
        -(-len(some) // TOGETHER) * (WHOLE if g == candidates.moving else 1.0) for g, some in apart.items()
    )
    few = vectors < WHOLE * -(-len(runs) // TOGETHER)
    return apart if few else {candidates.moving: list(range(len(runs)))}


def what_moves(candidates: Candidates, effects: Effects) -> Moved:
    """The effects of a set that move the robot: sets that differ in the sensors alone share a run."""
    return tuple((k, v) for k, v in sorted(effects.items()) if v != 0.0 and k in candidates.moving)


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


def driven(
    log: Log, plants: Sequence[Plant], inputs: Sequence[Array], starts: Sequence[Array], every: Sequence[int]
) -> list[Array]:
    """States (N, X) of each plant's run from its poses (W, 3) at every so many-th sample of all windows, a
    number a run: the least of them, or a multiple of it."""
    fleet = Fleet.of(plants, DT_S, order=ORDER)
    windows = [(int(a), int(b)) for a, b in log.windows]
    least = min(every)
    out = [np.empty((len(samples_of(log, step)), len(STATES))) for step in every]
    kept = [0] * len(plants)
    x = _led_in(log, fleet, inputs)
    pose = [INDEX[name] for name in POSE]
    for k, (begin, end) in enumerate(windows):
        count = (end - begin) // least + 1
        parts = []
        for states, step, done in zip(out, every, kept, strict=True):
            parts.append(states[done : done + count] if step == least else np.empty((count, len(STATES))))
        for part, now, start in zip(parts, x, starts, strict=True):
            part[0], part[0, pose] = now, start[k]
        whole = begin + (count - 1) * least
        fleet.drive([u[begin : whole + 1] for u in inputs], parts, begin * DT_S, least)
        x = [part[-1] for part in parts]
        for i, (part, step) in enumerate(zip(parts, every, strict=True)):
            some = part[:: step // least]
            if step != least:
                out[i][kept[i] : kept[i] + len(some)] = some
            kept[i] += len(some)
    for states in out:
        blank_what_diverged(states[None])
    return out


def _led_in(log: Log, fleet: Fleet, inputs: Sequence[Array]) -> list[Array]:
    """State (X,) of each run at the first window."""
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
    return list(out[:, 1])


class Sensors:
    """The sensors' readings at the samples (N,) of the runs of one log."""

    def __init__(self, log: Log, model: Model, candidates: Candidates, samples: Rows) -> None:
        self.keys, self.samples = frozenset(candidates.keys), samples
        self.sensing = self.keys - {*candidates.moving} | {*GROUND} & self.keys
        self.mounting = mounting_vector(model.vehicle)
        route = plant_of(log, dataclasses.replace(model, effects={}), [])[0].route
        self.fixed = route.is_fixed()
        self.soil = route.soil[0] if self.fixed else along(route, route.soil, samples.astype(float) * DT_S)
        self._inputs: dict[int, tuple[Array, Array]] = {}

    def read(
        self, states: Array, plant: Plant, inputs: Array, effects: Effects, group: Sequence[str] = ()
    ) -> Array:
        """Outputs (N, Y) of the states (N, X) of a run that was told `inputs`.

        Args:
            group: effects that share a graph with those of the run; an effect that is in a graph costs, in
                every run. Where it lacks one of the run's, all are in the graph.
        """
        names = self._names(effects, group)
        values = np.array([effects.get(name, 0.0) for name in names])
        if id(inputs) not in self._inputs:
            self._inputs[id(inputs)] = inputs, inputs[self.samples]
        heard = self._inputs[id(inputs)][1]
        native = reader(names, self.fixed)
        if native is not None:
            return native(states, heard, self.soil, plant.vehicle, values, self.mounting)
        ground = np.tile(np.atleast_2d(self.soil), (len(states) if self.fixed else 1, len(WHEELS)))
        named = dict(zip(names, values, strict=True))
        return measured(states, heard, plant.vehicle, ground, self.mounting, named)

    def _names(self, effects: Effects, group: Sequence[str]) -> tuple[str, ...]:
        """Of the least graph that has all effects of a run."""
        present = {k for k, value in effects.items() if value != 0.0} & self.keys
        for some in ({*group, *GROUND} & self.keys, self.sensing):
            if present <= some:
                return tuple(sorted(some))
        return tuple(sorted(self.keys))
