"""Batched rollout: the twin driven along a log with many sets of effects at once, and its sensor readings.

The run is that of `calibrate.predict`: open loop within each window, inner states carried on, the pose reset
at each window. An effect in a compiled graph costs time in every run of it, so each graph holds a group of
few effects; the groups follow from the candidates alone and each graph is compiled once.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.predict import LEAD_S, POSE, input_delay_s, plant_of, route_of, run_up
from terrafusion.twin.engine import codegen
from terrafusion.twin.engine.codegen import LANES, LANES_32, Variant
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.engine.lanes import Fleet, blank_what_diverged
from terrafusion.twin.engine.native import driver
from terrafusion.twin.engine.reader import reader
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.samples import Indices
from terrafusion.twin.model.measurement import measured
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vectors import mounting_vector
from terrafusion.twin.physics.layout import INDEX, STATES, VEHICLE_PARAMETERS, WHEELS
from terrafusion.twin.scenario.commands import delayed_inputs
from terrafusion.twin.sensors.effects import DEAD_TIME

Effects = Mapping[str, float]
MotionEffects = tuple[tuple[str, float], ...]  # effects of a set that change the motion, with their values

SOIL_SIGMAS = {"soil_strength/shear": 0.5, "soil_strength/bearing": 0.5, "motion_resistance/rolling": 0.3}
"""Soil parameters that vary from run to run, with their first 1 sigma in typical sizes (assumed): in every
graph."""
GROUP_SIZE = 16  # other effects in one graph: the number of lanes of a vector
NOMINAL = ""  # stands for the twin without a further effect, in the first group
INTEGRATOR_ORDER = 3
"""On loose sand, the most sensitive case, results differ from fourth order by no more than those from half
the step do (docs/how-to/gap.md)."""
SINGLE_PRECISION = True  # rounding of 32-bit numbers is below the integration error (docs/how-to/gap.md)
FULL_GRAPH_COST = 1.8
"""Time of a run in the graph of all effects over that in the graph of one group (measured)."""
ABSENT_SHARE = 1e-12
"""Value of an absent effect, in typical sizes: so that all runs of a group share one compiled graph."""


def effect_groups(candidates: Candidates) -> list[tuple[str, ...]]:
    """The nominal twin and the effects that change the motion, by shared graph."""
    keys = (NOMINAL, *sorted(candidates.moving, key=lambda key: key in candidates.composite))
    return [keys[first : first + GROUP_SIZE] for first in range(0, len(keys), GROUP_SIZE)]


def assign_graphs(candidates: Candidates, runs: Sequence[MotionEffects]) -> dict[tuple[str, ...], list[int]]:
    """Indices of runs by the group of effects whose graph drives them.

    One graph of all effects takes all runs together, those of groups cost less a run: the cheaper choice,
    counted in vectors of `GROUP_SIZE` runs.
    """
    named = [{k for k, _ in run} - {*SOIL_SIGMAS} for run in runs]
    if not any(named):
        return {(): list(range(len(runs)))}
    by_group: dict[tuple[str, ...], list[int]] = {}
    for i in sorted(range(len(runs)), key=lambda i: not named[i]):
        fitting = [g for g in (effect_groups(candidates) if named[i] else by_group) if named[i] <= {*g}]
        group = max(fitting, key=lambda g: -len(by_group.get(g, ())) % GROUP_SIZE, default=candidates.moving)
        by_group.setdefault(group, []).append(i)
    cost = sum(
        -(-len(some) // GROUP_SIZE) * (FULL_GRAPH_COST if g == candidates.moving else 1.0)
        for g, some in by_group.items()
    )
    if cost < FULL_GRAPH_COST * -(-len(runs) // GROUP_SIZE):
        return by_group
    return {candidates.moving: list(range(len(runs)))}


def other_effects(model: Model, candidates: Candidates) -> dict[str, float]:
    """Effects of the twin that are no candidates, such as how its chassis is built: in every graph."""
    return {k: v for k, v in model.effects.items() if v != 0.0 and k not in candidates.keys}


def is_thread_safe(model: Model, candidates: Candidates) -> bool:
    """Whether everything that drives the twin is compiled; CasADi's virtual machine is not thread-safe.

    Effects of the catalogue are compiled where there is a compiler; registered ones may not be expressible in
    C.
    """
    others = other_effects(model, candidates)
    keys = tuple(sorted({*candidates.keys, *others}))
    if codegen.follows_from("", keys) is not None:
        return compiled()
    lanes = LANES_32 if SINGLE_PRECISION else LANES
    full = Variant(lanes, tuple(sorted({*candidates.moving, *others})), fixed_ground=True)
    return driver(full) is not None and reader(keys, True) is not None


def motion_effects(candidates: Candidates, effects: Effects) -> MotionEffects:
    """The effects that change the motion: sets that differ in the sensors alone share a run."""
    return tuple((k, v) for k, v in sorted(effects.items()) if v != 0.0 and k in candidates.moving)


@dataclass(frozen=True, eq=False)
class Lane:
    """One run: its log, plant, inputs (N + 1, U), poses (W, 3) at the windows' starts, and steps a sample."""

    log: PreparedLog
    plant: Plant
    inputs: Array
    start: Array
    steps: int


def make_lanes(
    runs: Sequence[tuple[PreparedLog, Model, Effects, Array]], candidates: Candidates, group: Sequence[str]
) -> list[Lane]:
    """Lanes of (log, model, effects, poses (W, 3)); effects of the group, of the soil and those of the model
    that are no candidates are in the graph. Lanes with equal inputs share the array."""
    scales = dict(zip(candidates.keys, candidates.scale, strict=True))
    dead_time = VEHICLE_PARAMETERS.index("dead_time_applied_s")
    bases, inputs, out = dict[tuple[int, int], Plant](), dict[tuple[int, float], Array](), list[Lane]()
    steps = dict[tuple[int, int], int]()
    for log, model, effects, start in runs:
        if (id(log), id(model)) not in bases:
            others = other_effects(model, candidates)
            bases[id(log), id(model)] = plant_of(log, dataclasses.replace(model, effects=others))
            steps[id(log), id(model)] = stable_steps(DT_S, plant_of(log, model), INTEGRATOR_ORDER)
        base = bases[id(log), id(model)]
        vehicle = base.vehicle.copy()
        vehicle[dead_time] += effects.get(DEAD_TIME, 0.0)
        named = {*group, *SOIL_SIGMAS, *effects} & {*candidates.moving}
        present = {k: effects.get(k, 0.0) or ABSENT_SHARE * float(scales[k]) for k in sorted(named)}
        delay_s = input_delay_s(log, model, effects)
        if (id(log), delay_s) not in inputs:
            inputs[id(log), delay_s] = np.ascontiguousarray(delayed_inputs(log.sides, DT_S, delay_s))
        plant = Plant(vehicle, base.route, {**base.effects, **present})
        out.append(Lane(log, plant, inputs[id(log), delay_s], start, steps[id(log), id(model)]))
    return out


def simulate_lanes(lanes: Sequence[Lane], every: int = 1) -> list[Array]:
    """States (N, X) of each lane at each n-th sample of its windows, see `PreparedLog.samples`.

    Lanes of several logs, whose soils do not change with time, run together between places where a window of
    one of them begins or ends.
    """
    fleet = _fleet(lanes)
    x, spans = _initial_states(lanes, fleet), [lane.log.windows - lane.log.windows[0, 0] for lane in lanes]
    out = [np.empty((len(lane.log.samples(every)), len(STATES))) for lane in lanes]
    row, pose = [0] * len(lanes), [INDEX[name] for name in POSE]
    borders = np.unique(np.concatenate([span.ravel() for span in spans]))
    for p, q in itertools.pairwise(borders.tolist()):
        live = [i for i, span in enumerate(spans) if span[-1, 1] > p]
        if len(live) < len(fleet.plants):
            fleet = _fleet([lanes[i] for i in live])
        windows = [int(np.searchsorted(spans[i][:, 0], p, side="right")) - 1 for i in live]
        begin = [int(spans[i][k, 0]) for i, k in zip(live, windows, strict=True)]
        direct = not any((p - b) % every or (q - b) % every for b in begin)
        step, parts, inputs = every if direct else 1, list[Array](), list[Array]()
        for i, k, b in zip(live, windows, begin, strict=True):
            count, first = (q - p) // step + 1, int(lanes[i].log.windows[0, 0]) + p
            part = out[i][row[i] : row[i] + count] if direct else np.empty((count, len(STATES)))
            part[0] = x[i]
            if p == b:
                part[0, pose] = lanes[i].start[k]
            parts.append(part)
            inputs.append(lanes[i].inputs[first : first + q - p + 1])
            x[i] = part[-1]  # a view, filled by `fleet.drive`
        fleet.drive(inputs, parts, (int(lanes[live[0]].log.windows[0, 0]) + p) * DT_S, step)
        for i, k, b, part in zip(live, windows, begin, parts, strict=True):
            if not direct:
                kept = part[(b - p) % every :: every]
                out[i][row[i] : row[i] + len(kept)] = kept
            row[i] += (b - p) // every - (b - q) // every  # samples before q
            row[i] += int(q == spans[i][k, 1] and (q - b) % every == 0)
    for states in out:
        blank_what_diverged(states[None])
    return out


def _fleet(lanes: Sequence[Lane]) -> Fleet:
    plants, steps = [lane.plant for lane in lanes], [lane.steps for lane in lanes]
    return Fleet.of(plants, DT_S, substeps=steps, order=INTEGRATOR_ORDER, short=SINGLE_PRECISION)


def _initial_states(lanes: Sequence[Lane], fleet: Fleet) -> list[Array]:
    """State (X,) of each lane at its first window, after the run-up."""
    known: dict[int, tuple[Array, Array]] = {}
    for lane in lanes:
        if id(lane.inputs) not in known:
            known[id(lane.inputs)] = run_up(lane.log, lane.plant, lane.inputs)
    up = [known[id(lane.inputs)] for lane in lanes]
    out = np.empty((len(lanes), 2, len(STATES)))
    out[:, 0] = [x for x, _ in up]
    for length in dict.fromkeys(len(before) for _, before in up):
        some = [i for i, (_, before) in enumerate(up) if len(before) == length]
        part = fleet if len(some) == len(lanes) else _fleet([lanes[i] for i in some])
        part.drive([up[i][1] for i in some], [out[i] for i in some], -LEAD_S, length - 1)
    return list(out[:, 1])


class SampledSensors:
    """Sensor readings at samples (N,) of the runs of one log."""

    def __init__(self, log: PreparedLog, model: Model, candidates: Candidates, samples: Indices) -> None:
        self.others, self.samples = frozenset(other_effects(model, candidates)), samples
        self.keys = frozenset(candidates.keys) | self.others
        self.sensing = self.keys - {*candidates.moving} | {*SOIL_SIGMAS} & self.keys
        self.mounting = mounting_vector(model.vehicle)
        route = route_of(log, model)
        self.fixed = route.is_fixed()
        self.soil = route.soil[0] if self.fixed else route.along(route.soil, samples.astype(float) * DT_S)
        self._inputs: dict[int, tuple[Array, Array]] = {}

    def read(
        self, states: Array, plant: Plant, inputs: Array, effects: Effects, group: Sequence[str] = ()
    ) -> Array:
        """Outputs (N, Y) of the states (N, X) of a run with these inputs.

        Args:
            effects: all of the run, the model's own included.
            group: effects that share a graph with those of the run; where it lacks one, a larger graph is
                used.
        """
        names = self._graph_effects(effects, group)
        values = np.array([effects.get(name, 0.0) for name in names])
        if id(inputs) not in self._inputs:
            self._inputs[id(inputs)] = inputs, inputs[self.samples]
        sampled = self._inputs[id(inputs)][1]
        native = reader(names, self.fixed)
        if native is not None:
            return native(states, sampled, self.soil, plant.vehicle, values, self.mounting)
        ground = np.tile(np.atleast_2d(self.soil), (len(states) if self.fixed else 1, len(WHEELS)))
        named = dict(zip(names, values, strict=True))
        return measured(states, sampled, plant.vehicle, ground, self.mounting, named)

    def _graph_effects(self, effects: Effects, group: Sequence[str]) -> tuple[str, ...]:
        """Effects of the smallest graph that has all of a run's."""
        present = {k for k, value in effects.items() if value != 0.0} & self.keys
        for some in ({*group, *SOIL_SIGMAS} & self.keys | self.others, self.sensing):
            if present <= some:
                return tuple(sorted(some))
        return tuple(sorted(self.keys))
