"""Vehicle and soil files with the calibrated numbers in place, each with where it comes from."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.twin.calibrate.identifiability import IDENTIFIED
from terrafusion.twin.calibrate.result import Calibration, FittedParameter
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.soil_table import is_published, published_soil
from terrafusion.twin.model.vehicle_file import read_vehicle


def write_files(
    calibration: Calibration, out: Path, vehicle: str | Path, soils: Mapping[str, str | Path] | None = None
) -> list[Path]:
    """Write `vehicle.yaml`, and `soil.yaml` (or `soil_NAME.yaml` for several), which load as they are.

    Args:
        out: the folder; it is made where it is missing.
        vehicle, soils: names or files that the calibration started from; a soil is taken by its own name
            where it is not given.

    Raises:
        ConfigError: one of those cannot be read.
        TerrafusionError: the folder cannot be written.
    """
    model, logs = calibration.model, ", ".join(calibration.sensor_errors)
    if not calibration.converged():
        logs += " by a search that did not converge"
    raw, _ = read_vehicle(vehicle)
    own = ("vehicle.", "effects.")
    mine = {f.name.removeprefix("vehicle."): f for f in calibration.fitted if f.name.startswith(own)}
    updated = _updated(raw, model.vehicle, mine, logs)
    mark_measured(updated, *model.vehicle.measured)
    written = [write_yaml(out / "vehicle.yaml", updated)]
    for name, soil in model.soils.items():
        given = str((soils or {}).get(name, name))
        raw = published_soil(given) if is_published(given) else read_named("soils", given, kind="terrain")[0]
        mine = {
            f.name.removeprefix(f"{name}."): f for f in calibration.fitted if f.name.startswith(f"{name}.")
        }
        target = out / ("soil.yaml" if len(model.soils) == 1 else f"soil_{name}.yaml")
        written.append(write_yaml(target, _updated(raw, soil, mine, logs)))
    return written


def _updated(
    raw: dict[str, Any], values: Any, fitted: Mapping[str, FittedParameter], logs: str
) -> dict[str, Any]:
    out = copy.deepcopy(raw)
    for name, f in fitted.items():
        set_number(out, name, f.value, _source(f, logs))
    _overridden(out, values)
    return out


def set_number(raw: dict[str, Any], name: str, value: float, source: str) -> None:
    """Put a number at a dotted name; its range `valid` is dropped where the number lies outside."""
    *sections, last = name.split(".")
    for section in sections:
        raw = raw.setdefault(section, {})
    raw[last] = _entry(raw.get(last), value, source)


def _entry(before: Any, value: Any, source: str) -> dict[str, Any]:
    """A number in the place of an entry; its range `valid` is dropped where the number lies outside."""
    valid = before.get("valid") if isinstance(before, dict) else None
    if valid is None:
        return {"value": value, "source": source}
    if isinstance(value, float) and valid[0] <= value <= valid[1]:
        return {"value": value, "valid": valid, "source": source}
    return {"value": value, "source": f"{source}; outside the validity range {valid} of the file before"}


def _source(f: FittedParameter, logs: str) -> str:
    if f.status == IDENTIFIED:
        return f"calibrated from {logs}: 1 sigma {f.sigma:.3g}"
    return f"{f.status} by the calibration from {logs} (1 sigma {f.sigma:.3g}); before: {f.start:.6g}"


def _overridden(raw: dict[str, Any], values: Any) -> None:
    """Numbers that the log itself gave replace those of the file."""
    for name, entry in list(raw.items()):
        value = getattr(values, name, None)
        if not isinstance(entry, dict) or value is None or isinstance(value, KnownNumber):
            continue  # what is known of a sensor comes from the file itself
        if "value" not in entry:
            _overridden(entry, value)
        elif entry["value"] != (plain := list(value) if isinstance(value, tuple) else value):
            raw[name] = _entry(entry, plain, "as the log says")


def mark_measured(vehicle: dict[str, Any], *names: str) -> None:
    """Mark numbers of a vehicle's file as estimated for this robot (`VehicleParams.measured`)."""
    if names:
        vehicle["measured"] = sorted({*vehicle.get("measured", ()), *names})


def write_yaml(path: Path, content: dict[str, Any]) -> Path:
    """Write a mapping as YAML, in the order of its keys."""
    return dump_yaml(path, content, default_flow_style=False)
