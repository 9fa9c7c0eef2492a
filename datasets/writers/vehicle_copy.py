"""A copy, in the log folder, of the vehicle file that a recording names: the folder can be moved."""

import shutil
from pathlib import Path

from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.yaml_file import dump_yaml, read_yaml

COPY = "vehicle.yaml"
MOST_FILES = 10
"""So many files may extend each other; a circle is refused where the vehicle is loaded."""


def vehicle_file(vehicle: str | None) -> Path | None:
    """The absolute path of the file that a recording names as its vehicle; None for a name or no vehicle."""
    path = expanded(vehicle or "")
    return path.resolve() if path.suffix in (".yaml", ".yml") and path.is_file() else None


def copy_vehicle(file: Path, folder: Path) -> None:
    """Copy a vehicle file to `vehicle.yaml`, and each file it extends to `vehicle_2.yaml`, ...

    Raises:
        ConfigError: it is not YAML. OSError: it cannot be copied.
    """
    name = COPY
    for number in range(2, MOST_FILES + 2):
        content = read_yaml(file)
        robot = content.get("robot")
        under = robot.get("extends") if isinstance(robot, dict) else None
        below = vehicle_file(str(file.parent / expanded(under))) if isinstance(under, str) else None
        if below is None or not isinstance(robot, dict):
            shutil.copyfile(file, folder / name)
            return
        following = f"vehicle_{number}.yaml"
        dump_yaml(folder / name, {**content, "robot": {**robot, "extends": following}})
        file, name = below, following
