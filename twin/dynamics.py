"""The vehicle on its plane as one CasADi graph dx/dt = f(x, u, p).

The body moves in a plane of given slope; x and y are coordinates in that
plane, `yaw` the heading in it. `u`, `v`, `r` are the velocity of the centre
of gravity in body axes and the yaw rate. Soil and vehicle numbers enter as
parameters, so one compiled graph serves every soil and vehicle.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.twin.soil import SoilParams
from terrafusion.twin.vehicle import VehicleParams

Array = NDArray[np.float64]

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the wheels in every array."""

STATES = (
    "x", "y", "yaw", "u", "v", "r",
    *(f"wheel_speed_{w}" for w in WHEELS),
    *(f"shear_x_{w}" for w in WHEELS),
    *(f"shear_y_{w}" for w in WHEELS),
    *(f"torque_{w}" for w in WHEELS),
    *(f"speed_error_{w}" for w in WHEELS),
    *(f"brake_{w}" for w in WHEELS),
    *(f"wheel_angle_{w}" for w in WHEELS),
    "clog", "travel", "motor_work", "electric_energy",
)  # fmt: skip
"""State names: m, rad, m/s, rad/s, N m (`torque`, at the wheel), rad (`speed_error`, integrated), J.

`shear_x`, `shear_y` and `brake` are displacements of the soil and of the rim's
friction bristle (m), `travel` the path driven forward (m), `clog` from 0 to 1.
"""

INPUTS = ("left_radps", "right_radps")
"""Commanded wheel speeds of the two sides, rad/s."""

VEHICLE_PARAMETERS = (
    "mass_kg", "yaw_inertia_kgm2", "wheelbase_m", "track_m", "cg_forward_m", "cg_left_m", "cg_height_m",
    "radius_m", "width_m", "wheel_inertia_kgm2", "gear_ratio", "gear_efficiency", "no_load_radps",
    "stall_torque_nm", "torque_limit_nm", "supply_v", "loop_p_nms", "loop_i_nm", "lag_s",
    "gravity_x_mps2", "gravity_y_mps2", "gravity_normal_mps2",
)  # fmt: skip
"""Parameters that hold for a whole run; gravity is given along the plane's x and y and into it."""

SOIL_PARAMETERS = (
    "k_c", "k_phi", "exponent", "slip_sinkage", "contact_floor_m", "cohesion_pa", "tan_friction",
    "shear_modulus_m", "friction_cap", "rolling", "viscous_ns_per_m", "pickup_per_m", "churn_gain",
    "shed_per_m", "clog_torque_nm", "clog_sinkage_m",
)  # fmt: skip
"""Parameters that change along the route."""

INDEX = {name: i for i, name in enumerate(STATES)}


def state_slice(prefix: str) -> slice:
    """The four wheels' entries of a state, e.g. `state_slice("wheel_speed")`."""
    first = INDEX[f"{prefix}_{WHEELS[0]}"]
    return slice(first, first + 4)


def vehicle_vector(
    vehicle: VehicleParams, *, slope_rad: float = 0.0, aspect_rad: float = 0.0, payload_kg: float = 0.0
) -> Array:
    """Values (22,) of `VEHICLE_PARAMETERS`; `aspect_rad` is the way uphill (0 east, left positive).

    The payload rides at the centre of gravity and adds yaw inertia in proportion to its mass.
    """
    body, wheel, drive = vehicle.body, vehicle.wheel, vehicle.drive
    mass = body.mass_kg + payload_kg
    downhill = -GRAVITY_MPS2 * math.sin(slope_rad)
    return np.array(
        [
            mass, body.yaw_inertia_kgm2 * mass / body.mass_kg, body.wheelbase_m, body.track_m,
            body.cg_forward_m, body.cg_left_m, body.cg_height_m,
            wheel.radius_m, wheel.width_m, wheel.inertia_kgm2,
            drive.gear_ratio, drive.gear_efficiency, drive.no_load_speed_radps, drive.stall_torque_nm,
            drive.torque_limit_nm, drive.supply_v, drive.speed_loop_p_nms, drive.speed_loop_i_nm, drive.lag_s,
            downhill * math.cos(aspect_rad), downhill * math.sin(aspect_rad),
            GRAVITY_MPS2 * math.cos(slope_rad),
        ]
    )  # fmt: skip


def soil_vector(soil: SoilParams) -> Array:
    """Values (16,) of `SOIL_PARAMETERS`."""
    return np.array(
        [
            soil.pressure.k_c_n_per_m_n1, soil.pressure.k_phi_n_per_m_n2, soil.pressure.exponent,
            soil.pressure.slip_sinkage, soil.pressure.contact_length_floor_m, soil.shear.cohesion_pa,
            math.tan(soil.shear.friction_angle_rad), soil.shear.shear_modulus_m, soil.shear.friction_cap,
            soil.resistance.rolling, soil.resistance.viscous_ns_per_m, soil.mud.pickup_per_m,
            soil.mud.churn_gain, soil.mud.shed_per_m, soil.mud.torque_nm, soil.mud.sinkage_m,
        ]
    )  # fmt: skip


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


def motor_torque(p: dict[str, Any], speed_radps: Any, error_radps: Any, integral_rad: Any) -> tuple[Any, Any]:
    """Torque at the wheel the speed loop asks for within the motor's limits, N m, and d(integral)/dt, rad/s.

    A PI loop, clipped smoothly to the torque-speed line of a DC motor and to
    its current limit; back-calculation keeps the integral from winding up.
    """
    from terrafusion.twin.wheel import smooth_max, smooth_min

    wanted = p["loop_p_nms"] * error_radps + p["loop_i_nm"] * integral_rad
    at_wheel = p["gear_ratio"] * p["gear_efficiency"]
    relative = speed_radps * p["gear_ratio"] / p["no_load_radps"]
    limit, stall = p["torque_limit_nm"] * at_wheel, p["stall_torque_nm"] * at_wheel
    upper = smooth_min(limit, stall * (1.0 - relative), 0.05)
    lower = -smooth_min(limit, stall * (1.0 + relative), 0.05)
    clipped = smooth_max(smooth_min(wanted, upper, 0.05), lower, 0.05)
    return clipped, error_radps - (wanted - clipped) / p["loop_p_nms"]


def motor_current(p: Any, torque_nm: Any, speed_radps: Any) -> Any:
    """Motor current, A, from the torque (N m) and speed (rad/s) at the wheel.

    The gearbox takes its share of the power that flows through it, whichever
    way it flows. Works on CasADi expressions and numpy arrays alike.
    """
    power = torque_nm * speed_radps
    way = power / (power * power + 1e-2) ** 0.5
    loss = 0.5 * (1.0 + way) / p["gear_efficiency"] + 0.5 * (1.0 - way) * p["gear_efficiency"]
    return torque_nm / p["gear_ratio"] * loss * p["no_load_radps"] / p["supply_v"]


def motor_voltage(p: Any, current_a: Any, speed_radps: Any) -> Any:
    """Motor voltage, V: winding drop plus back-EMF of an ideal DC motor (k_t = k_e = U / no-load speed)."""
    k_e = p["supply_v"] / p["no_load_radps"]
    resistance = p["supply_v"] * k_e / p["stall_torque_nm"]
    return resistance * current_a + k_e * p["gear_ratio"] * speed_radps


@functools.cache
def rhs() -> Any:
    """The CasADi `Function` f(x (38,), u (2,), vehicle (22,), soil (16,)) -> dx/dt (38,)."""
    import casadi as ca

    x, u = ca.SX.sym("x", len(STATES)), ca.SX.sym("u", len(INPUTS))
    pv, ps = ca.SX.sym("vehicle", len(VEHICLE_PARAMETERS)), ca.SX.sym("soil", len(SOIL_PARAMETERS))
    derivative = _derivative(x, u, pv, ps)
    names = ["x", "u", "vehicle", "soil"]
    return ca.Function("tf_rhs", [x, u, pv, ps], [derivative], names, ["dx"], {"cse": True})


def _derivative(x: Any, u: Any, pv: Any, ps: Any) -> Any:
    import casadi as ca

    from terrafusion.twin.wheel import Ground, clog_rate, contact, smooth_max

    p = {name: pv[i] for i, name in enumerate(VEHICLE_PARAMETERS)}
    ground = Ground(*(ps[i] for i in range(len(SOIL_PARAMETERS))))
    s = {name: x[i] for i, name in enumerate(STATES)}
    cos, sin = ca.cos(s["yaw"]), ca.sin(s["yaw"])
    gravity_x = cos * p["gravity_x_mps2"] + sin * p["gravity_y_mps2"]
    gravity_y = -sin * p["gravity_x_mps2"] + cos * p["gravity_y_mps2"]
    d: dict[str, Any] = dict.fromkeys(STATES, 0.0)
    force_x, force_y, moment = 0.0, 0.0, 0.0
    commands = (u[0], u[1], u[0], u[1])
    loads = wheel_loads(p, gravity_x, gravity_y)
    for name, load, (px, py), command in zip(WHEELS, loads, wheel_positions(p), commands, strict=True):
        speed, torque = s[f"wheel_speed_{name}"], s[f"torque_{name}"]
        rim = speed * p["radius_m"]
        c = contact(
            ground, load, rim, (s["u"] - s["r"] * py, s["v"] + s["r"] * px),
            (s[f"shear_x_{name}"], s[f"shear_y_{name}"]), s[f"brake_{name}"], s["clog"],
            p["radius_m"], p["width_m"],
        )  # fmt: skip
        force_x, force_y = force_x + c.force_x_n, force_y + c.force_y_n
        moment = moment + px * c.force_y_n - py * c.force_x_n
        wanted, d[f"speed_error_{name}"] = motor_torque(p, speed, command - speed, s[f"speed_error_{name}"])
        d[f"wheel_speed_{name}"] = (torque - c.traction_x_n * p["radius_m"] - c.drag_torque_nm) / p[
            "wheel_inertia_kgm2"
        ]
        d[f"brake_{name}"] = c.brake_rate
        d[f"shear_x_{name}"], d[f"shear_y_{name}"] = c.shear_rate_x, c.shear_rate_y
        d[f"torque_{name}"] = (wanted - torque) / p["lag_s"]
        d[f"wheel_angle_{name}"] = speed
        d["clog"] = d["clog"] + 0.25 * clog_rate(ground, s["clog"], rim, c.slip)
        current = motor_current(p, torque, speed)
        d["motor_work"] = d["motor_work"] + torque * speed
        # A bridge without recovery: power never flows back to the battery.
        power = motor_voltage(p, current, speed) * current
        d["electric_energy"] = d["electric_energy"] + smooth_max(power, 0.0, 1e-3)
    d["u"] = force_x / p["mass_kg"] + gravity_x + s["r"] * s["v"]
    d["v"] = force_y / p["mass_kg"] + gravity_y - s["r"] * s["u"]
    d["r"] = moment / p["yaw_inertia_kgm2"]
    # Position and travel are those of the body origin, velocities those of the centre of gravity.
    origin_u = s["u"] + s["r"] * p["cg_left_m"]
    origin_v = s["v"] - s["r"] * p["cg_forward_m"]
    d["x"], d["y"] = cos * origin_u - sin * origin_v, sin * origin_u + cos * origin_v
    d["yaw"], d["travel"] = s["r"], origin_u
    return ca.vertcat(*(d[name] for name in STATES))
