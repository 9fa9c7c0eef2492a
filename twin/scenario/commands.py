"""From a scenario to driven states: command limits, side speeds, dead time, steering by waypoints."""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.effects.steered import wheel_path
from terrafusion.twin.engine.integrate import integrate
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import ENDS, ENERGIES, INDEX, INPUTS, SIDES, STATES, state_slice
from terrafusion.twin.scenario.scenario import Scenario

SETTLE_S = 10.0
"""The robot stands this long before the run starts: it starts in equilibrium."""
STEERING_PERIOD_S = 0.1
WAYPOINT_REACHED_M = 0.5
LOOK_AHEAD_M = 1.5
STEERING_GAIN_PER_S = 1.5
MAX_STEERING_RADPS = 0.8
SLOWEST_TURN = 0.3
"""Share of the speed at which a vehicle that cannot turn on the spot turns to a waypoint behind it."""
SLEW_STEP_S = 0.01
"""Commands are brought within the limit of acceleration at about this interval: that of a log's replay."""
STANDING_MPS = 0.02
MOST_TURN = 1.6
"""Most of curvature times track: the wheels inside of a curve stay ahead of its centre."""


@dataclass(frozen=True, eq=False)
class DrivenStates:
    """Commanded twist (N, 2) before the vehicle's limits, inputs of the model (N, U), states (N, X)."""

    commanded: Array
    inputs: Array
    states: Array


def within_limit(commanded: Array, dt_s: float, scenario: Scenario, start_mps: float = 0.0) -> Array:
    """Commands (N, 2) within the scenario's own limit of acceleration: what the robot is sent, and logs."""
    out = commanded.copy()
    if math.isfinite(scenario.max_accel_mps2):
        out[:, 0] = follow(commanded[:, 0], scenario.max_accel_mps2 * dt_s, start_mps)
    return out


def limit_slew(commanded: Array, dt_s: float, vehicle: VehicleParams, start: Array) -> Array:
    """Twist (N, 2) that follows `commanded` within the vehicle's limits of speed and acceleration, from
    `start` (2,)."""
    drive = vehicle.drive
    steps = (drive.max_accel_mps2 * dt_s, drive.max_yaw_accel_radps2 * dt_s)
    goal_v = np.clip(commanded[:, 0], -drive.max_speed_mps, drive.max_speed_mps)
    goals = zip((goal_v, commanded[:, 1]), steps, start.tolist(), strict=True)
    return np.stack([follow(goal, step, first) for goal, step, first in goals], axis=1)


def follow(goal: Array, step: float, start: float) -> Array:
    """The goal (N,), approached from `start` by at most `step` a sample."""
    out = np.array(goal, dtype=float)
    behind = np.flatnonzero(np.abs(np.diff(goal, prepend=start)) > step).tolist()
    targets, done = out.tolist(), 0
    for first in behind:  # elsewhere the goal is met as it stands
        if first < done:
            continue
        now = start if first == 0 else targets[first - 1]
        for i in range(first, len(targets)):
            missing = targets[i] - now
            done = i + 1
            if -step <= missing <= step:
                break
            now += step if missing > 0.0 else -step
            out[i] = now
    return out


def _parts(dt_s: float) -> int:
    """How many steps of about `SLEW_STEP_S` one sample is."""
    return max(1, round(dt_s / SLEW_STEP_S))


def side_speeds(twist: Array, vehicle: VehicleParams) -> Array:
    """Wheel speeds (N, 2) of left and right, rad/s, by the robot's own odometry geometry.

    Of a steered vehicle both are that of the body origin: the model tells each wheel's own from the angles.
    """
    half = 0.5 * vehicle.odometry.track_m * twist[:, 1]
    if vehicle.steered() is not None:
        half = np.zeros_like(half)
    return np.stack([twist[:, 0] - half, twist[:, 0] + half], axis=1) / vehicle.odometry.wheel_radius_m


def steering_angles(twist: Array, dt_s: float, vehicle: VehicleParams, start: float = 0.0) -> Array:
    """Angle (N,) of the front wheels, rad (bicycle model), by which a steered vehicle follows twists (N, 2).

    The curvature is yaw rate over speed as commanded (within the limits of acceleration both change apart),
    within those of the angle and of its rate, from the angle `start`; below `STANDING_MPS` the angle stays.
    """
    steering = vehicle.steered()
    if steering is None:
        return np.zeros(len(twist))
    share = 0.5 if vehicle.drive.type == "four_wheel_steer" else 1.0
    most = min(
        math.tan(steering.max_angle_rad) / share / vehicle.body.wheelbase_m, MOST_TURN / vehicle.body.track_m
    )
    moving = np.abs(twist[:, 0]) >= STANDING_MPS
    curvature = np.divide(twist[:, 1], twist[:, 0], out=np.zeros(len(twist)), where=moving)
    goal = np.arctan(np.clip(curvature, -most, most) * vehicle.body.wheelbase_m * share)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(twist)), -1))
    goal = np.where(last >= 0, goal[last], start)
    return follow(goal, steering.max_rate_radps * dt_s, start)


def axle_angles(front_rad: Array, vehicle: VehicleParams) -> Array:
    """Angles (N, 2) of the front and of the rear axle, rad, of the front angles (N,)."""
    rear = -front_rad if vehicle.drive.type == "four_wheel_steer" else np.zeros_like(front_rad)
    return np.stack([front_rad, rear], axis=1)


def wheel_angles(inputs: Array, vehicle: VehicleParams) -> Array:
    """Angles (N, 4) of the wheels, rad, under inputs (N, U)."""
    front, rear = (np.tan(inputs[:, INPUTS.index(f"steer_{end}_rad")])[:, None] for end in ("front", "rear"))
    body = vehicle.body
    x, y = 0.5 * body.wheelbase_m * np.array(ENDS), 0.5 * body.track_m * np.array(SIDES)
    along, across = wheel_path(front, rear, body.wheelbase_m, x, y)
    return np.arctan2(across, along)


def delayed_inputs(sides: Array, dt_s: float, dead_time_s: float = 0.0, axles: Array | None = None) -> Array:
    """Inputs (N, U), in the order of `layout.INPUTS`, of side speeds (N, 2), rad/s, after a dead time.

    `axles` (N, 2) are steering angles of front and rear, rad, which are as late; None for none.

    Linear between samples; the first sample holds before it. The rates are those of the interval that
    ends at the delayed time: the derivative of the input by the dead time is minus the rate.
    """
    steps = np.diff(sides, axis=0, prepend=sides[:1]) / dt_s
    axles = np.zeros((len(sides), 2)) if axles is None else axles
    if dead_time_s == 0.0:
        return np.hstack([sides, steps, axles])
    count = len(sides)
    at = np.arange(count) - dead_time_s / dt_s
    whole = np.clip(np.ceil(at).astype(int), 0, count - 1)
    late, turned = (
        np.stack([np.interp(at, np.arange(count), column) for column in columns.T], axis=1)
        for columns in (sides, axles)
    )
    return np.hstack([late, np.where(at[:, None] > 0.0, steps[whole], 0.0), turned])


def settling(scenario: Scenario, dt_s: float) -> tuple[Array, Array]:
    """State (X,) and inputs (N + 1, U) from which the robot settles for `SETTLE_S`."""
    x0 = np.zeros(len(STATES))
    x0[INDEX["yaw"]] = math.radians(scenario.heading_deg)
    return x0, np.zeros((max(1, round(SETTLE_S / dt_s)) + 1, len(INPUTS)))


def settled(scenario: Scenario, state: Array) -> Array:
    """The state (X,) after settling, moved back to the origin with nothing driven yet."""
    x = state.copy()
    for name in ("x", "y", "travel", "clog", "elapsed", *ENERGIES):
        x[INDEX[name]] = 0.0
    x[state_slice("wheel_angle")] = 0.0
    x[INDEX["yaw"]] = math.radians(scenario.heading_deg)
    return x


def open_loop(scenario: Scenario, t_s: Array, vehicle: VehicleParams) -> tuple[Array, Array]:
    """Commanded twist (N, 2) and inputs (N, U) of a scenario without waypoints."""
    dt = float(t_s[-1]) / (len(t_s) - 1)
    parts = _parts(dt)
    fine_s = np.interp(np.arange((len(t_s) - 1) * parts + 1) / parts, np.arange(len(t_s)), t_s)
    sent = within_limit(scenario.commanded(fine_s), dt / parts, scenario)
    twist = limit_slew(sent, dt / parts, vehicle, np.zeros(2))[::parts]
    commanded = sent[::parts]
    axles = axle_angles(steering_angles(commanded, dt, vehicle), vehicle)
    return commanded, delayed_inputs(side_speeds(twist, vehicle), dt, vehicle.drive.dead_time_s, axles)


def drive(
    scenario: Scenario, t_s: Array, vehicle: VehicleParams, plant: Plant, backend: str = "auto"
) -> DrivenStates:
    """Settle at the start, then drive the scenario at the samples t_s (N,), uniformly spaced from 0."""
    dt_s = 1.0 / vehicle.sensors.imu.rate_hz
    x0, rest = settling(scenario, float(t_s[-1]) / (len(t_s) - 1))
    start = settled(scenario, integrate(x0, rest, dt_s, plant, t0_s=-SETTLE_S, backend=backend)[-1])
    if scenario.waypoints:
        return _steer(scenario, t_s, vehicle, plant, backend, start)
    commanded, inputs = open_loop(scenario, t_s, vehicle)
    return DrivenStates(commanded, inputs, integrate(start, inputs, dt_s, plant, backend=backend))


def _steer(
    scenario: Scenario, t_s: Array, vehicle: VehicleParams, plant: Plant, backend: str, start: Array
) -> DrivenStates:
    """Steer along the waypoints by the true pose, renewed every `STEERING_PERIOD_S`."""
    dt, dt_s = float(t_s[-1]) / (len(t_s) - 1), 1.0 / vehicle.sensors.imu.rate_hz
    period, reach = max(1, round(STEERING_PERIOD_S / dt)), math.ceil(vehicle.drive.dead_time_s / dt) + 2
    points = np.array([(0.0, 0.0), *scenario.waypoints])
    states, commanded = np.empty((len(t_s), len(STATES))), np.empty((len(t_s), 2))
    states[0], commanded[0] = start, 0.0
    twists, front = np.zeros((len(t_s), 2)), np.zeros(len(t_s))
    goal, first, parts = 1, 0, _parts(dt)
    while first < len(t_s) - 1:
        last = min(first + period, len(t_s) - 1)
        pose = states[first, :3]
        while goal < len(points) and np.hypot(*(points[goal] - pose[:2])) < WAYPOINT_REACHED_M:
            goal += 1
        least = SLOWEST_TURN if vehicle.steered() else 0.0
        twist = _towards(points, goal, pose, scenario.waypoint_speed_mps, least)
        rows = slice(first + 1, last + 1)
        # The new twist holds from the next sample on.
        held = np.repeat([commanded[first], twist], [parts - 1, (last - first - 1) * parts + 1], axis=0)
        sent = within_limit(held, dt / parts, scenario, float(commanded[first, 0]))
        commanded[rows] = sent[parts - 1 :: parts]
        twists[rows] = limit_slew(sent, dt / parts, vehicle, twists[first])[parts - 1 :: parts]
        front[rows] = steering_angles(commanded[rows], dt, vehicle, float(front[first]))
        known = max(0, first - reach)
        some = slice(known, last + 1)
        sides, axles = side_speeds(twists[some], vehicle), axle_angles(front[some], vehicle)
        inputs = delayed_inputs(sides, dt, vehicle.drive.dead_time_s, axles)
        t0_s = float(t_s[first])
        states[first : last + 1] = integrate(
            states[first], inputs[first - known :], dt_s, plant, t0_s=t0_s, backend=backend
        )
        first = last
    axles = axle_angles(front, vehicle)
    inputs = delayed_inputs(side_speeds(twists, vehicle), dt, vehicle.drive.dead_time_s, axles)
    return DrivenStates(commanded, inputs, states)


def _towards(points: Array, goal: int, pose: Array, speed_mps: float, least: float = 0.0) -> Array:
    """Twist (2,) towards a point ahead on the leg that ends at `points[goal]`; rest after the last one.

    The speed falls with the error of the heading, to the share `least`.
    """
    if goal >= len(points):
        return np.zeros(2)
    leg = points[goal] - points[goal - 1]
    length = max(float(np.hypot(*leg)), 1e-9)
    along = float((pose[:2] - points[goal - 1]) @ leg) / length
    ahead = points[goal - 1] + leg / length * min(along + LOOK_AHEAD_M, length)
    bearing = math.atan2(*(ahead - pose[:2])[::-1]) - float(pose[2])
    error = math.remainder(bearing, 2.0 * math.pi)
    rate = min(max(STEERING_GAIN_PER_S * error, -MAX_STEERING_RADPS), MAX_STEERING_RADPS)
    return np.array([speed_mps * max(math.cos(error), least), rate])
