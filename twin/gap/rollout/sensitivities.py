"""Predicted channels of a log and their sensitivities to every candidate.

Sensitivities are finite differences of a batched rollout with one run an effect.
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.poses import EAST_NORTH, aligned_start, moved, rotated, window_index
from terrafusion.twin.gap.data.samples import (
    COARSE_STEP,
    coarse_counts,
    coarse_subset,
    delayed_samples,
    sample_map,
    weighted_means,
)
from terrafusion.twin.gap.data.threads import in_threads
from terrafusion.twin.gap.rollout.batch import (
    GROUP_SIZE,
    NOMINAL,
    Lane,
    MotionEffects,
    SampledSensors,
    assign_graphs,
    effect_groups,
    make_lanes,
    motion_effects,
    simulate_lanes,
)
from terrafusion.twin.gap.rollout.ground_patches import patch_columns
from terrafusion.twin.gap.rollout.measured_turns import as_measured, turned_apart, with_heading_errors
from terrafusion.twin.physics.layout import INDEX, OUTPUTS
from terrafusion.twin.sensors.effects import without_delays

STEP = 0.3
"""Step of the differences, in typical sizes: finite, because the tangent at a wheel about to slide or to
reverse does not represent an effect of the size that is sought."""

_OUTPUTS = {name: (i,) for i, name in enumerate(OUTPUTS)} | {"wheel_mean_radps": (0, 1)}
"""Columns of the graph's outputs whose mean a channel is."""


@dataclasses.dataclass(frozen=True, eq=False)
class Linearisation:
    """The twin's run for one sequence of commands, with derivatives; independent of what the log measured.

    Attributes:
        start: (W, 3) pose at the start of each window.
        fine: (N, Y) outputs at every grid sample of all windows.
        columns: (n, Y, 3 + K + D) derivatives at every `COARSE_STEP`-th sample: by the pose of the window's
            start, by the candidates' parameters, in typical sizes, and by patches of ground along the path.
        heading: (n,) yaw of the body.
    """

    start: Array
    fine: Array
    columns: Array
    heading: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Sensitivity:
    """One channel: prediction (n,), derivatives (n, 3 + K + D) as in `Linearisation`, heading (n,)."""

    value: Array
    columns: Array
    heading: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """A prediction to make: a log, effects on top of the model's own, poses (W, 3) at the windows' starts
    (None: the log's own), and the model (None: that of all)."""

    log: PreparedLog
    effects: Mapping[str, float]
    start: Array | None = None
    model: Model | None = None

    def poses(self) -> Array:
        return self.log.start if self.start is None else self.start


def aligned_predictions(
    rollouts: Sequence[Rollout], model: Model, candidates: Candidates, jobs: int = 1
) -> list[list[Array] | None]:
    """As `predictions`, with the track of each window turned as the gyro measured and aligned with the
    observed one.

    World-fixed effects are simulated again from the aligned poses: a robot that slides down a slope does not
    point along its track.
    """
    done, out = list(rollouts), _turned_predictions(rollouts, model, candidates, jobs)
    again = list[int]()
    for i, (rollout, y) in enumerate(zip(rollouts, out, strict=True)):
        own = (rollout.model or model).effects
        if y is not None and candidates.any_world_fixed({**own, **rollout.effects}):
            done[i] = dataclasses.replace(rollout, start=aligned_start(rollout.log, y, rollout.poses()))
            again.append(i)
    new = _turned_predictions([done[i] for i in again], model, candidates, jobs)
    for i, y in zip(again, new, strict=True):
        out[i] = y
    return [
        None if y is None else moved(r.log, y, r.poses(), aligned_start(r.log, y, r.poses()))
        for r, y in zip(done, out, strict=True)
    ]


def _turned_predictions(
    rollouts: Sequence[Rollout], model: Model, candidates: Candidates, jobs: int
) -> list[list[Array] | None]:
    found = zip(rollouts, predictions(rollouts, model, candidates, jobs), strict=True)
    return [None if y is None else as_measured(r.log, y, y) for r, y in found]


def predictions(
    rollouts: Sequence[Rollout], model: Model, candidates: Candidates, jobs: int = 1
) -> list[list[Array] | None]:
    """Channels of each rollout; None in place of a run that diverged.

    Rollouts that differ in the sensors alone, of the same log, model and array of poses, share a run. Each
    result is the same as if computed alone.
    """
    models = [r.model or model for r in rollouts]
    effects = [{**m.effects, **r.effects} for m, r in zip(models, rollouts, strict=True)]
    starts, shared = [r.poses() for r in rollouts], dict[tuple[int, MotionEffects, int, int], list[int]]()
    for i, (r, some, start, m) in enumerate(zip(rollouts, effects, starts, models, strict=True)):
        shared.setdefault((id(r.log), motion_effects(candidates, some), id(start), id(m)), []).append(i)
    runs, moved = list(shared.values()), [key[1] for key in shared]
    sensors = {
        (id(r.log), id(m)): SampledSensors(r.log, m, candidates, r.log.samples())
        for r, m in zip(rollouts, models, strict=True)
    }
    out: list[list[Array] | None] = [None] * len(rollouts)

    def simulate(task: tuple[tuple[str, ...], list[int]]) -> None:
        group, some = task
        first = [runs[run][0] for run in some]
        pairs = zip(first, some, strict=True)
        given = [(rollouts[i].log, models[i], dict(moved[run]), starts[i]) for i, run in pairs]
        lanes = make_lanes(given, candidates, group)
        for run, lane, x in zip(some, lanes, simulate_lanes(lanes), strict=True):
            for i in runs[run] if np.isfinite(x).all() else ():
                own = sensors[id(lane.log), id(models[i])]
                y = own.read(x, lane.plant, lane.inputs, without_delays(effects[i]), group)
                by_channel = zip(lane.log.observed, delayed_samples(lane.log, effects[i]), strict=True)
                out[i] = [weighted_means(at, _channel(y, o.channel)) for o, at in by_channel]

    logs = [rollouts[some[0]].log for some in runs]
    in_threads(jobs, simulate, _batches(logs, moved, candidates, jobs))
    return out


def _batches(
    logs: Sequence[PreparedLog], moved: Sequence[MotionEffects], candidates: Candidates, jobs: int
) -> list[tuple[tuple[str, ...], list[int]]]:
    """Runs, by index, that are simulated together, with the effects of their graph: runs on a single soil,
    and runs of the same log over several soils."""
    together: dict[int, list[int]] = {}
    for i, log in enumerate(logs):
        together.setdefault(id(log) if len(log.labels) > 1 else 0, []).append(i)
    out = list[tuple[tuple[str, ...], list[int]]]()
    for runs in together.values():
        by_group = assign_graphs(candidates, [moved[run] for run in runs])
        for group, some in by_group.items():
            size = min(GROUP_SIZE, -(-len(some) // jobs)) if len(by_group) == 1 else GROUP_SIZE
            mine = [runs[i] for i in some]
            out += [(group, mine[k : k + size]) for k in range(0, len(mine), size)]
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Course:
    """What is linearised: a log, the model, poses (W, 3) at the windows' starts, and keys of the columns to
    compute, the others are zero; None: all."""

    log: PreparedLog
    model: Model
    start: Array
    only: Collection[str] | None = None

    def steps(self, candidates: Candidates) -> dict[str, float]:
        """Step of each parameter, in its unit."""
        known, keys = self.model.effects, candidates.keys[: candidates.count]
        return {k: _step(candidates, i, known.get(k, 0.0), self.log) for i, k in enumerate(keys)}

    def effects(self, candidates: Candidates) -> dict[str, dict[str, float]]:
        """Effects of each run that is made, by the key that differs."""
        own, steps = self.model.effects, self.steps(candidates)
        wanted = {k: step for k, step in steps.items() if self.only is None or k in self.only}
        return {NOMINAL: dict(own)} | {k: {**own, k: own.get(k, 0.0) + x} for k, x in wanted.items()}


def linearise(
    log: PreparedLog, model: Model, candidates: Candidates, start: Array, only: Collection[str] | None = None
) -> Linearisation:
    """The twin's run at the model's own effects, with its derivatives; arguments as those of `Course`.

    Raises:
        TerrafusionError: the run diverged.
    """
    (found,) = linearise_all([Course(log, model, start, only)], candidates)
    if found is None:
        raise TerrafusionError(
            "the twin diverges on this log",
            file=log.name,
            remedy="check the vehicle's and the soil's numbers",
        )
    return found


def linearise_all(courses: Sequence[Course], candidates: Candidates) -> list[Linearisation | None]:
    """Each as if alone, None where its run diverges; the runs of all are simulated together."""
    driven: list[dict[str, _Driven]] = [{} for _ in courses]
    effects = [course.effects(candidates) for course in courses]
    for group in effect_groups(candidates):
        pairs = [(i, k) for i, some in enumerate(effects) for k in group if k in some]
        given = [(courses[i].log, courses[i].model, effects[i][k], courses[i].start) for i, k in pairs]
        lanes, every = make_lanes(given, candidates, group), 1 if NOMINAL in group else COARSE_STEP
        for (i, k), lane, x in zip(pairs, lanes, simulate_lanes(lanes, every) if lanes else (), strict=True):
            coarse = x[coarse_subset(lane.log)] if every == 1 else x
            driven[i][k] = _Driven(lane, coarse, group, x if k == NOMINAL else None)
    return [_linearisation(*own, candidates) for own in zip(courses, effects, driven, strict=True)]


@dataclasses.dataclass(frozen=True, eq=False)
class _Driven:
    """A simulated run: states (n, X) at the coarse samples, the effects of its graph, states (N, X) at all
    samples for the nominal one."""

    lane: Lane
    coarse: Array
    group: tuple[str, ...]
    fine: Array | None


def _linearisation(
    course: Course,
    effects: Mapping[str, Mapping[str, float]],
    driven: Mapping[str, _Driven],
    candidates: Candidates,
) -> Linearisation | None:
    log, model, twin = course.log, course.model, driven[NOMINAL]
    if twin.fine is None or not np.isfinite(twin.fine).all():
        return None
    every = SampledSensors(log, model, candidates, log.samples())
    fine = every.read(twin.fine, twin.lane.plant, twin.lane.inputs, effects[NOMINAL])
    sensors, read = SampledSensors(log, model, candidates, log.samples(COARSE_STEP)), dict[str, Array]()
    for k, own in driven.items():
        read[k] = sensors.read(own.coarse, own.lane.plant, own.lane.inputs, effects[k], own.group)
    for k in effects.keys() - read.keys():  # effects of the sensors alone
        read[k] = sensors.read(twin.coarse, twin.lane.plant, twin.lane.inputs, effects[k])
    y, steps = read[NOMINAL], course.steps(candidates)
    slopes = {
        k: (read[k] - y) * (scale / steps[k])
        for k, scale in zip(candidates.keys, candidates.scale, strict=True)
        if k in read and np.isfinite(read[k]).all()  # of a run that diverged, the column is zero
    }
    by_patch, K = patch_columns(y, slopes, coarse_counts(log), model.vehicle.body.track_m), len(steps)
    columns = np.zeros((*y.shape, 3 + K + by_patch.shape[2]))
    columns[:, :, :3], columns[:, :, 3 + K :] = _by_pose(log, twin.coarse, y), by_patch
    for i, k in enumerate(candidates.keys, start=3):
        if k in slopes:
            columns[:, :, i] = slopes[k]
    return Linearisation(course.start, fine, columns, twin.coarse[:, INDEX["yaw"]])


def channel_sensitivities(log: PreparedLog, run: Linearisation) -> list[Sensitivity]:
    """Prediction and derivatives of every channel of the log, averaged over the samples' own intervals."""
    at, out = sample_map(log), []
    for observed, fine, coarse in zip(log.observed, at.fine, at.coarse, strict=True):
        value = weighted_means(fine, _channel(run.fine, observed.channel))
        columns = weighted_means(coarse, _channel(run.columns, observed.channel))
        out.append(Sensitivity(value, columns, run.heading[coarse[0][:, 2]]))
    return out


def turned(log: PreparedLog, channels: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Sensitivities with the tracks turned as the gyro measured, see `measured_turns`."""
    values = [s.value for s in channels]
    new = as_measured(log, values, values)
    columns = with_heading_errors(log, new, as_measured(log, values, [s.columns for s in channels]))
    return [
        Sensitivity(new[i], columns[i], s.heading + turned_apart(log, values, i))
        for i, s in enumerate(channels)
    ]


def moved_to(log: PreparedLog, channels: Sequence[Sensitivity], old: Array, new: Array) -> list[Sensitivity]:
    """Sensitivities from other poses (W, 3) at the windows' starts than the old ones, see `poses.moved`."""
    if np.array_equal(old, new):
        return list(channels)
    turn = new[:, 2] - old[:, 2]
    value = moved(log, [s.value for s in channels], old, new)
    columns = rotated(log, [s.columns for s in channels], turn)
    out = []
    for i, s in enumerate(channels):
        columns[i][:, :2] = s.columns[:, :2]  # by x and y, whatever the pose
        out.append(Sensitivity(value[i], columns[i], s.heading + turn[window_index(log, i)]))
    return out


def _channel(outputs: Array, channel: str) -> Array:
    """A channel (N, ...) of the outputs (N, Y, ...)."""
    columns = _OUTPUTS[channel]
    return outputs[:, columns[0]] if len(columns) == 1 else np.asarray(outputs[:, columns].mean(axis=1))


def _step(candidates: Candidates, i: int, at: float, log: PreparedLog) -> float:
    """Step of one parameter, in its unit, towards the side where its range leaves room.

    A delay on the way to the motors is at least the time between commands: samples that come in step with
    them do not show a part of it.
    """
    step, low, high = STEP * float(candidates.scale[i]), float(candidates.low[i]), float(candidates.high[i])
    if candidates.units[i] == "s" and candidates.keys[i] in candidates.moving:
        step = min(max(step, log.input_step_s), 0.5 * (high - low))
    return step if at + step <= high else -step


def _by_pose(log: PreparedLog, states: Array, y: Array) -> Array:
    """Derivatives (N, Y, 3) of the outputs by x, y and yaw of the window's start."""
    out = np.zeros((*y.shape, 3))
    east, north, v_e, v_n = (OUTPUTS.index(channel) for pair in EAST_NORTH for channel in pair)
    counts = coarse_counts(log)
    begin = np.repeat(np.cumsum(counts) - counts, counts)
    out[:, east, 0] = out[:, north, 1] = 1.0
    out[:, east, 2] = states[begin, INDEX["y"]] - y[:, north]
    out[:, north, 2] = y[:, east] - states[begin, INDEX["x"]]
    out[:, v_e, 2], out[:, v_n, 2] = -y[:, v_n], y[:, v_e]
    return out
