"""Vehicle files of the short form, such as one with the numbers that `sensor_calibration` found."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.robot import KnownNumber, RobotFile
from terrafusion.datasets.core.yaml_file import dump_yaml
from terrafusion.fusion.sensor_calibration import SensorCalibration
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.vehicle import vehicle_names
from terrafusion.twin.model.vehicle_file import is_short

COMMENT_COLUMN = 66
GEOMETRY = ("wheel_radius_m", "track_m", "wheelbase_m", "imu_m")
"""Geometry that logs report, by its name in both `Overrides` and the file."""


def write_robot(path: Path, found: SensorCalibration) -> Path:
    """Write the file; it loads as it is, wherever a vehicle is asked for.

    A file of the short form that the calibration started from is taken over with the new numbers in place,
    another one is extended.

    Raises:
        ConfigError: the file would overwrite the one it extends, or a number is out of range.
        TerrafusionError: it cannot be written.
    """
    robot = _before(path, found.extends)
    if found.overrides.drive is not None:
        robot.setdefault("drive", found.overrides.drive)
    for name in GEOMETRY:
        value = getattr(found.overrides, name)
        if value is not None and name not in robot:
            robot[name] = raw_number(KnownNumber(value, "assumed"))
    for name, number in vars(found.known()).items():
        if number is not None:
            robot[name] = raw_number(number)
    return write_section(path, robot, {})


def _before(path: Path, vehicle: str) -> dict[str, Any]:
    """What the file is made from: another one of the short form, or the name or path of a complete one."""
    if vehicle in vehicle_names():
        return {"extends": vehicle}
    old = expanded(vehicle)
    raw, _ = read_named("vehicles", vehicle, kind="vehicle")
    if is_short(raw):
        robot = dict(raw["robot"])
        under = robot.get("extends", "generic")
        return robot | {"extends": under if under in vehicle_names() else seen_from(path, old.parent / under)}
    if path.resolve() == old.resolve():
        raise ConfigError(
            "the calibrated file would overwrite the one it extends", file=path, remedy="give another --out"
        )
    return {"extends": seen_from(path, old)}


def seen_from(path: Path, other: Path) -> str:
    """What a vehicle file `path` calls another one that it extends."""
    return Path(os.path.relpath(other.resolve(), path.resolve().parent)).as_posix()


def raw_number(number: KnownNumber) -> dict[str, Any]:
    """A number as it stands in the file, without what it leaves open."""
    entries = dataclasses.asdict(number).items()
    return {key: list(v) if isinstance(v, tuple) else v for key, v in entries if v not in (None, ())}


def write_section(path: Path, robot: Mapping[str, Any], comments: Mapping[str, str], head: str = "") -> Path:
    """Write the section `robot`, an entry a line with its comment, below a comment at the head.

    Raises:
        ConfigError: a number is out of range.
        TerrafusionError: the file cannot be written.
    """
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    structure(RobotFile, {"robot": dict(robot)}, file=path)
    section = CommentedMap()
    for name, entry in robot.items():
        section[name] = entry
        if isinstance(entry, (dict, list)):
            section[name] = CommentedMap(entry) if isinstance(entry, dict) else CommentedSeq(entry)
            section[name].fa.set_flow_style()
        if name in comments:
            section.yaml_add_eol_comment(" ".join(comments[name].split()), name, column=COMMENT_COLUMN)
    content = CommentedMap(robot=section)
    if head:
        content.yaml_set_start_comment(head)
    return dump_yaml(path, content, width=1000)
