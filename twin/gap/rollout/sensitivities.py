"""What the twin says a log should read, and how that changes with every effect at once.

The run is that of `identify.predict`: open loop from window to window, inner states carried on, the pose set
anew in each window. Derivatives are differences of runs that are driven side by side, one an effect.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.poses import PAIRS, settled, settled_start
from terrafusion.twin.gap.data.samples import EVERY, among_all, coarse_counts, layout, means, samples_of
from terrafusion.twin.gap.rollout.batch import (
    AS_IT_IS,
    TOGETHER,
    Moved,
    Sensors,
    driven,
    graphs,
    groups,
    lanes_of,
    what_moves,
)
from terrafusion.twin.gap.rollout.delay import in_time, late_layout
from terrafusion.twin.physics.layout import INDEX, OUTPUTS

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

STEP = 0.3
"""Step, in scales, of the differences: finite, because a tangent at a wheel that is just about to slide or to
turn its direction says nothing about an effect of the size that is looked for."""

_OUTPUTS = {name: (i,) for i, name in enumerate(OUTPUTS)} | {"wheel_mean_radps": (0, 1)}
"""Columns of the graph's outputs whose mean a channel is."""


@dataclasses.dataclass(frozen=True, eq=False)
class Drive:
    """What the twin makes of one sequence of commands, whatever a log has measured of it.

    Attributes:
        start: (W, 3) pose at the start of each window.
        fine: (N, Y) outputs at every grid sample of all windows.
        y, change, by_pose: outputs (n, Y) at every `EVERY`-th, derivatives (n, Y, K) by the candidates'
            columns, in scales, and (n, Y, 3) by the pose of the window's start.
        heading: (n,) yaw of the body.
    """

    start: Array
    fine: Array
    y: Array
    change: Array
    by_pose: Array
    heading: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Signature:
    """One channel: prediction (n,), derivatives by the columns (n, K), in scales, and the pose (n, 3)."""

    value: Array
    change: Array
    by_pose: Array
    heading: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Ask:
    """What the twin is asked to predict: channels of a log with effects on top of the model's own, from poses
    (W, 3) at the windows' starts; None: the log's own."""

    log: PreparedLog
    effects: Mapping[str, float]
    start: Array | None = None


def settled_predictions(
    asks: Sequence[Ask], model: Model, candidates: Candidates, jobs: int = 1
) -> list[list[Array] | None]:
    """As `predictions`, the track of every window turned and shifted onto the one observed.

    What depends on place or heading is driven once more, from the poses at which its own track lies so: a
    guess has the heading of the track, and a robot that slides down a slope points elsewhere.
    """
    told = predictions(asks, model, candidates, jobs)
    fixed = [candidates.any_world_fixed({**model.effects, **ask.effects}) for ask in asks]
    again = dict[int, Ask]()
    for i, (ask, y) in enumerate(zip(asks, told, strict=True)):
        if y is not None and fixed[i]:
            start = ask.log.start if ask.start is None else ask.start
            again[i] = dataclasses.replace(ask, start=settled_start(ask.log, y, start))
    for i, y in zip(again, predictions(list(again.values()), model, candidates, jobs), strict=True):
        told[i] = y
    return [None if y is None else settled(ask.log, y) for ask, y in zip(asks, told, strict=True)]


def predictions(
    asks: Sequence[Ask], model: Model, candidates: Candidates, jobs: int = 1
) -> list[list[Array] | None]:
    """Channels of what is asked, side by side; None in place of a run that diverged.

    Those that differ in the sensors alone, of the same log and from the same array of poses, share a run.
    Every answer is what it is alone.
    """
    sets = [{**model.effects, **ask.effects} for ask in asks]
    starts = [ask.log.start if ask.start is None else ask.start for ask in asks]
    alike: dict[tuple[int, Moved, int], list[int]] = {}
    for i, (ask, some, start) in enumerate(zip(asks, sets, starts, strict=True)):
        alike.setdefault((id(ask.log), what_moves(candidates, some), id(start)), []).append(i)
    runs, moved = list(alike.values()), [key[1] for key in alike]
    sensors = {id(a.log): Sensors(a.log, model, candidates, samples_of(a.log, 1)) for a in asks}
    tasks = list[tuple[tuple[str, ...], list[int]]]()
    for company in _companies([asks[some[0]].log for some in runs]):
        apart = graphs(candidates, [moved[run] for run in company])
        for group, mine in apart.items():
            size = min(TOGETHER, -(-len(mine) // jobs)) if len(apart) == 1 else TOGETHER
            whose = [company[i] for i in mine]
            tasks += [(group, whose[k : k + size]) for k in range(0, len(whose), size)]
    out: list[list[Array] | None] = [None] * len(asks)

    def one(task: tuple[tuple[str, ...], list[int]]) -> None:
        group, some = task
        first = [runs[run][0] for run in some]
        asked = [(asks[i].log, dict(moved[run]), starts[i]) for i, run in zip(first, some, strict=True)]
        lanes = lanes_of(asked, model, candidates, group)
        for run, lane, x in zip(some, lanes, driven(lanes), strict=True):
            for i in runs[run] if np.isfinite(x).all() else ():
                y = sensors[id(lane.log)].read(x, lane.plant, lane.inputs, in_time(sets[i]), group)
                rows = late_layout(lane.log, sets[i], layout(lane.log))
                by_channel = zip(lane.log.observed, rows, strict=True)
                out[i] = [means(at, _channel(y, o.channel)) for o, at in by_channel]

    with ThreadPoolExecutor(jobs) as threads:
        list(threads.map(one, tasks))
    return out


def _companies(logs: Sequence[PreparedLog]) -> list[list[int]]:
    """Runs, by number, that may go side by side: those on one ground, and those of each log on several."""
    out: dict[int, list[int]] = {}
    for i, log in enumerate(logs):
        out.setdefault(id(log) if len(log.labels) > 1 else 0, []).append(i)
    return list(out.values())


def drive(
    log: PreparedLog, model: Model, candidates: Candidates, start: Array, only: Collection[str] | None = None
) -> Drive:
    """The twin's run at the model's own effects, with its derivatives.

    Args:
        only: keys of the columns that are wanted, the others stay zero; None: all.

    Raises:
        TerrafusionError: the run diverged.
    """
    sets = {AS_IT_IS: dict(model.effects)}
    steps = {k: _step(candidates, i, model.effects.get(k, 0.0)) for i, k in enumerate(candidates.keys)}
    for k, step in steps.items():
        if only is None or k in only:
            sets[k] = {**model.effects, k: model.effects.get(k, 0.0) + step}
    fine, coarse, read = _readings(log, model, candidates, start, sets)
    y = read[AS_IT_IS]
    change = np.zeros((*y.shape, len(candidates.keys)))
    for i, k in enumerate(candidates.keys):
        if k in read:
            change[:, :, i] = (read[k] - y) * (candidates.scale[i] / steps[k])
    failed = ~np.isfinite(change).all(axis=(0, 1))
    change[:, :, failed] = 0.0  # a step that makes the twin diverge says nothing
    return Drive(start, fine, y, change, _by_pose(log, coarse, y), coarse[:, INDEX["yaw"]])


def _readings(
    log: PreparedLog,
    model: Model,
    candidates: Candidates,
    start: Array,
    sets: Mapping[str, Mapping[str, float]],
) -> tuple[Array, Array, dict[str, Array]]:
    """Outputs of the twin as it is at every grid sample, its states (n, X) at every `EVERY`-th, and there the
    outputs (n, Y) with each set of effects."""
    sensors, read = Sensors(log, model, candidates, samples_of(log, EVERY)), dict[str, Array]()
    for group in groups(candidates):
        keys = [k for k in group if k in sets]
        whole = AS_IT_IS in keys
        lanes = lanes_of([(log, sets[k], start) for k in keys], model, candidates, group)
        states = driven(lanes, 1 if whole else EVERY) if keys else []
        if whole:
            if not np.isfinite(states[0]).all():
                raise TerrafusionError(
                    "the twin diverges on this log",
                    file=log.name,
                    remedy="check the vehicle's and the soil's numbers",
                )
            every = Sensors(log, model, candidates, samples_of(log, 1))
            fine = every.read(states[0], lanes[0].plant, lanes[0].inputs, sets[AS_IT_IS])
            states = [x[among_all(log)] for x in states]
            coarse, twin = states[0], lanes[0]
        for k, x, lane in zip(keys, states, lanes, strict=True):
            read[k] = sensors.read(x, lane.plant, lane.inputs, sets[k], group)
    for k in sets.keys() - read.keys():  # effects of the sensors alone
        read[k] = sensors.read(coarse, twin.plant, twin.inputs, sets[k])
    return fine, coarse, read


def placed(log: PreparedLog, found: Sequence[Signature], old: Array, new: Array) -> list[Signature]:
    """Signatures of the channels of the log from other poses (W, 3) at the windows' starts than the old ones:
    on a level plane the drive shifts and turns as a whole."""
    if np.array_equal(old, new):
        return list(found)
    at, out = {o.channel: i for i, o in enumerate(log.observed)}, list(found)
    of = [np.clip(window_of(o, log.windows), 0, len(log.windows) - 1) for o in log.observed]
    turn = new[:, 2] - old[:, 2]
    for pair in PAIRS:
        if not all(channel in at for channel in pair):
            continue
        east, north = (at[channel] for channel in pair)
        k = of[east]
        shift = (old[k, :2], new[k, :2]) if pair == PAIRS[0] else (np.zeros((1, 2)), np.zeros((1, 2)))
        cos, sin = np.cos(turn[k]), np.sin(turn[k])
        a, b = found[east], found[north]
        x, y = a.value - shift[0][:, 0], b.value - shift[0][:, 1]
        for i, s, (p, q), to in (
            (east, a, (cos, -sin), shift[1][:, 0]), (north, b, (sin, cos), shift[1][:, 1])
        ):  # fmt: skip
            by_pose = s.by_pose.copy()  # by x and y it is the same in all poses
            by_pose[:, 2] = p * a.by_pose[:, 2] + q * b.by_pose[:, 2]
            change = p[:, None] * a.change + q[:, None] * b.change
            out[i] = Signature(p * x + q * y + to, change, by_pose, s.heading)
    return [dataclasses.replace(s, heading=s.heading + turn[k]) for s, k in zip(out, of, strict=True)]


def signatures(log: PreparedLog, drive: Drive) -> list[Signature]:
    """Every channel of the log as the twin has it: means over the rows' own intervals."""
    rows, out = layout(log), []
    for observed, fine, coarse in zip(log.observed, rows.fine, rows.coarse, strict=True):
        value = means(fine, _channel(drive.fine, observed.channel))
        change, by_pose = (
            means(coarse, _channel(part, observed.channel)) for part in (drive.change, drive.by_pose)
        )
        out.append(Signature(value, change, by_pose, drive.heading[coarse[0][:, 2]]))
    return out


def _channel(outputs: Array, channel: str) -> Array:
    """A channel (N, ...) of the outputs (N, Y, ...)."""
    columns = _OUTPUTS[channel]
    return outputs[:, columns[0]] if len(columns) == 1 else np.asarray(outputs[:, columns].mean(axis=1))


def _step(candidates: Candidates, i: int, at: float) -> float:
    """Step of one parameter, in its unit, towards where its range leaves room."""
    step = STEP * float(candidates.scale[i])
    return step if at + step <= candidates.high[i] else -step


def _by_pose(log: PreparedLog, states: Array, y: Array) -> Array:
    """Derivatives (N, Y, 3) of the outputs by x, y and yaw of the window's start: the run shifts and
    turns."""
    out = np.zeros((*y.shape, 3))
    east, north, v_e, v_n = (
        OUTPUTS.index(n) for n in ("gnss_east_m", "gnss_north_m", "gnss_v_e_mps", "gnss_v_n_mps")
    )
    counts = coarse_counts(log)
    begin = np.repeat(np.cumsum(counts) - counts, counts)
    out[:, east, 0] = out[:, north, 1] = 1.0
    out[:, east, 2] = states[begin, INDEX["y"]] - y[:, north]
    out[:, north, 2] = y[:, east] - states[begin, INDEX["x"]]
    out[:, v_e, 2], out[:, v_n, 2] = -y[:, v_n], y[:, v_e]
    return out
