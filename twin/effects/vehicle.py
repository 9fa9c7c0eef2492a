"""Effects of the vehicle: masses, geometry, drive train and command path."""

from typing import Any

import casadi as ca

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.effects.form import (
    SIDES_BY_NAME,
    Form,
    Parameter,
    Quantities,
    braked,
    on_side,
    one,
    turning_beside,
)
from terrafusion.twin.physics.layout import WHEELS
from terrafusion.twin.physics.smooth import grown

# Constants of the laws, assumed unless a source is given; see the equations below.
SHORTEST_LAG_S = 0.002
"""A filter of the command path is this fast where its parameter is zero: no stiffer than the motor lag."""
FRICTION_SPEED_RADPS = 0.1
TURNING_RADPS = 0.2
PULL_MPS2 = 2.0
WARMING_J, DISCHARGE_J = 1e3, 1e4
CROSSING_S = 0.03
"""Time in which a gear crosses its backlash."""
CROSSING_NM = 0.3
"""Torque at the wheel at which the loaded flank of the gear changes."""
BUILD_UP_M = 10.0


def _on_rear_axle(q: Quantities, share: Any) -> dict[str, Any]:
    """A load e times the robot's mass over the rear axle: common centre of gravity, parallel axes."""
    arm = -(0.5 * q["wheelbase_m"] + q["cg_forward_m"])
    part = share / (1.0 + share)
    return {
        "mass_kg": q["mass_kg"] * (1.0 + share),
        "cg_forward_m": q["cg_forward_m"] + part * arm,
        "yaw_inertia_kgm2": q["yaw_inertia_kgm2"] + q["mass_kg"] * part * arm * arm,
    }


def _command_g(q: Quantities) -> Any:
    """Commanded acceleration over that of gravity, saturated (a step commands any)."""
    wanted = 0.5 * q["radius_m"] * (q["left_rate_radps2"] + q["right_rate_radps2"]) / PULL_MPS2
    return PULL_MPS2 / GRAVITY_MPS2 * wanted / ca.sqrt(1.0 + wanted * wanted)


def _filtered(kind: str, q: Quantities, out: Any, lag: Any) -> dict[str, Any]:
    """Both sides' commands less `out` times their filtered rate, dq/dt = (rate - q) / sqrt(lag^2 + (2 ms)^2).

    Exact above 2 ms, bounded in its stiffness at zero, and absent there since `out` is zero.
    """
    changes = {}
    for side in ("left", "right"):
        command, rate, held = f"command_{side}_radps", f"command_{side}_radps2", f"command_{kind}_{side}"
        changes[f"d_{held}"] = (q[rate] - q[held]) / ca.sqrt(lag * lag + SHORTEST_LAG_S**2)
        changes[command] = q[command] - out * q[held]
        changes[rate] = q[rate] - out * changes[f"d_{held}"]
    return changes


def _crossing(q: Quantities) -> Any:
    """Rate of the gear's place in its backlash, 1/s: it follows the sign of the torque."""
    return (ca.tanh(q["torque"] / CROSSING_NM) - q["play"]) / CROSSING_S


def _seen_through_backlash(q: Quantities, gap: Any) -> dict[str, Any]:
    rate = {name: 0.5 * gap * q[f"d_play_{name}"] for name in WHEELS}
    return {
        f"wheel_{side}_radps": q[f"wheel_{side}_radps"] + 0.5 * (rate[f"front_{side}"] + rate[f"rear_{side}"])
        for side in ("left", "right")
    }


def _slack(q: Quantities, share: Any) -> dict[str, Any]:
    """A part of the torque is lost while no flank carries."""
    return {"drive_torque_nm": q["drive_torque_nm"] * (1.0 - share * (1.0 - q["play"] * q["play"]))}


def _weaker(q: Quantities, share: Any) -> dict[str, Any]:
    """The motor's current does not show it."""
    return {"drive_torque_nm": q["drive_torque_nm"] * (1.0 - share)}


def _fallen(q: Quantities, share: Any, energy_j: float) -> Any:
    """exp(-share E / energy_j), E the energy drawn so far."""
    return ca.exp(-share * q["electric_energy"] / energy_j)


def _dry(q: Quantities, torque: Any) -> dict[str, Any]:
    """Friction of bearings and gears that holds at rest, too: by the bristle of the rolling resistance."""
    return {"rolling": q["rolling"] + torque / (q["load_n"] * q["radius_m"])}


FORMS = (
    Form(
        "mass", "at_cg", one("", 0.1, -0.5, 2.0),
        {"vehicle": lambda q, e: {name: q[name] * (1.0 + e) for name in ("mass_kg", "yaw_inertia_kgm2")}},
        "mass and yaw inertia times 1 + e", "a payload at the centre of gravity",
    ),
    Form(
        "mass", "rear_axle", one("", 0.1, -0.3, 2.0), {"vehicle": _on_rear_axle},
        "a load of e times the mass over the rear axle", "parallel axis theorem",
    ),
    Form(
        "cg_lateral", "shift", one("m", 0.02, -0.2, 0.2),
        {"vehicle": lambda q, e: {"cg_left_m": q["cg_left_m"] + e}},
        "centre of gravity e to the left", "geometry",
    ),
    Form(
        "cg_lateral", "transfer", one("m", 0.1, -0.5, 0.5),
        {"vehicle": lambda q, e: {"cg_left_m": q["cg_left_m"] - e * q["r"] * q["u"] / GRAVITY_MPS2}},
        "centre of gravity moves out of the turn by e r u / g", "ours: a load that slides",
    ),
    Form(
        "cg_lateral", "turning_centre", one("m", 0.05, -0.5, 0.5), {"mounting": turning_beside},
        "the body turns about a point e to the right of its middle", "kinematics (Mandow 2007)",
    ),
    Form(
        "cg_longitudinal", "shift", one("m", 0.02, -0.2, 0.2),
        {"vehicle": lambda q, e: {"cg_forward_m": q["cg_forward_m"] + e}},
        "centre of gravity e forward", "geometry",
    ),
    Form(
        "cg_longitudinal", "transfer", one("m", 0.1, -0.5, 0.5),
        {"vehicle": lambda q, e: {"cg_forward_m": q["cg_forward_m"] - e * _command_g(q)}},
        "centre of gravity moves back by e a / g, a commanded, at most 2 m/s2", "ours: a load that slides",
    ),
    Form(
        "wheel_radius", "scale", one("", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: {"radius_m": q["radius_m"] * (1.0 + e)}}, "R (1 + e)", "geometry",
    ),
    Form(
        "wheel_radius", "build_up", one("", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: {"radius_m": q["radius_m"] * (1.0 + e * grown(q["travel"], BUILD_UP_M))}},
        "R (1 + e s^2 / (s^2 + (10 m)^2)), s travel", "ours: soil that sticks to the tyre",
    ),
    Form(
        "wheel_radius_asymmetry", "sides", one("", 0.02, -0.3, 0.3),
        {"corner": lambda q, e: {"radius_m": q["radius_m"] * (1.0 + 0.5 * q["side"] * e)}},
        "left wheels R (1 + e/2), right wheels R (1 - e/2)", "geometry",
    ),
    Form(
        "wheel_radius_asymmetry", "one_wheel", one("", 0.02, -0.3, 0.3),
        {"corner": lambda q, e: {"radius_m": q["radius_m"] * (1.0 + e)} if q["side"] + q["end"] == 2 else {}},
        "front left wheel R (1 + e)", "geometry",
    ),
    *(
        Form(
            "wheel_radius_asymmetry", name, one("", 0.02, -0.3, 0.3),
            {"corner": on_side(side, lambda q, e: {"radius_m": q["radius_m"] * (1.0 + e)})},
            f"{name} wheels R (1 + e)", "geometry", composite=True,
        )
        for name, side in SIDES_BY_NAME.items()
    ),
    Form(
        "track_width", "scale", one("", 0.05, -0.5, 0.5),
        {"vehicle": lambda q, e: {"track_m": q["track_m"] * (1.0 + e)}}, "track (1 + e)", "geometry",
    ),
    Form(
        "track_width", "turning", one("", 0.1, -0.5, 0.5),
        {"vehicle": lambda q, e: {"track_m": q["track_m"] * (1.0 + e * grown(q["r"], TURNING_RADPS))}},
        "track (1 + e r^2 / (r^2 + (0.2 rad/s)^2))", "ours: forces move outward in a turn",
    ),
    Form(
        "torque_limit", "scale", one("", 0.2, -1.0, 0.9),
        {"vehicle": lambda q, e: {"torque_limit_nm": q["torque_limit_nm"] * (1.0 - e)}},
        "torque limit times 1 - e", "current limit",
    ),
    Form(
        "torque_limit", "heating", one("", 0.2, 0.0, 3.0),
        {"motor": lambda q, e: {"torque_limit_nm": q["torque_limit_nm"] * _fallen(q, e, WARMING_J)}},
        "torque limit times exp(-e E / 1 kJ), E drawn so far", "ours: derating",
    ),
    Form(
        "torque_limit", "weak_motors", one("", 0.2, 0.0, 0.9), {"wheel": _weaker},
        "the motors' current gives 1 - e of its torque", "worn magnets", composite=True,
    ),
    *(
        Form(
            "torque_limit", f"weak_{name}", one("", 0.2, 0.0, 0.9), {"wheel": on_side(side, _weaker)},
            f"the current of the {name} motors gives 1 - e of its torque", "worn magnets", composite=True,
        )
        for name, side in SIDES_BY_NAME.items()
    ),
    Form(
        "battery_sag", "resistance", one("ohm", 0.1, 0.0, 1.0),
        {"vehicle": lambda q, e: {"battery_ohm": q["battery_ohm"] + e}},
        "internal resistance e larger", "as the model's own, bounded",
    ),
    Form(
        "battery_sag", "discharge", one("", 0.1, 0.0, 2.0),
        {"supply": lambda q, e: {"voltage_share": q["voltage_share"] * _fallen(q, e, DISCHARGE_J)}},
        "supply times exp(-e E / 10 kJ), E drawn so far", "ours",
    ),
    Form(
        "drivetrain_friction", "coulomb", (Parameter("N m", 0.3, 0.0, 5.0, grows=True),),
        {"wheel": lambda q, e: braked(q, e * ca.tanh(q["wheel_speed"] / FRICTION_SPEED_RADPS))},
        "torque e tanh(w / 0.1 rad/s) against rotation, each wheel", "Coulomb, smoothed",
    ),
    Form(
        "drivetrain_friction", "dry", (Parameter("N m", 0.3, 0.0, 7.0, grows=True),), {"ground": _dry},
        "torque e against rotation, each wheel, which holds at rest", "Dahl 1968, as the rolling resistance",
    ),
    Form(
        "drivetrain_friction", "viscous", one("N m s/rad", 0.1, 0.0, 5.0),
        {"wheel": lambda q, e: braked(q, e * q["wheel_speed"])},
        "torque e w against rotation, each wheel", "viscous",
    ),
    Form(
        "drivetrain_friction", "efficiency", one("", 0.1, 0.0, 0.8),
        {"vehicle": lambda q, e: {"gear_efficiency": q["gear_efficiency"] * (1.0 - e)}},
        "gear efficiency times 1 - e", "load-dependent loss",
    ),
    Form(
        "backlash", "lost_motion", one("rad", 0.02, 0.0, 0.3),
        {"motor": lambda q, e: {"d_play": _crossing(q)}, "measurement": _seen_through_backlash},
        "encoder reads w + e/2 dp/dt; p in [-1, 1] follows the torque's sign in 30 ms",
        "ours: play operator, the speed loop's own reaction left out",
    ),
    Form(
        "backlash", "torque_gap", one("", 0.5, 0.0, 1.0),
        {"motor": lambda q, e: {"d_play": _crossing(q)}, "wheel": _slack},
        "torque times 1 - e (1 - p^2) while the gear crosses its backlash", "ours",
    ),
    Form(
        "backlash", "open_gear",
        (Parameter("rad", 0.02, 0.0, 0.3, "gap"), Parameter("", 0.5, 0.0, 1.0, "share")),
        {
            "motor": lambda q, gap, share: {"d_play": _crossing(q)},
            "wheel": lambda q, gap, share: _slack(q, share),
            "measurement": lambda q, gap, share: _seen_through_backlash(q, gap),
        },
        "a gear that shows `gap` to the encoder and loses the share `share` while it crosses it", "ours",
    ),
    Form(
        "dead_time", "transport", one("s", 0.05, 0.0, 1.0),
        {"vehicle": lambda q, e: {"dead_time_s": q["dead_time_s"] + e}},
        "command e later", "pure delay",
    ),
    Form(
        "dead_time", "all_pass", one("s", 0.05, 0.0, 1.0),
        {"command": lambda q, e: _filtered("delay", q, e, 0.5 * e)},
        "command through (1 - e s/2) / (1 + e s/2)", "Pade 1892, first order",
    ),
    Form(
        "actuator_lag", "torque", one("s", 0.02, 0.0, 0.2),
        {"vehicle": lambda q, e: {"lag_s": q["lag_s"] + e}}, "motor lag + e",
        "first order, inside the speed loop",
    ),
    Form(
        "actuator_lag", "command", one("s", 0.05, 0.0, 1.0),
        {"command": lambda q, e: _filtered("lag", q, e, e)},
        "command through 1 / (1 + e s)", "first order, ahead of the speed loop",
    ),
)  # fmt: skip
