"""Reading a scenario file: strict keys and ranges; errors name the key, the value and what is allowed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.config import Quantity, checked_number, shown
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.model.ground import SoilPatches, Variation
from terrafusion.twin.model.library import known_names, read_named
from terrafusion.twin.scenario.scenario import (
    MAX_SLOPE_DEG,
    PLACE,
    Canopy,
    DriveSegment,
    Interval,
    RouteLeg,
    Scenario,
    Stretch,
)

_SECONDS = Quantity("s", 0.0, 36000.0)
_DURATION = Quantity("s", 0.01, 36000.0)
_SPEED = Quantity("m/s", -20.0, 20.0)
_YAW_RATE = Quantity("rad/s", -10.0, 10.0)
_DRIVE = {
    "duration_s": _DURATION,
    "v_mps": _SPEED,
    "yaw_rate_radps": _YAW_RATE,
    "v_amplitude_mps": _SPEED,
    "yaw_rate_amplitude_radps": _YAW_RATE,
    "period_s": Quantity("s", 0.05, 36000.0),
    "end_period_s": Quantity("s", 0.05, 36000.0),
}
_NUMBERS = {
    "duration_s": _DURATION,
    "waypoint_speed_mps": Quantity("m/s", 0.05, 20.0),
    "max_accel_mps2": Quantity("m/s2", 0.01, 50.0),
    "slope_deg": Quantity("deg", 0.0, MAX_SLOPE_DEG),
    "cross_slope_deg": Quantity("deg", -MAX_SLOPE_DEG, MAX_SLOPE_DEG),
    "payload_kg": Quantity("kg", 0.0, 5000.0),
    "aspect_deg": Quantity("deg", -360.0, 360.0),
    "heading_deg": Quantity("deg", -360.0, 360.0),
    "transition": Quantity("m or s", 0.01, 100.0),
}
_INTERVAL = {"start_s": _SECONDS, "duration_s": _DURATION}
_STRETCH = {"start_m": Quantity("m", 0.0, 1e6), "length_m": Quantity("m", 0.1, 1e6)}
_DENSITY = {"density": Quantity("", 0.0, 1.0)}
_LENGTH = Quantity("m", 0.1, 1000.0)
_PERCENT = Quantity("%", 0.0, 500.0)
_VARIATION = {"strength_sigma": Quantity("", 0.0, 1.0), "length_m": _LENGTH}
_PATCHES = {"share": Quantity("", 0.0, 1.0), "length_m": _LENGTH}


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios that come with the library."""
    return known_names("scenarios")


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A scenario by its name in the library, or from a YAML file.

    Raises:
        ConfigError: unknown name (the known ones are listed), unknown key, or a value out of range.
    """
    raw, file = read_named("scenarios", name_or_path, kind="scenario")
    return scenario_of(raw, file, Path(str(name_or_path)).stem)


def scenario_of(raw: dict[str, Any], file: str, stem: str) -> Scenario:
    """The scenario of a file's content; it is called `stem` where the file gives it no name.

    Raises:
        ConfigError: unknown or missing key, or a value of the wrong type or out of range.
    """
    lists = ("drive", "stops", "waypoints", "route", "gnss_outages", "canopy")
    words = ("name", "description", "route_over", "gnss_fix")
    _known(raw, (*_NUMBERS, *lists, *words, "payload_at_m", "variation", "patches"), file, "")
    values: dict[str, Any] = {
        "name": _text(raw, "name", stem, file),
        "description": _text(raw, "description", "", file),
    }
    values |= {
        key: checked_number(raw[key], q, file=file, key=key) for key, q in _NUMBERS.items() if key in raw
    }
    values["drive"] = tuple(DriveSegment(**r) for r in _rows(raw, "drive", _DRIVE, ("duration_s",), file))
    values["stops"] = tuple(Interval(**r) for r in _rows(raw, "stops", _INTERVAL, tuple(_INTERVAL), file))
    values["gnss_outages"] = tuple(_zones(raw, "gnss_outages", {}, file))
    values["canopy"] = tuple(Canopy(*row) for row in _zones(raw, "canopy", _DENSITY, file))
    if "payload_at_m" in raw:
        values["payload_at_m"] = checked_number(raw["payload_at_m"], PLACE, file=file, key="payload_at_m")
    points = [
        checked_number(point, Quantity("m", -1e4, 1e4, size=2), file=file, key=f"waypoints[{i}]")
        for i, point in enumerate(_list(raw, "waypoints", file))
    ]
    values["waypoints"] = tuple(points)
    values["route_over"] = _word(raw, "route_over", ("travel", "time"), file)
    fix = _word(raw, "gnss_fix", ("best", "fixed", "float", "single"), file)
    values["gnss_fix"] = None if fix == "best" else Fix[fix.upper()]
    if "route" in raw:
        values["route"] = _route(raw, values["route_over"], file)
    if "variation" in raw:
        values["variation"] = Variation(**_section(raw, "variation", _VARIATION, file))
    if "patches" in raw:
        values["patches"] = SoilPatches(**_section(raw, "patches", _PATCHES, file, "terrain"))
    if not values["drive"] and not points:
        raise ConfigError(
            "the scenario drives nowhere", file=file, remedy="add 'drive' segments or 'waypoints'"
        )
    if values["drive"] and points:
        raise ConfigError("'drive' and 'waypoints' exclude each other", file=file, remedy="keep one of them")
    for key, missing in (("stops", "drive"), ("waypoint_speed_mps", "waypoints")):
        if raw.get(key) and not values[missing]:
            raise ConfigError(f"'{key}' has no effect without '{missing}'", file=file, remedy="leave it out")
    if "duration_s" not in values:
        if points:
            raise ConfigError("'duration_s' is missing", file=file, remedy="say how long the robot may take")
        values["duration_s"] = sum(segment.duration_s for segment in values["drive"])
    scenario = Scenario(**values)
    _check_times(scenario, file)
    return scenario


def _check_times(scenario: Scenario, file: str) -> None:
    """Refuses what would begin after the drive: it would do nothing."""
    canopy = tuple(trees.zone for trees in scenario.canopy)
    for key, zones in (
        ("stops", scenario.stops),
        ("gnss_outages", scenario.gnss_outages),
        ("canopy", canopy),
    ):
        for i, zone in enumerate(zones):
            if isinstance(zone, Interval) and zone.start_s >= scenario.duration_s:
                raise ConfigError(
                    f"'{key}[{i}].start_s' is {zone.start_s:g}, after the drive's {scenario.duration_s:g} s",
                    file=file,
                    remedy="let it begin earlier, or leave it out",
                )


def _route(raw: dict[str, Any], over: str, file: str) -> tuple[RouteLeg, ...]:
    key = "length_m" if over == "travel" else "length_s"
    legs = []
    rows = _list(raw, "route", file)
    for i, row in enumerate(rows):
        here = f"route[{i}]"
        _known(row, ("terrain", key, "moisture_percent"), file, here)
        if not isinstance(row.get("terrain"), str):
            raise ConfigError(f"'{here}.terrain' is missing", file=file, remedy="name a terrain")
        length = None
        if i < len(rows) - 1:
            if key not in row:
                raise ConfigError(
                    f"'{here}.{key}' is missing", file=file, remedy="only the last leg has no length"
                )
            length = float(checked_number(row[key], Quantity("", 0.1, 1e6), file=file, key=f"{here}.{key}"))  # type: ignore[arg-type]
        wet = row.get("moisture_percent")
        if wet is not None:
            wet = float(checked_number(wet, _PERCENT, file=file, key=f"{here}.moisture_percent"))  # type: ignore[arg-type]
        legs.append(RouteLeg(row["terrain"], length, wet))
    if not legs:
        raise ConfigError("'route' is empty", file=file, remedy="name at least one terrain")
    return tuple(legs)


def _zones(raw: dict[str, Any], key: str, more: dict[str, Quantity], file: str) -> list[Any]:
    """Zones by time or by travel; with `more` quantities, tuples of the zone and their values."""
    zones: list[Any] = []
    for i, row in enumerate(_list(raw, key, file)):
        over: dict[str, Quantity] = _STRETCH if isinstance(row, Mapping) and "start_m" in row else _INTERVAL
        values = _row(row, f"{key}[{i}]", over | more, (*over, *more), file)
        kind = Stretch if over is _STRETCH else Interval
        zone = kind(**{name: values[name] for name in over})
        zones.append((zone, *(values[name] for name in more)) if more else zone)
    return zones


def _rows(
    raw: dict[str, Any], key: str, quantities: dict[str, Quantity], needed: tuple[str, ...], file: str
) -> list[dict[str, Any]]:
    rows = enumerate(_list(raw, key, file))
    return [_row(row, f"{key}[{i}]", quantities, needed, file) for i, row in rows]


def _row(
    row: Any, here: str, quantities: dict[str, Quantity], needed: tuple[str, ...], file: str
) -> dict[str, Any]:
    _known(row, tuple(quantities), file, here)
    for name in needed:
        if name not in row:
            raise ConfigError(f"'{here}.{name}' is missing", file=file, remedy="add it")
    return {n: checked_number(v, quantities[n], file=file, key=f"{here}.{n}") for n, v in row.items()}


def _section(
    raw: dict[str, Any], key: str, quantities: dict[str, Quantity], file: str, word: str | None = None
) -> dict[str, Any]:
    """A mapping of numbers, and of one `word` where given; every entry is needed."""
    words = () if word is None else (word,)
    section = raw[key]
    _known(section, (*words, *quantities), file, key)
    for name in (*words, *quantities):
        if name not in section:
            raise ConfigError(f"'{key}.{name}' is missing", file=file, remedy="add it")
    for name in words:
        if not isinstance(section[name], str):
            raise ConfigError(f"'{key}.{name}' is '{shown(section[name])}'", file=file, remedy="give a name")
    numbers = {n: checked_number(section[n], q, file=file, key=f"{key}.{n}") for n, q in quantities.items()}
    return numbers | {name: section[name] for name in words}


def _list(raw: dict[str, Any], key: str, file: str) -> list[Any]:
    value = raw.get(key, [])
    if not isinstance(value, list):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=file, remedy="give a list")
    return value


def _word(raw: dict[str, Any], key: str, allowed: tuple[str, ...], file: str) -> str:
    value = raw.get(key, allowed[0])
    if value not in allowed:
        raise ConfigError(
            f"'{key}' is '{shown(value)}'", file=file, remedy=f"give one of {', '.join(allowed)}"
        )
    return str(value)


def _text(raw: dict[str, Any], key: str, default: str, file: str) -> str:
    value = raw.get(key, default)
    if not isinstance(value, str):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=file, remedy="give a text")
    return value


def _known(row: Any, names: tuple[str, ...], file: str, here: str) -> None:
    if not isinstance(row, Mapping):
        raise ConfigError(
            f"'{here}' is '{shown(row)}'", file=file, remedy=f"give a mapping of {', '.join(names)}"
        )
    for name in row:
        if name not in names:
            key = f"{here}.{shown(name)}" if here else shown(name)
            raise ConfigError(f"unknown key '{key}'", file=file, remedy=f"known here: {', '.join(names)}")
