"""Vehicle files in their two forms: complete, or only what differs from another one (`robot`)."""

import copy
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.robot import KnownNumber, Robot, RobotFile, SensorNumbers
from terrafusion.datasets.core.sensors import STEERED_DRIVES, UP_FACTOR
from terrafusion.twin.model.library import known_names, read_named

ANTENNA, IMU = ("sensors", "gnss", "antenna_m"), ("sensors", "imu", "position_m")
FLAT, UP = ("sensors", "gnss", "sigma_horizontal_m"), ("sensors", "gnss", "sigma_vertical_m")
PLACES = {
    "wheel_radius_m": (("odometry", "wheel_radius_m"), ("wheel", "radius_m")),
    "track_m": (("odometry", "track_m"), ("body", "track_m")),
    "wheelbase_m": (("body", "wheelbase_m"),),
    "antenna_m": (ANTENNA,),
    "mass_kg": (("body", "mass_kg"),),
    "imu_m": (IMU,),
    "gnss_sigma_m": (FLAT,),
}
"""Numbers of the short form and their places in a complete file; the last one is the body's own."""
INERTIA, SIZE = ("body", "yaw_inertia_kgm2"), ("mass_kg", "wheel_radius_m", "track_m")
Powers = Mapping[tuple[str, ...], tuple[int, int, int]]
RESIZED: Powers = {
    ("body", "payload_max_kg"): (1, 0, 0),
    INERTIA: (1, 0, 2),
    ("body", "wheelbase_m"): (0, 0, 1),
    ("body", "cg_height_m"): (0, 1, 0),
    ("wheel", "width_m"): (0, 1, 0),
    ("wheel", "inertia_kgm2"): (1, 2, 0),
    ("drive", "no_load_speed_radps"): (0, -1, 0),
    ("drive", "stall_torque_nm"): (1, 1, 0),
    ("drive", "torque_limit_nm"): (1, 1, 0),
    ("drive", "speed_loop_p_nms"): (1, 2, 0),
    ("drive", "speed_loop_i_nm"): (1, 2, 0),
}
"""Numbers of the generic vehicle, and the powers of the numbers `SIZE` with which they grow: a robot of its
shape, as fast, as strong for its weight, and as quick to follow its commands."""
BY_SENSORS = "as known of the robot's sensors"
"""Source of errors of the twin's sensors that a file's section `robot` makes."""
MEASURED = ("measured", "field log")
"""Beginnings of sources of numbers that were measured on the robot of the file."""


def read_vehicle(name_or_path: str | Path) -> tuple[dict[str, Any], str]:
    """Content of a vehicle file, complete, with effects by key, and what to call it in messages.

    Raises:
        ConfigError: neither a known name nor a file, or one of the short form with errors; all of them.
    """
    raw, file = _read(name_or_path, ())
    if isinstance(raw.get("effects"), Mapping):
        from terrafusion.twin.effects.catalogue import by_key

        try:
            raw = {**raw, "effects": by_key(raw["effects"])}
        except ConfigError as error:
            raise ConfigError(error.what, file=file, remedy=error.remedy) from error
    return _with_sensor_errors(raw), file


def _with_sensor_errors(raw: dict[str, Any]) -> dict[str, Any]:
    """The twin's fixes are as late, and its gyro is as wrong, as is known of the robot's.

    Effects that the file has itself stay.
    """
    scale, bias = 1.0 + max(_known(raw, "gyro_scale"), -0.5), _known(raw, "gyro_bias_radps")
    out, late = dict(raw), _known(raw, "gnss_delay_s")
    if late and isinstance(raw.get("realism"), Mapping):
        out["realism"] = {**raw["realism"], "gnss_latency_s": {"value": late, "source": BY_SENSORS}}
    errors = {"gyro_scale/scale": 1.0 / scale - 1.0, "gyro_bias/constant": bias * scale}
    effects = dict(raw.get("effects") or {})
    if any(errors.values()) and isinstance(raw.get("effects", {}), Mapping):
        from terrafusion.twin.effects.catalogue import lookup

        for key, value in errors.items():
            own = isinstance(entry := effects.get(key), Mapping) and entry.get("source") != BY_SENSORS
            if value and not own and abs(value) <= lookup(key)[1].high:
                effects[key] = {"value": value, "source": BY_SENSORS}
        out["effects"] = effects
    return out


def _known(raw: dict[str, Any], name: str) -> float:
    """A number of the file's sensors that is not assumed; 0 for none."""
    robot = raw.get("robot")
    entry = robot.get(name) if isinstance(robot, Mapping) else None
    if not isinstance(entry, Mapping) or entry.get("known") == "assumed":
        return 0.0
    value = entry.get("value")
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else 0.0


def is_short(raw: dict[str, Any]) -> bool:
    """Whether the content of a file is of the short form: a complete one has a body."""
    return "body" not in raw and not raw.keys().isdisjoint({"robot", *PLACES})


def _read(name_or_path: str | Path, above: tuple[str, ...]) -> tuple[dict[str, Any], str]:
    raw, file = read_named("vehicles", name_or_path, kind="vehicle")
    if is_short(raw):
        robot = structure(RobotFile, raw, file=file).robot
        return _completed(robot, raw["robot"], file, above), file
    return (raw if _shipped(name_or_path) else _with_measured_antenna(raw)), file


def _shipped(name_or_path: str | Path) -> bool:
    return str(name_or_path) in known_names("vehicles")


def _completed(robot: Robot, raw: dict[str, Any], file: str, above: tuple[str, ...]) -> dict[str, Any]:
    """The content of the file that it extends, with the numbers of `robot` in place."""
    here = str(expanded(file).resolve())
    if here in above:
        raise ConfigError(f"'extends: {robot.extends}' comes back to this file", file=file)
    under = robot.extends
    if not _shipped(under):
        path = expanded(file).parent / expanded(under)
        if not path.is_file():
            raise ConfigError(
                f"'robot.extends' is '{under}', neither a known vehicle nor a file beside this one",
                file=file,
                remedy=f"known are {', '.join(known_names('vehicles'))}",
            )
        under = str(path)
    base, _ = _read(under, (*above, here))
    out = copy.deepcopy(base)
    for place in (ANTENNA, IMU) if _shipped(under) else ():  # these are each robot's own
        entry = _at(out, place[:-1])[place[-1]]
        entry["source"] = f"assumed: as of '{robot.extends}', {entry['source']}"
    out["name"] = robot.name or out["name"]
    if robot.description is not None or _shipped(robot.extends):
        out["description"] = robot.description or f"as '{robot.extends}' but for what its own file says"
    if robot.drive is not None:
        out["drive"]["type"] = robot.drive
        if robot.drive not in STEERED_DRIVES:
            out.pop("steering", None)
    out["topics"] = {**out.get("topics", {}), **robot.topics}
    imu = out["sensors"]["imu"]
    imu |= {} if robot.imu_axes is None else {"axes": list(robot.imu_axes)}
    imu |= {} if robot.imu_frame is None else {"frame_id": robot.imu_frame}
    _resize(out, robot, RESIZED if under == "generic" else {INERTIA: (1, 0, 0)})
    for name, places in PLACES.items():
        number = getattr(robot, name)
        if number is not None:
            _place(out, number, places)
    if robot.gnss_sigma_m is not None:
        _place(
            out, dataclasses.replace(robot.gnss_sigma_m, value=UP_FACTOR * robot.gnss_sigma_m.number), (UP,)
        )
    numbers = {name: raw[name] for name in SensorNumbers.__dataclass_fields__ if name in raw}
    if _shipped(under):  # its antenna is not this robot's
        place = _at(out, ANTENNA)["value"]
        numbers = {"antenna_m": {"value": place, "known": "assumed"}, **numbers}
    if numbers or "robot" in out:
        out["robot"] = {**out.get("robot", {}), **numbers}
    return out


def _resize(out: dict[str, Any], robot: Robot, powers: Powers) -> None:
    """Numbers that grow with the robot, as the vehicle below has them in proportion."""
    given = [getattr(robot, name) for name in SIZE]
    places = [PLACES[name][-1] for name in SIZE]
    grown = [
        1.0 if number is None else number.number / _at(out, place)["value"]
        for number, place in zip(given, places, strict=True)
    ]
    for place, own in powers.items():
        factor = math.prod(x**n for x, n in zip(grown, own, strict=True))
        if factor != 1.0:
            entry = _at(out, place)
            entry |= {
                "value": factor * entry["value"],
                "source": f"derived: as of '{robot.extends}', in proportion to the robot",
            }


def _place(out: dict[str, Any], number: KnownNumber, places: tuple[tuple[str, ...], ...]) -> None:
    value = list(number.value) if isinstance(number.value, tuple) else number.value
    for place in places:
        _at(out, place[:-1])[place[-1]] = {"value": value, "source": number.source}
    body = ".".join(places[-1])
    if number.known in ("measured", "calibrated") and places[-1][0] != "sensors":
        out["measured"] = sorted({*out.get("measured", ()), body})


def _at(raw: dict[str, Any], place: tuple[str, ...]) -> dict[str, Any]:
    for part in place:
        raw = raw[part]
    return raw


def _with_measured_antenna(raw: dict[str, Any]) -> dict[str, Any]:
    """A complete file of one robot: says how its antenna is known where the source does."""
    entry: Any = raw
    for part in ANTENNA:
        entry = entry.get(part) if isinstance(entry, dict) else None
    robot = raw.get("robot", {})
    if not isinstance(entry, dict) or not str(entry.get("source", "")).lower().startswith(MEASURED):
        return raw
    if not isinstance(robot, dict) or "antenna_m" in robot:
        return raw
    return {**raw, "robot": {**robot, "antenna_m": {"value": entry.get("value"), "known": "measured"}}}
