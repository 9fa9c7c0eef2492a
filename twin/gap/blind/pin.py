"""Version of the plant: a hash over its source, shapes, drives, severities and the numbers it takes."""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import resources

from terrafusion.twin.gap.blind.plan import SOILS, VEHICLE
from terrafusion.twin.gap.blind.plant.spec import RunSpec, Segment, stacked_numbers
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

PINNED = "bac4ad5b249381309901a23944b20431e226ccfb54037bbb0e90a4d6283ff8d9"
"""`plant_sha256()` of the plant that stored results are of; change it only with a new run of the study."""

BESIDE_PLANT = ("drives.py", "shapes.py", "severity.py", "severity.yaml")


@functools.cache
def plant_sha256() -> str:
    """Hash (hex) of the plant as it is: results with different hashes are not compared.

    Numbers of vehicles and soils count as far as the plant takes them, to twelve digits.
    """
    digest = hashlib.sha256()
    root = resources.files("terrafusion.twin.gap.blind")
    with resources.as_file(root) as folder:
        for file in (*sorted((folder / "plant").glob("*.py")), *(folder / name for name in BESIDE_PLANT)):
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
            digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    digest.update(json.dumps(_numbers(), sort_keys=True).encode())
    return digest.hexdigest()


def _numbers() -> dict[str, dict[str, list[str]]]:
    """Numbers of the robot as its data sheet has it on each soil, by soil and name."""
    vehicle, drive = load_vehicle(VEHICLE), (Segment(1.0),)
    runs = {soil: RunSpec(vehicle, load_soil(soil), drive, noiseless=True) for soil in SOILS}
    return {
        soil: {name: [f"{x:.12g}" for x in value.ravel()] for name, value in stacked_numbers([run]).items()}
        for soil, run in runs.items()
    }
