"""Published JSON schemas: as the code makes them, true of the library's files, strict as the loaders are."""

from __future__ import annotations

import copy
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.fusion.api.file_schemas import KINDS, write_schemas

STORED = Path(__file__).parents[3] / "docs" / "schemas"
PLACES = {
    "vehicle": ("twin.params", "vehicles/*.yaml"),
    "soil": ("twin.params", "soils/*.yaml"),
    "scenario": ("twin.params", "scenarios/*.yaml"),
    "sweep": ("twin.params", "sweeps/*.yaml"),
    "policy": ("fusion.noise", "policy.yaml"),
    "modes": ("fusion.noise", "modes.yaml"),
    "catalog": ("datasets.catalog", "catalog.yaml"),
}
GYRO = {"imu": {"gyro_z_radps": {"column": "wz", "sign": "-"}, "gyro_x_radps": 3}}
TALLY = {"mean": 0.1, "spread": 0.02, "count": 12.0}
GROUND: dict[str, Any] = {
    "name": "lawn", "signature": {"z_low": TALLY}, "slip": TALLY, "side_slip": TALLY, "friction": [0.1] * 10,
    "friction_windows": 0.0, "evidence": 0.0, "first": "2026-05-01", "last": "2026-05-02",
}  # fmt: skip
WRITTEN: dict[str, dict[str, Any]] = {
    "meta": {"start_ns": 5, "vehicle": "husky", "antenna_m": [0, 0, 1], "datum": [60.1, 24.8, 10]},
    "grounds": {"schema": "terrafusion.grounds/1", "robot": "husky", "grounds": [GROUND]},
    "column_map": {"time": "t", "channels": GYRO, "track_m": 0.5},
}


def validator(kind: str) -> Any:
    schema = json.loads((STORED / f"{kind}.schema.json").read_text(encoding="utf-8"))
    return jsonschema.Draft202012Validator(schema)


def examples(kind: str) -> list[dict[str, Any]]:
    if kind in WRITTEN:
        return [WRITTEN[kind]]
    package, pattern = PLACES[kind]
    with resources.as_file(resources.files(f"terrafusion.{package}")) as folder:
        return [read_yaml(path) for path in sorted(Path(folder).glob(pattern))]


def test_the_stored_schemas_are_those_of_the_code(tmp_path: Path) -> None:
    """Else run `python -m terrafusion.fusion.api.file_schemas docs/schemas`."""
    write_schemas(tmp_path)
    for kind in KINDS:
        name = f"{kind}.schema.json"
        assert (STORED / name).read_text("utf-8") == (tmp_path / name).read_text("utf-8"), kind


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_takes_good_files_and_judges_unknown_keys(kind: str) -> None:
    """Every file refuses them but `meta.yaml`, of which the reader keeps them."""
    schema, files = validator(kind), examples(kind)
    assert files
    for content in files:
        schema.validate(content)
    strange = copy.deepcopy(files[0])
    section = next(iter(strange.values())) if kind == "catalog" else strange
    section["colour"] = "red"
    assert schema.is_valid(strange) == (kind == "meta")


def test_a_schema_knows_ranges_and_sources() -> None:
    schema, husky = validator("vehicle"), examples("vehicle")[-1]
    for value in (-3.0, "heavy", {"value": -3.0, "source": "scales"}, {"value": 30.0}):
        wrong = copy.deepcopy(husky)
        wrong["body"]["mass_kg"] = value
        assert not schema.is_valid(wrong), value
