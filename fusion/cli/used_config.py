"""`config.json`, written beside the results: what a run was made with, equal for equal runs.

It holds neither a time nor where the results went.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.fusion.cli.common import command_line
from terrafusion.fusion.reports.page import versions_of, write_text

CONFIG = "config.json"
SCHEMA = "terrafusion.config/1"
PACKAGES = ("gtsam", "casadi", "numpy", "scipy")


def write_config(out: Path, command: str, given: Mapping[str, Any], vehicle: Any) -> None:
    """Write `config.json` into the folder `out`; `given` are the options with their defaults in place.

    `vehicle` is the `VehicleParams` of the run; None where `given` names it, or where there are many. A
    TerrafusionError where the file cannot be written.
    """
    if vehicle is None and given.get("vehicle") is not None:
        from terrafusion.twin.model.vehicle import load_vehicle

        vehicle = load_vehicle(given["vehicle"])
    content = {
        "schema": SCHEMA,
        "command": command,
        "command_line": command_line(),
        "options": {name: value for name, value in given.items() if name != "out"},
        "seed": given.get("seed"),
        "vehicle": None if vehicle is None else {"name": vehicle.name, "sha256": hash_of(vehicle)},
        "versions": versions_of(PACKAGES),
    }
    write_text(out / CONFIG, json.dumps(content, indent=2, default=str) + "\n")


def hash_of(vehicle: Any) -> str:
    """SHA-256 of all numbers of a vehicle, wherever its file lies."""
    text = json.dumps(dataclasses.asdict(vehicle), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
