"""What a chassis does beyond a rigid box on four free wheels: terms of a vehicle, no causes of a gap."""

from typing import Any

import casadi as ca

from terrafusion.twin.effects.form import Form, Quantities, one, two
from terrafusion.twin.physics.layout import WHEELS
from terrafusion.twin.physics.terramechanics import SLIP_SPEED_MPS

MEAN_DISTANCE = 0.3826
"""Mean distance of the points of a square from its centre, over its side: (sqrt 2 + ln(1 + sqrt 2)) / 6."""


def _transferred(q: Quantities, share: Any) -> dict[str, Any]:
    """What leans on the wheels is gravity less acceleration: along by the wheels' push, across by the turn.

    Side forces of skidding wheels nearly cancel, so the turn's own acceleration u r is the better estimate.
    """
    felt_x = q["body_force_x_n"] / q["mass_kg"]
    felt_y = q["u"] * q["r"] - q["gravity_body_y_mps2"]
    return {
        "lean_x_mps2": q["lean_x_mps2"] - share * (felt_x + q["lean_x_mps2"]),
        "lean_y_mps2": q["lean_y_mps2"] - share * (felt_y + q["lean_y_mps2"]),
    }


def _tilted(q: Quantities, pitch: Any, roll: Any) -> dict[str, Any]:
    """The body leans out of a turn and back under thrust, so the accelerometer reads a part of gravity."""
    out = {}
    for axis, compliance in (("x", pitch), ("y", roll)):
        felt = q[f"specific_force_{axis}_mps2"]
        angle = compliance * felt
        leaked = q["gravity_normal_mps2"] * ca.sin(angle) - felt * (1.0 - ca.cos(angle))
        out[f"accel_{axis}_mps2"] = q[f"accel_{axis}_mps2"] + leaked
    return out


def _coupled(q: Quantities, share: Any) -> dict[str, Any]:
    """Front and rear wheel of a side accelerate as one."""
    out: dict[str, Any] = {}
    for side in ("left", "right"):
        own = {name: q[f"d_wheel_speed_{name}"] for name in WHEELS if name.endswith(side)}
        mean = 0.5 * sum(own.values())
        out |= {f"d_wheel_speed_{name}": (1.0 - share) * value + share * mean for name, value in own.items()}
    return out


def _scrubbed(q: Quantities, share: Any) -> dict[str, Any]:
    """Coulomb friction of a contact that turns on the ground while it slips."""
    depth = q["sinkage_m"]
    square = 2.0 * q["radius_m"] * depth - depth * depth + q["contact_floor_m"] ** 2
    arm = MEAN_DISTANCE * ca.sqrt(q["width_m"] * ca.sqrt(square))
    turning = arm * q["r"]
    slipping = q["slip_x_mps"] ** 2 + q["slip_y_mps"] ** 2
    speed = ca.sqrt(turning * turning + slipping + SLIP_SPEED_MPS**2)
    return {"scrub_nm": q["scrub_nm"] - share * q["friction_cap"] * q["load_n"] * arm * turning / speed}


FORMS = (
    Form(
        "chassis", "load_transfer", one("", 1.0, 0.0, 1.0), {"loads": _transferred},
        "wheel loads by h (g - a) in place of h g; a along from the wheels' forces, across u r",
        "Wong 2008, eq. 3.2: moments about the contact, quasi-static", candidate=False,
    ),
    Form(
        "chassis", "tilt", two(("pitch", "roll"), "rad s2/m", 0.005, 0.1), {"measurement": _tilted},
        "the IMU leans by e f, f specific force along x and y, and reads gravity times the sine",
        "ours: springs without dynamics", candidate=False,
    ),
    Form(
        "chassis", "coupled_sides", one("", 1.0, 0.0, 1.0), {"shafts": _coupled},
        "with 1, front and rear wheel of a side turn as one (a chain or belt); between, for derivatives only",
        "rigid constraint", candidate=False,
    ),
    Form(
        "chassis", "scrub", one("", 0.5, 0.0, 2.0), {"wheel": _scrubbed},
        "moment e mu W a (a r) / sqrt((a r)^2 + v_s^2) against turning, a = 0.38 sqrt(b l), v_s slip",
        "ours: Coulomb friction of a contact that turns and slips", candidate=False,
    ),
)  # fmt: skip
