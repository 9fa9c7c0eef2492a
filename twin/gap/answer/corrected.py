"""Writes a vehicle file with the effects found: as numbers that it has, or in its section `effects`."""

import copy
from pathlib import Path
from typing import Any

from terrafusion.twin.calibrate.files import mark_measured, set_number, write_yaml
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.effects.catalogue import by_key
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.model.vehicle_file import read_vehicle

FIELDS = {
    "mass/at_cg": (("body.mass_kg", "times"), ("body.yaw_inertia_kgm2", "times")),
    "cg_lateral/shift": (("body.cg_left_m", "plus"),),
    "cg_longitudinal/shift": (("body.cg_forward_m", "plus"),),
    "wheel_radius/scale": (("wheel.radius_m", "times"),),
    "track_width/scale": (("body.track_m", "times"),),
    "torque_limit/scale": (("drive.torque_limit_nm", "less"),),
    "drivetrain_friction/efficiency": (("drive.gear_efficiency", "less"),),
    "dead_time/transport": (("drive.dead_time_s", "plus"),),
    "actuator_lag/torque": (("drive.lag_s", "plus"),),
}
"""Numbers of the vehicle file that an effect changes: by a factor 1 + e, 1 - e, or by e."""
_CHANGES = {
    "times": lambda x, e: x * (1.0 + e),
    "less": lambda x, e: x * (1.0 - e),
    "plus": lambda x, e: x + e,
}


def values_of(diagnosis: GapDiagnosis) -> dict[str, float]:
    """Parameters of the named effects, by key."""
    answer = diagnosis.to_json()
    return {
        key: number["value"]
        for cause in answer["causes"]
        if cause["effect"] in answer["named"]
        for key, number in cause["parameters"].items()
    }


def write_corrected(diagnosis: GapDiagnosis, vehicle: str | Path, target: Path) -> list[str]:
    """Write the vehicle file with the named effects; returns the changes, in sentences.

    The twin of that file has them: `terrafusion gap` and `simulate` with `--vehicle` as with `--effect`.

    Raises:
        ConfigError: the vehicle file cannot be read.
        TerrafusionError: the file cannot be written.
    """
    raw, _ = read_vehicle(vehicle)
    out, changes, model = copy.deepcopy(raw), list[str](), diagnosis.evidence.model
    for key, value in values_of(diagnosis).items():
        if key in FIELDS:
            changes += [_change_field(out, model.vehicle, path, how, value) for path, how in FIELDS[key]]
        else:
            changes.append(_change_effect(out, model, key, value))
    if not changes:
        return ["no effect was named: the vehicle's file stays as it is"]
    write_yaml(target, out)
    return [*changes, f"written to {target}"]


def _change_effect(raw: dict[str, Any], model: Model, key: str, value: float) -> str:
    """Adds to an effect that is no number of the vehicle."""
    before, number = by_key(model.vehicle.effects).get(key, 0.0), model.parameter(key)
    after = min(max(before + value, number.low), number.high)
    source = f"gap diagnosis: {value:+.4g} on {before:.6g}"
    raw.setdefault("effects", {})[key] = {"value": after, "source": source}
    return f"effects.{key}: {before:.6g} -> {after:.6g}"


def _change_field(raw: dict[str, Any], vehicle: VehicleParams, path: str, how: str, value: float) -> str:
    before: Any = vehicle
    for part in path.split("."):
        before = getattr(before, part)
    after = float(_CHANGES[how](before, value))
    set_number(raw, path, after, f"gap diagnosis: {value:+.4g} on {before:.6g}")
    mark_measured(raw, path)
    return f"{path}: {before:.6g} -> {after:.6g}"
