"""Effects of the ground."""

import math
from typing import Any

import casadi as ca

from terrafusion.twin.effects.form import Form, Quantities, braked, one, turning_beside
from terrafusion.twin.physics.smooth import grown, saturate, smooth_abs
from terrafusion.twin.physics.wheel import RESISTANCE_SPEED_MPS

# Constants of the laws, assumed unless a source is given; see the equations below.
RATE_SPEED_MPS = 0.01
"""Slip speed at which a logarithmic rate law departs from its value at rest."""
DRIFT_M, DRIFT_PLACE_M, DRIFT_S = 50.0, 20.0, 60.0
GROUSER_PITCH_M = 0.05
GROUSER_SOIL_N_PER_M3 = 15_000.0
BUILD_UP_M = 5.0
LANE_BORDER_M = 0.1
CLINGING_SPEED_MPS = 0.05


def scaled_shear(q: Quantities, gain: Any) -> dict[str, Any]:
    """The ground's strength in shear times `gain`."""
    return {name: q[name] * gain for name in ("cohesion_pa", "tan_friction", "friction_cap")}


def scaled_bearing(q: Quantities, gain: Any) -> dict[str, Any]:
    """The ground's resistance to sinkage times `gain`."""
    return {name: q[name] * gain for name in ("k_c", "k_phi")}


def _compacted(q: Quantities, gain: Any) -> dict[str, Any]:
    """Ground that the wheel ahead has passed: stiffer against sinkage and in shear."""
    gain = gain * q["following"]
    return scaled_bearing(q, ca.exp(gain)) | {"shear_modulus_m": q["shear_modulus_m"] * ca.exp(-0.5 * gain)}


def _saturated_slip(q: Quantities) -> Any:
    """|s|, not beyond 1: a wheel that turns backwards has 2, where Bekker's law ends (n below 3)."""
    return saturate(smooth_abs(q["slip"], 0.01) - 0.01, 1.0)


def _slip_speed(q: Quantities) -> Any:
    squares = q["slip_x_mps"] * q["slip_x_mps"] + q["slip_y_mps"] * q["slip_y_mps"]
    return ca.sqrt(squares + RATE_SPEED_MPS**2) - RATE_SPEED_MPS


def _plough(q: Quantities, share: Any) -> dict[str, Any]:
    u, v = q["hub_x_mps"], q["hub_y_mps"]
    push = share * q["load_n"] * q["sinkage_m"] / q["radius_m"]
    push = push / ca.sqrt(u * u + v * v + RESISTANCE_SPEED_MPS**2)
    return {"force_x_n": q["force_x_n"] - push * u, "force_y_n": q["force_y_n"] - push * v}


def _track_grousers(q: Quantities, height: Any) -> dict[str, Any]:
    """Bekker's grouser terms; acot(h/b) by its series, right to 1e-3 for h/b below 0.35."""
    ratio = height / q["width_m"]
    acot = 0.5 * math.pi - ratio + ratio * ratio * ratio / 3.0
    friction = 1.0 + 0.64 * ratio * acot
    return {
        "cohesion_pa": q["cohesion_pa"] * (1.0 + 2.0 * ratio),
        "tan_friction": q["tan_friction"] * friction,
        "friction_cap": q["friction_cap"] * friction,
    }


def _passive_grousers(q: Quantities, height: Any) -> dict[str, Any]:
    """Rankine's passive pressure on each blade as a cohesion over the pitch; the cap grows as much."""
    root = ca.sqrt(1.0 + q["tan_friction"] * q["tan_friction"]) + q["tan_friction"]
    weight = 0.5 * GROUSER_SOIL_N_PER_M3 * height * height * root * root
    gained = (weight + 2.0 * q["cohesion_pa"] * height * root) / GROUSER_PITCH_M
    patch = q["width_m"] * q["contact_floor_m"]
    return {
        "cohesion_pa": q["cohesion_pa"] + gained,
        "friction_cap": q["friction_cap"] + gained * patch / q["load_n"],
    }


def _rotation_sign(q: Quantities) -> Any:
    """Sign of the wheel's rotation, smooth through rest."""
    return q["rim_mps"] / smooth_abs(q["rim_mps"], CLINGING_SPEED_MPS)


def _sucking(q: Quantities, pressure: Any) -> dict[str, Any]:
    """Suction under the rear contact that does not hold at rest."""
    z = q["sinkage_m"]
    chord_square = 2.0 * q["radius_m"] * z - z * z + q["contact_floor_m"] * q["contact_floor_m"]
    return braked(q, 0.5 * pressure * q["width_m"] * chord_square * _rotation_sign(q))


def _lateral(q: Quantities, share: Any) -> dict[str, Any]:
    more = share * q["traction_y_n"]
    return {"traction_y_n": q["traction_y_n"] + more, "force_y_n": q["force_y_n"] + more}


FORMS = (
    Form(
        "soil_strength", "shear", one("", 0.2, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(e))},
        "c, tan phi and mu times exp(e)", "ours; strength is scaled, the laws stay",
    ),
    Form(
        "soil_strength", "bearing", one("", 0.3, -2.0, 2.0),
        {"ground": lambda q, e: scaled_bearing(q, ca.exp(e))},
        "k_c and k_phi times exp(e)", "ours; stiffness is scaled, the law stays",
    ),
    Form(
        "slip_sinkage", "linear", one("", 0.5, 0.0, 5.0),
        {"ground": lambda q, e: {"slip_sinkage": q["slip_sinkage"] + e}},
        "z = z0 (1 + (k_ss + e) d + ...), d driven slip", "linear, as the model's own k_ss",
    ),
    Form(
        "slip_sinkage", "exponent", one("", 0.1, 0.0, 0.8),
        {"ground": lambda q, e: {"exponent": q["exponent"] + e * _saturated_slip(q)}},
        "n = n0 + e abs(s), abs(s) saturating at 1", "Ding et al. 2010",
    ),
    Form(
        "rate_dependent_shear", "logarithmic", one("", 0.05, -0.15, 0.5),
        {"ground": lambda q, e: scaled_shear(q, 1.0 + e * ca.log(1.0 + _slip_speed(q) / RATE_SPEED_MPS))},
        "strength times 1 + e ln(1 + v_s / 0.01 m/s)", "ours, after Graham et al. 1983 on clay",
    ),
    Form(
        "rate_dependent_shear", "linear", one("s/m", 0.3, -0.2, 1.0),
        {"ground": lambda q, e: scaled_shear(q, 1.0 + e * _slip_speed(q))},
        "strength times 1 + e v_s", "ours, after a Bingham body",
    ),
    Form(
        "motion_resistance", "rolling", one("", 0.03, 0.0, 0.5),
        {"ground": lambda q, e: {"rolling": q["rolling"] + e}},
        "rolling torque (c_rr + e) W R", "as the model's own c_rr",
    ),
    Form(
        "motion_resistance", "in_motion", one("", 0.03, 0.0, 0.5),
        {"wheel": lambda q, e: braked(q, e * q["load_n"] * q["radius_m"] * _rotation_sign(q))},
        "rolling torque e W R w / sqrt(w^2 + (0.05 m/s / R)^2)", "the same without a hold at rest",
    ),
    Form(
        "motion_resistance", "with_speed", one("s/m", 0.03, 0.0, 0.5),
        {"wheel": lambda q, e: braked(q, e * q["load_n"] * q["radius_m"] * q["rim_mps"])},
        "rolling torque e W R^2 w", "a coefficient that grows with speed, as Gillespie 1992",
    ),
    Form(
        "motion_resistance", "ploughing", one("", 0.2, 0.0, 3.0), {"wheel": _plough},
        "force e W z / R against the hub's velocity", "ours",
    ),
    Form(
        "motion_resistance", "viscous", one("N s/m", 3.0, 0.0, 500.0),
        {"ground": lambda q, e: {"viscous_ns_per_m": q["viscous_ns_per_m"] + e}},
        "force e times the hub's velocity, each wheel", "as the model's own c_v",
    ),
    Form(
        "grousers", "track_law", one("m", 0.01, 0.0, 0.05), {"ground": _track_grousers},
        "c (1 + 2 h/b), tan phi and mu (1 + 0.64 h/b acot(h/b)), h = e", "Bekker 1969",
    ),
    Form(
        "grousers", "passive_pressure", one("m", 0.01, 0.0, 0.05), {"ground": _passive_grousers},
        "c + (gamma h^2 N / 2 + 2 c h sqrt(N)) / 50 mm, N = tan^2(45 deg + phi/2), h = e; mu likewise",
        "Rankine 1857, per blade",
    ),
    Form(
        "grousers", "shearing_radius", one("m", 0.01, 0.0, 0.05),
        {"corner": lambda q, e: {"radius_m": q["radius_m"] + 0.5 * e}, "ground": _track_grousers},
        "R + h/2, and strength as by the track law, h = e", "Ding et al. 2011: soil between lugs shears",
    ),
    Form(
        "soil_drift", "over_travel", one("", 0.3, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(e * q["travel"] / smooth_abs(q["travel"], DRIFT_M)))},
        "strength times exp(e s / sqrt(s^2 + (50 m)^2)), s travel", "ours",
    ),
    Form(
        "soil_drift", "over_place", one("", 0.3, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(e * ca.tanh(q["wheel_x_m"] / DRIFT_PLACE_M)))},
        "strength times exp(e tanh(x / 20 m)), x of the wheel in the plane", "ours",
    ),
    Form(
        "soil_drift", "over_time", one("", 0.3, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(e * (1.0 - ca.exp(-q["elapsed"] / DRIFT_S))))},
        "strength times exp(e (1 - exp(-t / 60 s)))", "ours",
    ),
    Form(
        "multipass_compaction", "rut", one("", 0.5, -1.0, 3.0),
        {"ground": lambda q, e: {"multipass": 1.0 - (1.0 - q["multipass"]) * ca.exp(-e)}},
        "the following axle sinks by (1 - m) exp(-e) of z0, in place of 1 - m",
        "Abebe et al. 1989, as the model's own m",
    ),
    Form(
        "multipass_compaction", "stiffening", one("", 0.5, 0.0, 3.0), {"ground": _compacted},
        "under the following axle k_c and k_phi times exp(e f), K times exp(-e f / 2), f share in the rut",
        "ours",
    ),
    Form(
        "multipass_compaction", "strengthening", one("", 0.2, -1.0, 2.0),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(e * q["following"]))},
        "under the following axle strength times exp(e f), f share in the rut", "ours, after Holm 1969",
    ),
    Form(
        "mud_adhesion", "suction", one("Pa", 1000.0, 0.0, 10_000.0),
        {"ground": lambda q, e: {"suction_pa": q["suction_pa"] + e}},
        "torque (p + e) b l^2 / 2 against rolling", "as the model's own suction p",
    ),
    Form(
        "mud_adhesion", "in_motion", one("Pa", 1000.0, 0.0, 10_000.0), {"wheel": _sucking},
        "torque e b l^2 / 2 w / sqrt(w^2 + (0.05 m/s / R)^2)", "the same without a hold at rest",
    ),
    Form(
        "mud_adhesion", "build_up", one("", 0.03, 0.0, 0.5),
        {"wheel": lambda q, e: braked(
            q, e * q["load_n"] * q["radius_m"] * grown(q["travel"], BUILD_UP_M) * _rotation_sign(q)
        )},
        "torque e W R s^2 / (s^2 + (5 m)^2) against rolling, s travel", "ours",
    ),
    Form(
        "lateral_anisotropy", "strength", one("", 0.2, -0.8, 2.0), {"wheel": _lateral},
        "side part of the shear force times 1 + e", "ours",
    ),
    Form(
        "lateral_anisotropy", "stiffness", one("", 0.3, -0.8, 3.0),
        {"ground": lambda q, e: {"shear_y_m": q["shear_y_m"] * (1.0 + e)}},
        "side part of the shear displacement counts 1 + e times", "ours",
    ),
    Form(
        "left_right_friction", "sides", one("", 0.2, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(0.5 * q["side"] * e))},
        "strength times exp(e/2) left, exp(-e/2) right of the robot", "ours",
    ),
    Form(
        "left_right_friction", "lane", one("", 0.2, -1.5, 1.5),
        {"ground": lambda q, e: scaled_shear(q, ca.exp(0.5 * e * ca.tanh(q["wheel_y_m"] / LANE_BORDER_M)))},
        "strength times exp(e/2 tanh(y / 0.1 m)), y of the wheel in the plane", "ours",
    ),
    Form(
        "left_right_friction", "turning_centre", one("m", 0.05, -0.5, 0.5), {"mounting": turning_beside},
        "the body turns about a point e to the right of its middle", "kinematics (Mandow 2007)",
    ),
)  # fmt: skip
