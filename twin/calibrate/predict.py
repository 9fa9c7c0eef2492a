"""Predicts the channels of a log with the twin, and their derivatives by every parameter.

Multiple shooting (Bock 1983) with the pose as the only free state: inner states (wheels, motors, soil under
the wheels) and their derivatives continue from one window into the next, while the pose of each window
starts from a guess that the fit corrects. So no error of the pose accumulates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.inputs import DT_S, MOVING_RADPS
from terrafusion.twin.calibrate.log import PreparedLog, window_of
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.calibrate.readings import readings
from terrafusion.twin.engine.sensitivity import Directions, integrate_with_sensitivity
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.physics.layout import INDEX, STATES, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.scenario.commands import delayed_inputs
from terrafusion.twin.sensors.effects import DEAD_TIME, as_driven

LEAD_S = 5.0
"""Run-up under the first input of a log, so that the twin starts in steady state."""
TRANSITION_S = 0.3
"""Two grounds join within this time."""
POSE = ("x", "y", "yaw")
FOLLOWING = ("torque_limit_nm", "stall_torque_nm", "loop_p_nms", "loop_i_nm", "lag_s", "dead_time_s")
"""Vehicle parameters that a stiff speed loop replaces where the twin follows measured wheels."""
_FOLLOWING_LAG_S, _FOLLOWING_RATE = 0.001, 80.0
"""Motor lag, s, and integral over proportional gain, 1/s, of that loop: it is late by milliseconds."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One channel as the twin predicts it.

    Attributes:
        value: (n,) at the rows of the channel.
        change: (n, P) derivative by the parameters, by pose (n, 3) that by the window's start.
    """

    value: Array
    change: Array
    by_pose: Array


def predict(log: PreparedLog, model: Model, names: Sequence[str], start: Array) -> list[Prediction]:
    """The channels of `log.observed` for the windows' starts (W, 3), with derivatives by the named numbers.

    Raises:
        TerrafusionError: the run diverged.
    """
    plant = plant_of(log, model)
    directions = _directions(log, model, plant, names)
    inputs = delayed_inputs(log.sides, DT_S, input_delay_s(log, model, model.effects))
    states, changes = _run(log, plant, directions, inputs, start)
    channels, samples = tuple(o.channel for o in log.observed), log.samples()
    t_s: Array = DT_S * samples.astype(float)
    values, by_direction = readings(channels, model, plant, directions, t_s, states, changes, inputs[samples])
    count, out = len(names), []
    for i, observed in enumerate(log.observed):
        at, weight = averaging(observed, log)
        change = np.einsum("nk,nkm->nm", weight, by_direction[at, i])
        value = np.einsum("nk,nk->n", weight, values[at, i])
        out.append(Prediction(value, change[:, :count], change[:, count:]))
    return out


def plant_of(log: PreparedLog, model: Model) -> Plant:
    """The plant that drives a log. Where the twin follows measured wheels its speed loop is stiff: critically
    damped with a short motor lag, and no limit of torque."""
    vehicle = model.vehicle_vector()
    if log.follows:
        at = {name: VEHICLE_PARAMETERS.index(name) for name in FOLLOWING}
        lag = min(float(vehicle[at["lag_s"]]), _FOLLOWING_LAG_S)
        gain = float(vehicle[VEHICLE_PARAMETERS.index("wheel_inertia_kgm2")]) / (4.0 * lag)
        vehicle[at["lag_s"]], vehicle[at["loop_p_nms"]] = lag, gain
        vehicle[at["loop_i_nm"]], vehicle[at["dead_time_s"]] = _FOLLOWING_RATE * gain, 0.0
        vehicle[VEHICLE_PARAMETERS.index("dead_time_applied_s")] = 0.0
        for name in ("torque_limit_nm", "stall_torque_nm"):
            vehicle[at[name]] *= 1000.0
    vehicle[VEHICLE_PARAMETERS.index("dead_time_applied_s")] += model.effects.get(DEAD_TIME, 0.0)
    return Plant(vehicle, route_of(log, model), {k: v for k, v in model.effects.items() if v != 0.0})


def input_delay_s(log: PreparedLog, model: Model, effects: Mapping[str, float]) -> float:
    """By how much the inputs of a log act late: dead time of the vehicle and of effects."""
    if log.follows:
        return effects.get(DEAD_TIME, 0.0)
    return as_driven(model.vehicle, effects).drive.dead_time_s


def _directions(log: PreparedLog, model: Model, plant: Plant, names: Sequence[str]) -> Directions:
    """The named numbers, then x, y and yaw of a start."""
    effects = [name.removeprefix("effects.") for name in names if name.startswith("effects.")]
    d = Directions.zeros(plant, len(names) + len(POSE), effects)
    ends = np.repeat(log.labels, 2).tolist()  # of each ground; those of the route are no knots
    knots = ends[1:-1] if len(log.labels) > 1 else ends[:1]
    for m, name in enumerate(names):
        if name.startswith("effects."):
            d.effects[name.removeprefix("effects.")][m] = 1.0
        elif name.startswith("vehicle."):
            d.vehicle[:, m] = model.vehicle_change(name)
        else:
            for k, label in enumerate(knots):
                d.soil[k, :, m] = model.soil_change(name, label)
    if log.follows:
        d.vehicle[[VEHICLE_PARAMETERS.index(name) for name in FOLLOWING]] = 0.0
    return d


def route_of(log: PreparedLog, model: Model) -> RouteTable:
    """The ground over the log's time."""
    vectors = np.array([soil_vector(model.soils[label]) for label in log.labels])
    transition_s = min(TRANSITION_S, 0.8 * float(np.min(np.diff(log.borders), initial=TRANSITION_S)))
    return RouteTable.joined("time", vectors, log.borders, transition_s)


def _run(log: PreparedLog, plant: Plant, d: Directions, inputs: Array, start: Array) -> tuple[Array, Array]:
    """States (N, X) at all samples of all windows, one after the other, and derivatives (N, X, M).

    A shift of the start shifts the run; without slope and effects a turn of the start turns it: these
    directions are not integrated. On a slope the heading of a window also enters the inner states of the
    next; that is neglected.
    """
    turns = not plant.effect_names(d.effects) and not plant.vehicle[_GRAVITY].any()
    chosen = np.arange(d.count - (len(POSE) if turns else len(POSE) - 1))
    chosen = chosen if turns else np.append(chosen, d.count - 1)
    run = part_of(d, chosen)
    x, S = led_in(log, plant, run, inputs)
    pose = [INDEX[name] for name in POSE]
    states, changes = [], []
    for (begin, end), guess in zip(log.windows, start, strict=True):
        x[pose], S[pose] = guess, 0.0
        if not turns:
            S[:, -1] = 0.0
            S[pose[-1], -1] = 1.0
        xs, Ss = integrate_with_sensitivity(
            x, inputs[begin : end + 1], DT_S, plant, Directions(S, run.vehicle, run.soil, run.effects),
            t0_s=begin * DT_S,
        )  # fmt: skip
        x, S = xs[-1].copy(), Ss[-1].copy()
        states.append(xs)
        changes.append(_with_pose(xs, Ss, d.count, chosen, turns))
    return np.concatenate(states), np.concatenate(changes)


_GRAVITY = [VEHICLE_PARAMETERS.index(name) for name in ("gravity_x_mps2", "gravity_y_mps2")]


def part_of(d: Directions, chosen: NDArray[np.int64]) -> Directions:
    """Some of the directions."""
    effects = {name: values[chosen] for name, values in d.effects.items()}
    return Directions(d.start[:, chosen], d.vehicle[:, chosen], d.soil[:, :, chosen], effects)


def _with_pose(xs: Array, Ss: Array, count: int, chosen: NDArray[np.int64], turns: bool) -> Array:
    """Derivatives (n, X, M), with those by the start pose that were not integrated in closed form."""
    out = np.zeros((len(xs), xs.shape[1], count))
    out[:, :, chosen] = Ss
    x, y, yaw = (INDEX[name] for name in POSE)
    out[:, x, count - 3] = out[:, y, count - 2] = 1.0
    if turns:
        out[:, x, -1], out[:, y, -1], out[:, yaw, -1] = xs[0, y] - xs[:, y], xs[:, x] - xs[0, x], 1.0
    return out


def led_in(log: PreparedLog, plant: Plant, d: Directions, inputs: Array) -> tuple[Array, Array]:
    """State (X,) and derivatives (X, M) at the first window, after the run-up."""
    x, before = run_up(log, plant, inputs)
    d = Directions(np.zeros((len(STATES), d.count)), d.vehicle, d.soil, d.effects)
    xs, Ss = integrate_with_sensitivity(x, before, DT_S, plant, d, t0_s=-LEAD_S)
    return xs[-1].copy(), Ss[-1].copy()


def run_up(log: PreparedLog, plant: Plant, inputs: Array) -> tuple[Array, Array]:
    """State (X,) `LEAD_S` before the log, and the inputs from there up to the first window."""
    x = np.zeros(len(STATES))
    x[INDEX["yaw"]], x[INDEX["elapsed"]] = log.start[0, 2], -LEAD_S
    first = np.zeros(len(inputs[0]))  # at rest, or the first command would have acted for `LEAD_S` already
    if np.abs(log.sides[0]).max() > MOVING_RADPS:
        first[:2] = inputs[0, :2]
        x[state_slice("wheel_speed")] = first[[0, 1, 0, 1]]
        x[INDEX["u"]] = first[:2].mean() * plant.vehicle[VEHICLE_PARAMETERS.index("radius_m")]
    before = np.tile(first, (round(LEAD_S / DT_S), 1))
    return x, np.vstack([before, inputs[: log.windows[0, 0] + 1]])


def averaging(
    observed: Observed, log: PreparedLog, window: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], Array]:
    """Stacked samples (n, k) that a row depends on, and their weights (n, k): its mean over its interval.

    Between samples the channel is a cubic (Keys 1981, a = -1/2), beyond the ends of a window a line: the
    mean is of fourth order in `DT_S`.
    `window` (n,) is that of each row; None: the one it lies in.
    """
    window = window_of(observed, log.windows) if window is None else window
    first, last = log.windows[window, :1], log.windows[window, 1:]
    a, b = observed.begin_s[:, None] / DT_S, observed.end_s[:, None] / DT_S
    at = np.floor(a + 1e-9).astype(np.int64) - 1 + np.arange(int(np.ceil(np.max(b - a, initial=0.0))) + 4)
    mean = (_kernel_integral(b - at) - _kernel_integral(a - at)) / np.maximum(b - a, 1e-12)
    weight = np.where(b - a > 1e-6, mean, _kernel(a - at))
    before, after = np.clip(first - at, 0, None) * weight, np.clip(at - last, 0, None) * weight
    inside = np.clip(at, first, last)
    # Straight on beyond an end: f(end + d) = (1 + d) f(end) - d f(end - 1), likewise before the start.
    columns = [inside, inside, np.broadcast_to(first + 1, at.shape), np.broadcast_to(last - 1, at.shape)]
    weights = [weight, before + after, -before, -after]
    return np.hstack(columns) - first + log.first_samples()[window][:, None], np.hstack(weights)


def _kernel(s: Array) -> Array:
    """Cubic convolution kernel (Keys 1981, eq. 4, a = -1/2)."""
    x = np.minimum(np.abs(s), 2.0)
    near = (1.5 * x - 2.5) * x * x + 1.0
    return np.where(x < 1.0, near, ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0)


def _kernel_integral(s: Array) -> Array:
    """Its integral from minus infinity to s."""
    x = np.minimum(np.abs(s), 2.0)
    near = ((0.375 * x - 5.0 / 6.0) * x * x + 1.0) * x
    far = (((-0.125 * x + 5.0 / 6.0) * x - 2.0) * x + 2.0) * x - 1.0 / 6.0
    return 0.5 + np.sign(s) * np.where(x < 1.0, near, far)
