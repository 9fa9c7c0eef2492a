"""The vehicle on its plane as one CasADi graph dx/dt = f(x, u, p).

The body moves in a plane of given slope; x and y are coordinates in that
plane, `yaw` the heading in it. `u`, `v`, `r` are the velocity of the centre
of gravity in body axes and the yaw rate. Soil and vehicle numbers enter as
parameters, so one compiled graph serves every soil and vehicle.
"""

from __future__ import annotations

import functools
from typing import Any

from terrafusion.twin.layout import INPUTS, SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS, WHEELS
from terrafusion.twin.motors import battery, drawn_power, motor_torque


def wheel_positions(p: dict[str, Any]) -> list[tuple[Any, Any]]:
    """Wheel hubs (x, y) from the centre of gravity, body axes, in the order of `WHEELS`."""
    half_x, half_y = 0.5 * p["wheelbase_m"], 0.5 * p["track_m"]
    return [
        (sx * half_x - p["cg_forward_m"], sy * half_y - p["cg_left_m"])
        for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]


def wheel_loads(p: dict[str, Any], gravity_x: Any, gravity_y: Any) -> list[Any]:
    """Quasi-static wheel loads, N: weight shared by the position of the centre of gravity and by the slope.

    `gravity_x`, `gravity_y` are gravity along body x and y, m/s2. A load is
    kept above zero smoothly: the model does not tip over.
    """
    from terrafusion.twin.wheel import smooth_max

    weight = p["mass_kg"] * p["gravity_normal_mps2"]
    lean_x = (p["cg_forward_m"] + p["cg_height_m"] * gravity_x / p["gravity_normal_mps2"]) / p["wheelbase_m"]
    lean_y = (p["cg_left_m"] + p["cg_height_m"] * gravity_y / p["gravity_normal_mps2"]) / p["track_m"]
    shares = [(0.5 + sx * lean_x) * (0.5 + sy * lean_y) for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    return [smooth_max(weight * share, 1.0, 1.0) for share in shares]


@functools.cache
def rhs(effects: tuple[str, ...] = ()) -> Any:
    """The CasADi `Function` f(x, u, vehicle, soil, effects) -> dx/dt.

    x, u and vehicle are in the order of `STATES`, `INPUTS` and
    `VEHICLE_PARAMETERS`; soil holds `SOIL_PARAMETERS` four times, wheel by
    wheel; effects the values of the named optional parameters. A graph made
    without an optional parameter does not hold its term at all.
    """
    import casadi as ca

    x, u = ca.SX.sym("x", len(STATES)), ca.SX.sym("u", len(INPUTS))
    pv = ca.SX.sym("vehicle", len(VEHICLE_PARAMETERS))
    ps = ca.SX.sym("soil", len(SOIL_PARAMETERS), len(WHEELS))
    pe = ca.SX.sym("effects", len(effects))
    derivative = _derivative(x, u, pv, ps)
    names = ["x", "u", "vehicle", "soil", "effects"]
    return ca.Function("tf_rhs", [x, u, pv, ca.vec(ps), pe], [derivative], names, ["dx"], {"cse": True})


def _derivative(x: Any, u: Any, pv: Any, ps: Any) -> Any:
    import casadi as ca

    from terrafusion.twin.wheel import Ground, clog_rate, contact

    p = {name: pv[i] for i, name in enumerate(VEHICLE_PARAMETERS)}
    s = {name: x[i] for i, name in enumerate(STATES)}
    cos, sin = ca.cos(s["yaw"]), ca.sin(s["yaw"])
    gravity_x = cos * p["gravity_x_mps2"] + sin * p["gravity_y_mps2"]
    gravity_y = -sin * p["gravity_x_mps2"] + cos * p["gravity_y_mps2"]
    d: dict[str, Any] = dict.fromkeys(STATES, 0.0)
    force_x, force_y, moment = 0.0, 0.0, 0.0
    late = p["dead_time_s"] - p["dead_time_applied_s"]
    left, right = u[0] - late * u[2], u[1] - late * u[3]
    commands = (left, right, left, right)
    loads = wheel_loads(p, gravity_x, gravity_y)
    power = sum(drawn_power(p, s[f"torque_{name}"], s[f"wheel_speed_{name}"]) for name in WHEELS)
    supply, d["electric_energy"] = battery(p, power, s["electric_energy"])
    for i, name in enumerate(WHEELS):
        load, (px, py), command = loads[i], wheel_positions(p)[i], commands[i]
        ground = Ground(*(ps[k, i] for k in range(len(SOIL_PARAMETERS))))
        speed, torque = s[f"wheel_speed_{name}"], s[f"torque_{name}"]
        rim, hub = speed * p["radius_m"], (s["u"] - s["r"] * py, s["v"] + s["r"] * px)
        c = contact(
            ground, load, rim, hub, (s[f"shear_x_{name}"], s[f"shear_y_{name}"]), s[f"brake_{name}"],
            s["clog"], p["radius_m"], p["width_m"],
        )  # fmt: skip
        force_x, force_y = force_x + c.force_x_n, force_y + c.force_y_n
        moment = moment + px * c.force_y_n - py * c.force_x_n
        wanted, d[f"speed_error_{name}"] = motor_torque(
            p, speed, command - speed, s[f"speed_error_{name}"], supply / p["supply_v"]
        )
        d[f"wheel_speed_{name}"] = (torque - c.traction_x_n * p["radius_m"] - c.drag_torque_nm) / p[
            "wheel_inertia_kgm2"
        ]
        d[f"brake_{name}"] = c.brake_rate
        d[f"shear_x_{name}"], d[f"shear_y_{name}"] = c.shear_rate_x, c.shear_rate_y
        d[f"torque_{name}"] = (wanted - torque) / p["lag_s"]
        d[f"wheel_angle_{name}"] = speed
        d["clog"] = d["clog"] + 0.25 * clog_rate(ground, s["clog"], rim, c.slip)
        d["motor_work"] = d["motor_work"] + torque * speed
        slipping = c.traction_x_n * (rim - hub[0]) - c.traction_y_n * hub[1]
        arriving = (
            c.traction_x_n * rim + c.drag_torque_nm * speed - c.force_x_n * hub[0] - c.force_y_n * hub[1]
        )
        d["slip_work"] = d["slip_work"] + slipping
        d["resistance_work"] = d["resistance_work"] + arriving - slipping
    d["u"] = force_x / p["mass_kg"] + gravity_x + s["r"] * s["v"]
    d["v"] = force_y / p["mass_kg"] + gravity_y - s["r"] * s["u"]
    d["r"] = moment / p["yaw_inertia_kgm2"]
    # Position and travel are those of the body origin, velocities those of the centre of gravity.
    origin_u = s["u"] + s["r"] * p["cg_left_m"]
    origin_v = s["v"] - s["r"] * p["cg_forward_m"]
    d["x"], d["y"] = cos * origin_u - sin * origin_v, sin * origin_u + cos * origin_v
    d["yaw"], d["travel"] = s["r"], origin_u
    return ca.vertcat(*(d[name] for name in STATES))
