"""Effects of the environment: the tilt of the ground and the air."""

from typing import Any

import casadi as ca

from terrafusion.twin.effects.form import Form, Quantities, one

# Constants of the laws, assumed unless a source is given; see the equations below.
AIR_KG_PER_M3 = 1.2
WIND_MPS = 5.0
CALM_MPS = 1e-3


def _tilted(q: Quantities, uphill: tuple[Any, Any], angle: Any) -> dict[str, Any]:
    """Gravity where the ground rises by `angle` (rad) along the unit vector `uphill` in the plane."""
    along = uphill[0] * q["gravity_x_mps2"] + uphill[1] * q["gravity_y_mps2"]
    normal = q["gravity_normal_mps2"]
    change = along * (ca.cos(angle) - 1.0) - normal * ca.sin(angle)
    return {
        "gravity_x_mps2": q["gravity_x_mps2"] + uphill[0] * change,
        "gravity_y_mps2": q["gravity_y_mps2"] + uphill[1] * change,
        "gravity_normal_mps2": normal * ca.cos(angle) + along * ca.sin(angle),
    }


def _blown(q: Quantities, area: Any, air: tuple[Any, Any]) -> dict[str, Any]:
    """Drag of air that moves by `air` (m/s, body axes) on `area` m2, drag coefficient included."""
    x, y = air[0] - q["u"], air[1] - q["v"]
    push = 0.5 * AIR_KG_PER_M3 * area * ca.sqrt(x * x + y * y + CALM_MPS**2)
    return {
        "body_force_x_n": q["body_force_x_n"] + push * x,
        "body_force_y_n": q["body_force_y_n"] + push * y,
    }


FORMS = (
    Form(
        "slope", "uniform", one("rad", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: _tilted(q, (1.0, 0.0), e)},
        "the plane rises by e along its x", "geometry",
    ),
    Form(
        "slope", "along_track", one("rad", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: _tilted(q, (ca.cos(q["yaw"]), ca.sin(q["yaw"])), e)},
        "the ground rises by e wherever the robot heads", "geometry",
    ),
    Form(
        "cross_slope", "uniform", one("rad", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: _tilted(q, (0.0, 1.0), e)},
        "the plane rises by e along its y", "geometry",
    ),
    Form(
        "cross_slope", "camber", one("rad", 0.03, -0.3, 0.3),
        {"vehicle": lambda q, e: _tilted(q, (-ca.sin(q["yaw"]), ca.cos(q["yaw"])), e)},
        "the ground rises by e to the robot's left", "geometry",
    ),
    Form(
        "aerodynamic_drag", "still_air", one("m2", 0.5, 0.0, 10.0),
        {"body": lambda q, e: _blown(q, e, (0.0, 0.0))},
        "force rho/2 e V^2 against the motion, rho 1.2 kg/m3", "Rayleigh 1876",
    ),
    Form(
        "aerodynamic_drag", "wind", one("m2", 0.5, 0.0, 10.0),
        {"body": lambda q, e: _blown(q, e, (q["cos_yaw"] * WIND_MPS, -q["sin_yaw"] * WIND_MPS))},
        "the same against the air, which moves at 5 m/s along the plane's x", "Rayleigh 1876",
    ),
)  # fmt: skip
