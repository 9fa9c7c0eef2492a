"""Version of the plant: a hash over its source, its shapes and the numbers it takes."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable
from importlib import resources

from terrafusion.twin.gap.blind.plan import SOILS, VEHICLE
from terrafusion.twin.gap.blind.plant.spec import RunSpec, Segment, stacked_numbers
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

PINNED = "bb1374d24fa601db3bc37ec90389fb6a03009bbc07ff0f69256bbc6b85d92878"
"""`plant_sha256()` of the plant that stored results are of; change it only with a new run of the study."""
PLANT = ("plant/*.py", "shapes.py")
TRIALS = ("drives.py", "sensitivity.yaml")
"""Files of the plant, and what trials depend on beside it, plan and seed."""


@functools.cache
def plant_sha256() -> str:
    """Hash (hex) of the plant as it is: results with different hashes are not compared.

    Numbers of vehicles and soils count as far as the plant takes them, to twelve digits.
    """
    return _sha256(PLANT, json.dumps(_numbers(), sort_keys=True))


@functools.cache
def trials_sha256() -> str:
    """Hash (hex) of drives and severities: a check is not continued with others."""
    return _sha256(TRIALS)


def _sha256(patterns: Iterable[str], more: str = "") -> str:
    digest = hashlib.sha256()
    with resources.as_file(resources.files("terrafusion.twin.gap.blind")) as folder:
        for file in (file for pattern in patterns for file in sorted(folder.glob(pattern))):
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
            digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    digest.update(more.encode())
    return digest.hexdigest()


def _numbers() -> dict[str, dict[str, list[str]]]:
    """Numbers of the robot as its data sheet has it on each soil, by soil and name."""
    vehicle, drive = load_vehicle(VEHICLE), (Segment(1.0),)
    runs = {soil: RunSpec(vehicle, load_soil(soil), drive, noiseless=True) for soil in SOILS}
    return {
        soil: {name: [f"{x:.12g}" for x in value.ravel()] for name, value in stacked_numbers([run]).items()}
        for soil, run in runs.items()
    }
