"""Published soils: our own table of measured Bekker and Janosi numbers, one a row with its source.

A soil is called `collection:name`, e.g. `wong:lete_sand`; where one soil was measured at several
moistures, its name ends in the percentage. What no table gives (vibration, rolling resistance, passive
pressure) stands in `params/published_soil.yaml`.
"""

import csv
import functools
import math
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.yaml_file import read_yaml

PARAMS = Path(__file__).parents[1] / "params"
"""Folder of the parameter files that come with the library."""
_COLUMNS = {
    "k_c_kn_per_m_n1": ("pressure", "k_c_n_per_m_n1", 1e3),
    "k_phi_kn_per_m_n2": ("pressure", "k_phi_n_per_m_n2", 1e3),
    "exponent": ("pressure", "exponent", 1.0),
    "cohesion_kpa": ("shear", "cohesion_pa", 1e3),
    "friction_angle_deg": ("shear", "friction_angle_rad", math.pi / 180.0),
    "shear_modulus_cm": ("shear", "shear_modulus_m", 1e-2),
    "unit_weight_kn_per_m3": ("passive", "unit_weight_n_per_m3", 1e3),
}
"""Columns of the table, in the units of print: section and key of a soil file, and the factor to SI."""
MOISTURE_POINTS = 3.0
"""A soil measured at one moisture is taken to hold this many points of it to either side (assumed)."""


@functools.cache
def published_soils() -> dict[str, dict[str, str]]:
    """Rows of the table by `collection:name`: the texts of its columns."""
    rows = csv.DictReader((PARAMS / "soil_table.csv").read_text(encoding="utf-8").splitlines())
    return {f"{row['collection']}:{row['name']}": row for row in rows}


def is_published(name: str) -> bool:
    """Whether a name asks for the table: it begins with one of its collections and a colon."""
    return name.partition(":")[0] in {row["collection"] for row in published_soils().values()} and ":" in name


def published_soil(name: str) -> dict[str, Any]:
    """Content of the soil file that a row of the table stands for.

    Raises:
        ConfigError: no such row; those of its collection are listed.
    """
    row = published_soils().get(name)
    if row is None:
        same = [known for known in published_soils() if known.startswith(name.partition(":")[0] + ":")]
        raise ConfigError(f"unknown published soil '{name}'", remedy=f"known are {', '.join(same)}")
    content: dict[str, Any] = {key: dict(section) for key, section in _unpublished().items()}
    content |= {"name": row["name"], "description": row["description"]}
    for column, (section, key, factor) in _COLUMNS.items():
        if row[column]:
            content[section][key] = {"value": factor * float(row[column]), "source": row["source"]}
    if row["moisture_percent"]:
        wet = float(row["moisture_percent"])
        content["validity"]["moisture_percent"] = {
            "value": [max(wet - MOISTURE_POINTS, 0.0), wet + MOISTURE_POINTS], "source": row["source"]
        }  # fmt: skip
    return content


@functools.cache
def _unpublished() -> dict[str, dict[str, Any]]:
    return read_yaml(PARAMS / "published_soil.yaml")
