"""The twin run on a log with many sets of effects side by side, and what the sensors then read.

The run is that of `identify.predict`: open loop from window to window, inner states carried on, the pose set
anew in each window. An effect that is in a compiled graph costs in every run of it, so each graph holds few;
which they are follows from the candidates alone: graphs are compiled once.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.predict import LEAD_S, POSE, plant_of, run_up
from terrafusion.twin.calibrate.readings import along
from terrafusion.twin.engine import codegen
from terrafusion.twin.engine.codegen import LANES, LANES_32, Variant
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.engine.lanes import Fleet, blank_what_diverged
from terrafusion.twin.engine.native import driver
from terrafusion.twin.engine.reader import reader
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.samples import samples_of
from terrafusion.twin.model.measurement import measured
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vectors import mounting_vector
from terrafusion.twin.physics.layout import INDEX, STATES, VEHICLE_PARAMETERS, WHEELS
from terrafusion.twin.scenario.commands import delayed_inputs
from terrafusion.twin.sensors.effects import DEAD_TIME, as_driven

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Effects = Mapping[str, float]
Moved = tuple[tuple[str, float], ...]
"""Effects of a set that move the robot, with their values."""

GROUND = ("soil_strength/shear", "soil_strength/bearing", "motion_resistance/rolling")
"""Parameters by which ground differs from run to run: every graph has them."""
TOGETHER = 16
"""Other effects in one graph: as many as vectors hold runs."""
AS_IT_IS = ""
"""Stands for the twin without a further effect, in the first group."""
ORDER = 3
"""Of the integrator's steps: on loose sand, where all is most sensitive, answers differ from those with steps
of fourth order by no more than these do from those with half the step (docs/gap.md)."""
SHORT = True
"""Whether numbers have 32 bits: what they round away is less than the error of such steps (docs/gap.md)."""
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


def in_threads(candidates: Candidates) -> bool:
    """Whether all that drives the twin is compiled: CasADi's virtual machine is not safe in several threads.

    Effects of the catalogue are, where there is a compiler; one's own may hold what is not written as C.
    """
    if codegen.follows_from("", candidates.keys) is not None:
        return compiled()
    whole = Variant(LANES_32 if SHORT else LANES, candidates.moving, fixed_ground=True)
    return driver(whole) is not None and reader(tuple(sorted(candidates.keys)), True) is not None


def what_moves(candidates: Candidates, effects: Effects) -> Moved:
    """The effects of a set that move the robot: sets that differ in the sensors alone share a run."""
    return tuple((k, v) for k, v in sorted(effects.items()) if v != 0.0 and k in candidates.moving)


@dataclass(frozen=True, eq=False)
class Lane:
    """A run of the twin: on which log, by which plant, what it is told (N + 1, U), and its poses (W, 3) at
    the windows' starts."""

    log: PreparedLog
    plant: Plant
    inputs: Array
    start: Array


def lanes_of(
    asked: Sequence[tuple[PreparedLog, Effects, Array]],
    model: Model,
    candidates: Candidates,
    group: Sequence[str],
) -> list[Lane]:
    """The twin on each log with the effects and from the poses (W, 3) asked for; those of the group and of
    the ground are in its graph. Lanes that hear the same share the array."""
    scales = dict(zip(candidates.keys, candidates.scale, strict=True))
    late = VEHICLE_PARAMETERS.index("dead_time_applied_s")
    bases, heard, out = dict[int, Plant](), dict[tuple[int, float], Array](), list[Lane]()
    for log, some, start in asked:
        if id(log) not in bases:
            bases[id(log)], _ = plant_of(log, dataclasses.replace(model, effects={}), [])
        named = {*group, *GROUND, *some} & {*candidates.moving}
        vehicle = bases[id(log)].vehicle.copy()
        vehicle[late] += some.get(DEAD_TIME, 0.0)
        present = {k: some.get(k, 0.0) or TINY * float(scales[k]) for k in sorted(named)}
        late_s = _late_s(log, model, some)
        if (id(log), late_s) not in heard:
            heard[id(log), late_s] = np.ascontiguousarray(delayed_inputs(log.sides, DT_S, late_s))
        plant = Plant(vehicle, bases[id(log)].route, present)
        out.append(Lane(log, plant, heard[id(log), late_s], start))
    return out


def _late_s(log: PreparedLog, model: Model, some: Effects) -> float:
    """By how much what the twin is told is late."""
    late = some.get(DEAD_TIME, 0.0)
    return late if log.follows else as_driven(model.vehicle, {DEAD_TIME: late}).drive.dead_time_s


def driven(lanes: Sequence[Lane], every: int = 1) -> list[Array]:
    """States (N, X) of each lane at every so many-th sample of all its windows.

    Lanes of several logs go on side by side, from where a window of one of them begins or ends to the next
    such place; all their samples are kept, and no ground of theirs changes with time.
    """
    fleet = _fleet(lanes)
    x, spans = _led_in(lanes, fleet), [lane.log.windows - lane.log.windows[0, 0] for lane in lanes]
    out = [np.empty((len(samples_of(lane.log, every)), len(STATES))) for lane in lanes]
    row, pose = [0] * len(lanes), [INDEX[name] for name in POSE]
    borders = np.unique(np.concatenate([span.ravel() for span in spans]))
    for p, q in itertools.pairwise(borders.tolist()):
        live = [i for i, span in enumerate(spans) if span[-1, 1] > p]
        if len(live) < len(fleet.plants):
            fleet = _fleet([lanes[i] for i in live])
        count = (q - p) // every + 1
        parts, inputs = list[Array](), list[Array]()
        for i in live:
            k = int(np.searchsorted(spans[i][:, 0], p, side="right")) - 1
            part, first = out[i][row[i] : row[i] + count], int(lanes[i].log.windows[0, 0]) + p
            if p == spans[i][k, 0]:
                part[0] = x[i]
                part[0, pose] = lanes[i].start[k]
            parts.append(part)
            inputs.append(lanes[i].inputs[first : first + (count - 1) * every + 1])
            row[i] += count if q == spans[i][k, 1] else count - 1
            x[i] = part[-1]  # once it is driven
        fleet.drive(inputs, parts, (int(lanes[live[0]].log.windows[0, 0]) + p) * DT_S, every)
    for states in out:
        blank_what_diverged(states[None])
    return out


def _fleet(lanes: Sequence[Lane]) -> Fleet:
    return Fleet.of([lane.plant for lane in lanes], DT_S, order=ORDER, short=SHORT)


def _led_in(lanes: Sequence[Lane], fleet: Fleet) -> list[Array]:
    """State (X,) of each lane at its first window."""
    known: dict[int, tuple[Array, Array]] = {}
    for lane in lanes:
        if id(lane.inputs) not in known:
            known[id(lane.inputs)] = run_up(lane.log, lane.plant, lane.inputs)
    up = [known[id(lane.inputs)] for lane in lanes]
    out = np.empty((len(lanes), 2, len(STATES)))
    out[:, 0] = [x for x, _ in up]
    for length in dict.fromkeys(len(before) for _, before in up):
        some = [i for i, (_, before) in enumerate(up) if len(before) == length]
        alike = fleet if len(some) == len(lanes) else _fleet([lanes[i] for i in some])
        alike.drive([up[i][1] for i in some], [out[i] for i in some], -LEAD_S, length - 1)
    return list(out[:, 1])


class Sensors:
    """The sensors' readings at the samples (N,) of the runs of one log."""

    def __init__(self, log: PreparedLog, model: Model, candidates: Candidates, samples: Rows) -> None:
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
