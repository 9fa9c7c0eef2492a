"""JSON schemas of the files that users write, for editors; stored in docs/schemas.

python -m terrafusion.fusion.api.file_schemas docs/schemas
"""

import json
import sys
from pathlib import Path
from typing import Any

from terrafusion.datasets.catalog.catalog import SetFile
from terrafusion.datasets.core.config import schema
from terrafusion.datasets.core.robot import RobotFile
from terrafusion.datasets.readers.log_meta import MetaFile
from terrafusion.datasets.readers.text.column_map import ColumnMapFile
from terrafusion.fusion.grounds.file import GroundsFile
from terrafusion.fusion.noise.modes import ModesFile
from terrafusion.fusion.noise.policy import PolicyFile
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.scenario.file import ScenarioFile
from terrafusion.twin.sweep.load import SweepFile

KINDS: dict[str, Any] = {
    "vehicle": VehicleParams,
    "soil": SoilParams,
    "scenario": ScenarioFile,
    "sweep": SweepFile,
    "policy": PolicyFile,
    "modes": ModesFile,
    "grounds": GroundsFile,
    "meta": MetaFile,
    "column_map": ColumnMapFile,
    "catalog": dict[str, SetFile],
}
"""Kinds of files, and the types they are loaded as."""


def file_schema(kind: str) -> dict[str, Any]:
    """JSON schema of one of `KINDS`.

    Raises:
        KeyError: unknown kind.
    """
    title = f"terrafusion {kind.replace('_', ' ')} file"
    found = schema(KINDS[kind], title)
    if kind == "vehicle":
        found = _either(schema(RobotFile, title), found)
    return found | {"additionalProperties": True} if kind == "meta" else found  # unknown keys are kept


def _either(short: dict[str, Any], full: dict[str, Any]) -> dict[str, Any]:
    """Schema of files of one form or the other."""
    common = {"$defs": {**short.pop("$defs"), **full.pop("$defs")}}
    common |= {key: full[key] for key in ("$schema", "title")}
    forms = [{k: v for k, v in form.items() if k not in common} for form in (short, full)]
    return {**common, "anyOf": forms}


def write_schemas(folder: Path) -> None:
    """Write the schemas of all kinds as `<kind>.schema.json`."""
    for kind in KINDS:
        text = json.dumps(file_schema(kind), indent=1, allow_nan=False)
        (folder / f"{kind}.schema.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1]))
