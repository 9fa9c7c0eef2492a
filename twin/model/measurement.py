"""Measurement model of all sensors, as expressions in the same graph as the motion.

y = h(x, u, vehicle, soil, effects, mounting): the instant values of `OUTPUTS`, without noise. The
accelerations come from the right-hand side itself, so h and its derivatives by states, parameters and
effects are exact. A sensor model that reports means over an interval differs from these by what
changes within the interval.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.dynamics import ARGUMENTS, ModelGraph, graph, origin_velocity
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import INDEX, INPUTS, MOUNTING, OUTPUTS, VEHICLE_PARAMETERS, WHEELS

_NAMES = [*ARGUMENTS, "mounting"]


class Jacobians(NamedTuple):
    """Derivatives of the outputs (N, Y, ...) by states (X), vehicle (V), soil (4 S) and effects (E)."""

    states: Array
    vehicle: Array
    soil: Array
    effects: Array


@functools.cache
def measurement(effects: tuple[str, ...] = ()) -> Any:
    """The CasADi `Function` h(x, u, vehicle, soil, effects, mounting) -> y.

    Arguments are those of `dynamics.rhs` and `MOUNTING`, y is in the order of `OUTPUTS`.

    Raises:
        ConfigError: an effect is unknown.
    """
    import casadi as ca

    arguments, outputs = _expressions(effects)
    return ca.Function("tf_measurement", arguments, [outputs], _NAMES, ["y"], {"cse": True})


@functools.cache
def measurement_jacobian(effects: tuple[str, ...] = ()) -> Any:
    """The CasADi `Function`, arguments as `measurement`, of dy/dx, dy/dvehicle, dy/dsoil and dy/deffects."""
    import casadi as ca

    arguments, outputs = _expressions(effects)
    by = [ca.densify(ca.jacobian(outputs, arguments[i])) for i in (0, 2, 3, 4)]
    names = ["y_x", "y_vehicle", "y_soil", "y_effects"]
    return ca.Function("tf_measurement_jacobian", arguments, by, _NAMES, names, {"cse": True})


@functools.cache
def correction(effects: tuple[str, ...] = ()) -> Any:
    """The CasADi `Function` of the arguments of `measurement`: what effects add to the readings of a motion.

    The difference between the outputs and what sensors without any effect would read of the same motion,
    that is of the same states and accelerations of the body.
    """
    import casadi as ca

    g = graph(effects)
    arguments, outputs = _expressions(effects)
    plain = g.quantities | {name: g.arguments[2][i] for i, name in enumerate(VEHICLE_PARAMETERS)}
    plain |= {name: g.quantities[name] for name in ("cg_forward_m", "cg_left_m")}
    mounting = {name: arguments[-1][i] for i, name in enumerate(MOUNTING)}
    wheels = [plain | {name: w[name] for name in ("torque", "wheel_speed")} for w in g.wheels]
    read = _readings(g, plain, wheels, mounting)
    difference = outputs - ca.vertcat(*(read[name] for name in OUTPUTS))
    return ca.Function("tf_correction", arguments, [difference], _NAMES, ["y"], {"cse": True})


def measured(
    states: Array,
    inputs: Array,
    vehicle: Array,
    soil: Array,
    mounting: Array,
    effects: Mapping[str, float] | None = None,
) -> Array:
    """Outputs (N, Y) of many samples at once.

    Args:
        states, inputs: (N, X) and (N, U).
        vehicle: (V,) `VEHICLE_PARAMETERS`.
        soil: (4 S,) or (N, 4 S) `SOIL_PARAMETERS` wheel by wheel.
        mounting: `MOUNTING` (see `vectors.mounting_vector`).
        effects: values of optional parameters by name; each that is named is in the graph.
    """
    names = tuple(sorted(effects or {}))
    return _columns(measurement(names), states, inputs, vehicle, soil, mounting, effects or {})[0][:, :, 0]


def measured_jacobians(
    states: Array,
    inputs: Array,
    vehicle: Array,
    soil: Array,
    mounting: Array,
    effects: Mapping[str, float] | None = None,
) -> Jacobians:
    """Derivatives of `measured` at the same arguments."""
    names = tuple(sorted(effects or {}))
    function = measurement_jacobian(names)
    return Jacobians(*_columns(function, states, inputs, vehicle, soil, mounting, effects or {}))


def corrections(
    states: Array, inputs: Array, vehicle: Array, soil: Array, mounting: Array, effects: Mapping[str, float]
) -> Array:
    """`correction` (N, Y) at many samples; arguments as for `measured`."""
    names = tuple(sorted(effects))
    return _columns(correction(names), states, inputs, vehicle, soil, mounting, effects)[0][:, :, 0]


def rolling(states: Array, inputs: Array, plant: Plant) -> tuple[Array, Array]:
    """Speed (N, 4) of each wheel's rim and of its hub along it, m/s, as the plant's effects have them."""
    ground = np.tile(plant.route.soil[0], len(WHEELS))  # they do not depend on it
    effects = {name: plant.effects[name] for name in plant.effect_names()}
    function, mounting = _rolling(tuple(effects)), np.zeros(len(MOUNTING))
    rim, hub = _columns(function, states, inputs, plant.vehicle, ground, mounting, effects)
    return rim[:, :, 0], hub[:, :, 0]


@functools.cache
def _rolling(effects: tuple[str, ...]) -> Any:
    import casadi as ca

    speeds = [ca.vertcat(*(w[name] for w in graph(effects).wheels)) for name in ("rim_mps", "hub_x_mps")]
    arguments = _expressions(effects)[0]
    return ca.Function("tf_rolling", arguments, speeds, _NAMES, ["rim", "hub"], {"cse": True})


def _columns(
    function: Any,
    states: Array,
    inputs: Array,
    vehicle: Array,
    soil: Array,
    mounting: Array,
    effects: Mapping[str, float],
) -> list[Array]:
    """Results (N, rows, columns) of a function whose arguments are one column a sample."""
    values = np.array([effects[name] for name in sorted(effects)], dtype=float)
    ground = np.asarray(soil, dtype=float).T
    results = function.call([states.T, inputs.T, vehicle, ground, values, mounting])
    count = len(states)
    return [
        result.full().reshape(function.size1_out(i), count, function.size2_out(i)).transpose(1, 0, 2)
        for i, result in enumerate(results)
    ]


@functools.cache
def _expressions(effects: tuple[str, ...]) -> tuple[list[Any], Any]:
    """Symbols of the arguments and the outputs (Y,)."""
    import casadi as ca

    g = graph(effects)
    symbols = ca.SX.sym("mounting", len(MOUNTING))
    mounting = g.terms.apply(
        "mounting", g.quantities | dict(zip(MOUNTING, ca.vertsplit(symbols), strict=True))
    )
    read = _readings(g, g.quantities, g.wheels, mounting)
    felt = {f"specific_force_{axis}_mps2": read[f"accel_{axis}_mps2"] for axis in ("x", "y")}
    q = g.terms.apply("measurement", _known(g) | felt | read)
    if g.terms.at("stamp"):
        q = g.terms.apply("stamp", q | _rates(g, q))
    return [*g.arguments, symbols], ca.vertcat(*(q[name] for name in OUTPUTS))


def _known(g: ModelGraph) -> dict[str, Any]:
    """What a sensor's error may depend on besides the outputs: all of the body, and means over the wheels."""
    means = {name: sum(w[name] for w in g.wheels) / len(g.wheels) for name in ("rim_mps", "slip")}
    play = {f"d_play_{name}": w["d_play"] for name, w in zip(WHEELS, g.wheels, strict=True)}
    return g.quantities | means | play


def _readings(
    g: ModelGraph, q: Mapping[str, Any], wheels: list[dict[str, Any]], mounting: Mapping[str, Any]
) -> dict[str, Any]:
    """Outputs by name of ideal sensors."""
    from terrafusion.twin.physics.motors import motor_current

    origin = origin_velocity(dict(q))
    current = [motor_current(w, w["torque"], w["wheel_speed"]) for w in wheels]
    speed = [w["wheel_speed"] for w in wheels]
    east, north, v_east, v_north = _antenna(g, q, origin, mounting)
    accel_x, accel_y = _specific_force(g, q, mounting)
    return {
        "wheel_left_radps": 0.5 * (speed[0] + speed[2]),
        "wheel_right_radps": 0.5 * (speed[1] + speed[3]),
        "yaw_rate_radps": q["r"],
        "accel_x_mps2": accel_x,
        "accel_y_mps2": accel_y,
        "gnss_east_m": east,
        "gnss_north_m": north,
        "gnss_v_e_mps": v_east,
        "gnss_v_n_mps": v_north,
        "current_left_a": current[0] + current[2],
        "current_right_a": current[1] + current[3],
        "speed_mps": origin[0],
        "side_speed_mps": origin[1],
    }


def _specific_force(g: ModelGraph, q: Mapping[str, Any], mounting: Mapping[str, Any]) -> tuple[Any, Any]:
    """Specific force at the IMU along body x and y, m/s2: acceleration of its point less gravity.

    a = dv/dt + w x v + dw/dt x l + w x (w x l), l from the centre of gravity, whose v the states hold.
    """
    du, dv, dr = (g.derivative[INDEX[name]] for name in ("u", "v", "r"))
    lever_x, lever_y = mounting["imu_x_m"] - q["cg_forward_m"], mounting["imu_y_m"] - q["cg_left_m"]
    square = q["r"] * q["r"]
    accel_x = du - q["r"] * q["v"] - dr * lever_y - square * lever_x
    accel_y = dv + q["r"] * q["u"] + dr * lever_x - square * lever_y
    gravity_x = q["cos_yaw"] * q["gravity_x_mps2"] + q["sin_yaw"] * q["gravity_y_mps2"]
    gravity_y = -q["sin_yaw"] * q["gravity_x_mps2"] + q["cos_yaw"] * q["gravity_y_mps2"]
    return accel_x - gravity_x, accel_y - gravity_y


def _antenna(
    g: ModelGraph, q: Mapping[str, Any], origin: tuple[Any, Any], mounting: Mapping[str, Any]
) -> list[Any]:
    """East and north of the antenna, m, and its velocity, m/s.

    The plane's tilt follows from gravity as the `vehicle` argument gives it: an effect that tilts gravity
    leaves the map as it is (the difference is of second order, 1 - cos).
    """
    cos, sin = q["cos_yaw"], q["sin_yaw"]
    x, y = mounting["antenna_x_m"], mounting["antenna_y_m"]
    across = (q["x"] + cos * x - sin * y, q["y"] + sin * x + cos * y, mounting["antenna_z_m"])
    u, v = origin[0] - q["r"] * y, origin[1] + q["r"] * x
    moving = (cos * u - sin * v, sin * u + cos * v, 0.0)
    given = dict(
        zip(VEHICLE_PARAMETERS, (g.arguments[2][i] for i in range(len(VEHICLE_PARAMETERS))), strict=True)
    )
    rows = plane_to_world(given)
    return [
        sum(a * b for a, b in zip(row, vector, strict=True)) for vector in (across, moving) for row in rows
    ]


def plane_to_world(p: Mapping[str, Any]) -> list[tuple[Any, Any, Any]]:
    """East and north rows of the rotation from the plane's axes to the world, see `motion.plane_rotation`.

    Its last row is what gravity shows along the plane's axes; the least rotation with that row is unique.
    """
    sx, sy = -p["gravity_x_mps2"] / GRAVITY_MPS2, -p["gravity_y_mps2"] / GRAVITY_MPS2
    share = 1.0 / (1.0 + p["gravity_normal_mps2"] / GRAVITY_MPS2)
    return [(1.0 - sx * sx * share, -sx * sy * share, -sx), (-sx * sy * share, 1.0 - sy * sy * share, -sy)]


def _rates(g: ModelGraph, q: Mapping[str, Any]) -> dict[str, Any]:
    """Time derivative `d_<output>` of each output along the motion, by AD."""
    import casadi as ca

    x, u = g.arguments[:2]
    speeds = 2  # the inputs are speeds, then their rates, which are taken as constant as steering angles are
    direction = ca.vertcat(g.derivative, u[speeds : 2 * speeds], ca.SX.zeros(len(INPUTS) - speeds))
    rates = ca.jtimes(ca.vertcat(*(q[name] for name in OUTPUTS)), ca.vertcat(x, u), direction)
    return {f"d_{name}": rates[i] for i, name in enumerate(OUTPUTS)}
