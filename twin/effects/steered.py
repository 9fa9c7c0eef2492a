"""Wheels turned by an angle: the geometry of steered drives, as a term that is in their graphs only.

Angles are those of the bicycle model, one an axle. All wheels roll about one centre (Ackermann): with the
tangents f and r of the angles the path of the body origin has the curvature k = (f - r) / wheelbase and goes
sideways at the share s = (f + r) / 2, so the ground passes a wheel at (x, y) along (1 - k y, s + k x).
"""

from collections.abc import Mapping
from typing import Any

from terrafusion.datasets.core.sensors import STEERED_DRIVES
from terrafusion.twin.effects.form import Form, one


def drive_terms(drive: str) -> dict[str, float]:
    """The values by key that make a plant steer as a type of drive does."""
    return {STEERED.key: 1.0} if drive in STEERED_DRIVES else {}


def wheel_path(front_tan: Any, rear_tan: Any, wheelbase_m: Any, x_m: Any, y_m: Any) -> tuple[Any, Any]:
    """Velocity of a wheel at (x, y) from the body origin over the origin's along body x (any expressions)."""
    curvature, aside = (front_tan - rear_tan) / wheelbase_m, 0.5 * (front_tan + rear_tan)
    return 1.0 - curvature * y_m, aside + curvature * x_m


def _corner(w: Mapping[str, Any], share: Any) -> Mapping[str, Any]:
    import casadi as ca

    tangents = (share * ca.tan(w["steer_front_rad"]), share * ca.tan(w["steer_rear_rad"]))
    x, y = w["hub_forward_m"] + w["cg_forward_m"], w["hub_left_m"] + w["cg_left_m"]
    along, across = wheel_path(*tangents, w["wheelbase_m"], x, y)
    length = ca.sqrt(along * along + across * across)
    return {"heading_cos": along / length, "heading_sin": across / length, "path_share": length}


STEERED = Form(
    "drive", "steered", one("", 1.0, 0.0, 1.0),
    {"corner": _corner, "motor": lambda w, share: {"command_radps": w["command_radps"] * w["path_share"]}},
    "a wheel at (x, y) rolls along (1 - k y, s + k x), k = (tan f - tan r) / L, s = (tan f + tan r) / 2",
    "Ackermann geometry", candidate=False,
)  # fmt: skip
"""Share 1 of the angles among the inputs: part of a steered vehicle's plant, no effect of the catalogue."""
