"""The vehicle on its plane as one CasADi graph dx/dt = f(x, u, p).

The body moves in a plane of given slope; x and y are coordinates in that
plane, `yaw` the heading in it. `u`, `v`, `r` are the velocity of the centre
of gravity in body axes and the yaw rate. Soil and vehicle numbers enter as
parameters, so one compiled graph serves every soil and vehicle.

The graph is built in stages; at each of them optional effects may change the
quantities of that stage (see `effects.form.STAGES`).
"""

import functools
from dataclasses import dataclass
from typing import Any

from terrafusion.twin.physics.layout import (
    ENDS,
    INPUTS,
    SIDES,
    SOIL_PARAMETERS,
    STATES,
    VEHICLE_PARAMETERS,
    WHEELS,
)
from terrafusion.twin.physics.motors import battery, drawn_power, motor_current, motor_torque

ARGUMENTS = ("x", "u", "vehicle", "soil", "effects")


@dataclass(frozen=True, eq=False)
class ModelGraph:
    """The model as expressions.

    Attributes:
        arguments: CasADi symbols of `ARGUMENTS`.
        terms: the optional terms it was built with.
        quantities: everything known of the body by name (SI units).
        wheels: the same for each wheel.
        derivative: dx/dt (X,).
    """

    arguments: tuple[Any, ...]
    terms: Any
    quantities: dict[str, Any]
    wheels: list[dict[str, Any]]
    derivative: Any


@functools.cache
def rhs(effects: tuple[str, ...] = ()) -> Any:
    """The CasADi `Function` f(x, u, vehicle, soil, effects) -> dx/dt.

    x, u and vehicle are in the order of `STATES`, `INPUTS` and
    `VEHICLE_PARAMETERS`; soil holds `SOIL_PARAMETERS` four times, wheel by
    wheel; effects the values of the named optional parameters. A graph made
    without an optional parameter does not hold its term at all.

    Raises:
        ConfigError: an effect is unknown.
    """
    import casadi as ca

    g = graph(effects)
    return ca.Function("tf_rhs", list(g.arguments), [g.derivative], list(ARGUMENTS), ["dx"], {"cse": True})


@functools.cache
def graph(effects: tuple[str, ...] = ()) -> ModelGraph:
    """The model with the named optional parameters, as expressions."""
    import casadi as ca

    from terrafusion.twin.effects.catalogue import Terms

    x, u = ca.SX.sym("x", len(STATES)), ca.SX.sym("u", len(INPUTS))
    pv = ca.SX.sym("vehicle", len(VEHICLE_PARAMETERS))
    ps = ca.SX.sym("soil", len(SOIL_PARAMETERS), len(WHEELS))
    pe = ca.SX.sym("effects", len(effects))
    terms = Terms(effects, pe)

    q = {name: x[i] for i, name in enumerate(STATES)}
    q |= {name: u[i] for i, name in enumerate(INPUTS)}
    q |= {name: pv[i] for i, name in enumerate(VEHICLE_PARAMETERS)}
    q = terms.apply("vehicle", q)
    q |= _gravity_along_body(q)
    q = terms.apply("command", q | _commands(q))
    q = terms.apply("supply", q | _supply(q))
    q |= {f"lean_{axis}_mps2": q[f"gravity_body_{axis}_mps2"] for axis in ("x", "y")}
    forces, wheels = _ground_forces(q, ps, terms)
    if terms.at("loads"):  # which may depend on the forces under static loads
        q = terms.apply("loads", q | forces)
        forces, wheels = _ground_forces(q, ps, terms)
    q = terms.apply("body", q | forces)
    d = _derivatives(q, wheels, terms)
    if terms.at("body"):  # forces on the body from elsewhere than the wheels
        d["resistance_work"] = d["resistance_work"] + _power(forces, q) - _power(q, q)
    derivative = ca.vertcat(*(d[name] for name in STATES))
    return ModelGraph((x, u, pv, ca.vec(ps), pe), terms, q, wheels, derivative)


def wheel_positions(p: dict[str, Any]) -> list[tuple[Any, Any]]:
    """Wheel hubs (x, y) from the centre of gravity, body axes, in the order of `WHEELS`."""
    half_x, half_y = 0.5 * p["wheelbase_m"], 0.5 * p["track_m"]
    return [
        (end * half_x - p["cg_forward_m"], side * half_y - p["cg_left_m"])
        for end, side in zip(ENDS, SIDES, strict=True)
    ]


def wheel_loads(p: dict[str, Any], lean_x: Any, lean_y: Any) -> list[Any]:
    """Quasi-static wheel loads, N: weight shared by where the centre of gravity is and leans.

    `lean_x`, `lean_y` are gravity along body x and y, less acceleration where that counts, m/s2. A load is
    bounded above zero smoothly: the model does not tip over.
    """
    from terrafusion.twin.physics.smooth import smooth_max

    weight = p["mass_kg"] * p["gravity_normal_mps2"]
    lean_x = (p["cg_forward_m"] + p["cg_height_m"] * lean_x / p["gravity_normal_mps2"]) / p["wheelbase_m"]
    lean_y = (p["cg_left_m"] + p["cg_height_m"] * lean_y / p["gravity_normal_mps2"]) / p["track_m"]
    shares = [(0.5 + end * lean_x) * (0.5 + side * lean_y) for end, side in zip(ENDS, SIDES, strict=True)]
    return [smooth_max(weight * share, 1.0, 1.0) for share in shares]


def _gravity_along_body(q: dict[str, Any]) -> dict[str, Any]:
    import casadi as ca

    cos, sin = ca.cos(q["yaw"]), ca.sin(q["yaw"])
    return {
        "cos_yaw": cos,
        "sin_yaw": sin,
        "gravity_body_x_mps2": cos * q["gravity_x_mps2"] + sin * q["gravity_y_mps2"],
        "gravity_body_y_mps2": -sin * q["gravity_x_mps2"] + cos * q["gravity_y_mps2"],
    }


def _commands(q: dict[str, Any]) -> dict[str, Any]:
    """Commanded wheel speed of the sides, rad/s, its rate, and zero rates of the filter states."""
    late = q["dead_time_s"] - q["dead_time_applied_s"]
    out = {f"d_command_{kind}_{side}": 0.0 for kind in ("lag", "delay") for side in ("left", "right")}
    for side in ("left", "right"):
        rate = q[f"{side}_rate_radps2"]
        out |= {f"command_{side}_radps": q[f"{side}_radps"] - late * rate, f"command_{side}_radps2": rate}
    return out


def _supply(q: dict[str, Any]) -> dict[str, Any]:
    """Voltage of the battery over the motors' nominal one, and what its store gives."""
    power = sum(drawn_power(q, q[f"torque_{name}"], q[f"wheel_speed_{name}"]) for name in WHEELS)
    supply_v, taken_w, rate = battery(q, power, q["electric_energy"], q["sag_current"])
    return {
        "voltage_share": supply_v / q["supply_v"],
        "battery_power_w": power,
        "d_electric_energy": taken_w,
        "d_sag_current": rate,
    }


def _wheel(i: int, q: dict[str, Any], soil: list[Any], terms: Any) -> dict[str, Any]:
    """All quantities of one wheel: its corner of the body, its ground, its motor, its forces."""
    from terrafusion.twin.physics.terramechanics import WheelShape, following
    from terrafusion.twin.physics.wheel import WheelSoil, contact, slipping

    name, side, end = WHEELS[i], SIDES[i], ENDS[i]
    forward, left = wheel_positions(q)[i]
    w = {**q, "side": side, "end": end, "hub_forward_m": forward, "hub_left_m": left}
    w["load_n"] = wheel_loads(q, q["lean_x_mps2"], q["lean_y_mps2"])[i]
    states = ("wheel_speed", "shear_x", "shear_y", "torque", "speed_error", "brake", "play")
    w |= {state: q[f"{state}_{name}"] for state in states}
    w = terms.apply("corner", w)

    w["hub_x_mps"], w["hub_y_mps"] = q["u"] - q["r"] * w["hub_left_m"], q["v"] + q["r"] * w["hub_forward_m"]
    if "heading_cos" in w:  # from here on in axes of the wheel
        w["hub_x_mps"], w["hub_y_mps"] = _turned(
            w["heading_cos"], -w["heading_sin"], w["hub_x_mps"], w["hub_y_mps"]
        )
    w["rim_mps"] = w["wheel_speed"] * w["radius_m"]
    ahead, aside = w["hub_forward_m"] + q["cg_forward_m"], w["hub_left_m"] + q["cg_left_m"]
    w["wheel_x_m"] = q["x"] + q["cos_yaw"] * ahead - q["sin_yaw"] * aside
    w["wheel_y_m"] = q["y"] + q["sin_yaw"] * ahead + q["cos_yaw"] * aside
    hub = (w["hub_x_mps"], w["hub_y_mps"])
    w["slip_x_mps"], w["slip_y_mps"], w["transport_mps"], w["slip"] = slipping(w["rim_mps"], hub)
    w |= zip(SOIL_PARAMETERS, soil, strict=True)
    w["shear_x_m"], w["shear_y_m"] = w["shear_x"], w["shear_y"]
    w["following"] = following(*origin_velocity(q), q["wheelbase_m"], w["width_m"], end)
    w = terms.apply("ground", w)
    c = contact(
        WheelSoil(*(w[name] for name in SOIL_PARAMETERS)), w["load_n"], w["rim_mps"], hub,
        (w["shear_x_m"], w["shear_y_m"]), w["brake"], w["clog"],
        WheelShape(w["radius_m"], w["width_m"], w["grouser_height_m"], w["grouser_count"]), w["following"],
    )  # fmt: skip
    w |= c._asdict() | {"ground_slip": c.slip}
    for axis in ("x", "y"):  # a term may change the effective displacement, not its renewal
        w[f"shear_rate_{axis}"] = w[f"slip_{axis}_mps"] - w[f"shear_{axis}"] * c.renewal_per_s

    w["command_radps"] = q["command_left_radps"] if side > 0 else q["command_right_radps"]
    w["loop_speed_radps"], w["d_play"] = w["wheel_speed"], 0.0
    w = terms.apply("motor", w)
    error = w["command_radps"] - w["loop_speed_radps"]
    wanted, w["d_speed_error"] = motor_torque(
        w, w["wheel_speed"], error, w["speed_error"], w["voltage_share"]
    )
    w["d_torque"] = (wanted - w["torque"]) / w["lag_s"]
    w["current_a"] = motor_current(w, w["torque"], w["wheel_speed"])

    w["drive_torque_nm"], w["scrub_nm"] = w["torque"], 0.0
    w = terms.apply("wheel", w)
    w["push_x_n"], w["push_y_n"] = w["force_x_n"], w["force_y_n"]
    if "heading_cos" in w:
        w["push_x_n"], w["push_y_n"] = _turned(
            w["heading_cos"], w["heading_sin"], w["force_x_n"], w["force_y_n"]
        )
    return w


def _turned(cos: Any, sin: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """A vector turned about z."""
    return cos * x - sin * y, sin * x + cos * y


def _ground_forces(q: dict[str, Any], soils: Any, terms: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The wheels, and the sum of their forces on the body; soils (S, 4)."""
    rows = range(len(SOIL_PARAMETERS))
    wheels = [_wheel(i, q, [soils[k, i] for k in rows], terms) for i in range(len(WHEELS))]
    return _forces(wheels), wheels


def _forces(wheels: list[dict[str, Any]]) -> dict[str, Any]:
    """Sum of the wheels' forces on the body, N and N m about the centre of gravity."""
    force_x, force_y, moment = 0.0, 0.0, 0.0
    for w in wheels:
        force_x, force_y = force_x + w["push_x_n"], force_y + w["push_y_n"]
        moment = moment + w["hub_forward_m"] * w["push_y_n"] - w["hub_left_m"] * w["push_x_n"]
        moment = moment + w["scrub_nm"]
    return {"body_force_x_n": force_x, "body_force_y_n": force_y, "body_moment_nm": moment}


def _power(forces: dict[str, Any], q: dict[str, Any]) -> Any:
    """Power of forces on the body, W."""
    along = forces["body_force_x_n"] * q["u"] + forces["body_force_y_n"] * q["v"]
    return along + forces["body_moment_nm"] * q["r"]


def _derivatives(q: dict[str, Any], wheels: list[dict[str, Any]], terms: Any) -> dict[str, Any]:
    """dx/dt by the names of `STATES`."""
    from terrafusion.twin.physics.wheel import WheelSoil, clog_rate

    d: dict[str, Any] = dict.fromkeys(STATES, 0.0)
    d |= {state: q[f"d_{state}"] for state in STATES if f"d_{state}" in q}
    for name, w in zip(WHEELS, wheels, strict=True):
        braked = w["drive_torque_nm"] - w["traction_x_n"] * w["radius_m"] - w["drag_torque_nm"]
        d[f"wheel_speed_{name}"] = braked / w["wheel_inertia_kgm2"]
        d[f"shear_x_{name}"], d[f"shear_y_{name}"] = w["shear_rate_x"], w["shear_rate_y"]
        d[f"torque_{name}"], d[f"speed_error_{name}"] = w["d_torque"], w["d_speed_error"]
        d[f"brake_{name}"], d[f"play_{name}"] = w["brake_rate"], w["d_play"]
        d[f"wheel_angle_{name}"] = w["wheel_speed"]
        ground = WheelSoil(*(w[name] for name in SOIL_PARAMETERS))
        d["clog"] = d["clog"] + 0.25 * clog_rate(ground, q["clog"], w["rim_mps"], w["ground_slip"])
        d["motor_work"] = d["motor_work"] + w["drive_torque_nm"] * w["wheel_speed"]
        slipping, lost = _dissipated(w)
        lost = lost - w["scrub_nm"] * q["r"]
        d["slip_work"] = d["slip_work"] + slipping
        d["resistance_work"] = d["resistance_work"] + lost - slipping
    free = {f"d_{name}": d[name] for name in (f"wheel_speed_{wheel}" for wheel in WHEELS)}
    turned = terms.apply("shafts", q | free)
    d |= {name.removeprefix("d_"): turned[name] for name in free}
    d["u"] = q["body_force_x_n"] / q["mass_kg"] + q["gravity_body_x_mps2"] + q["r"] * q["v"]
    d["v"] = q["body_force_y_n"] / q["mass_kg"] + q["gravity_body_y_mps2"] - q["r"] * q["u"]
    d["r"] = q["body_moment_nm"] / q["yaw_inertia_kgm2"]
    # Position and travel are those of the body origin, velocities those of the centre of gravity.
    origin_u, origin_v = origin_velocity(q)
    d["x"] = q["cos_yaw"] * origin_u - q["sin_yaw"] * origin_v
    d["y"] = q["sin_yaw"] * origin_u + q["cos_yaw"] * origin_v
    d["yaw"], d["travel"], d["elapsed"] = q["r"], origin_u, 1.0
    return d


def _dissipated(w: dict[str, Any]) -> tuple[Any, Any]:
    """Power a wheel spends in slip, and all that is lost between motor and body, W."""
    slipping = w["traction_x_n"] * (w["rim_mps"] - w["hub_x_mps"]) - w["traction_y_n"] * w["hub_y_mps"]
    lost = (
        w["traction_x_n"] * w["rim_mps"] + w["drag_torque_nm"] * w["wheel_speed"]
        - w["force_x_n"] * w["hub_x_mps"] - w["force_y_n"] * w["hub_y_mps"]
    )  # fmt: skip
    return slipping, lost


def origin_velocity(q: dict[str, Any]) -> tuple[Any, Any]:
    """Velocity of the body origin along body x and y, m/s."""
    return q["u"] + q["r"] * q["cg_left_m"], q["v"] - q["r"] * q["cg_forward_m"]
