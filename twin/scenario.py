"""Scenarios: what the robot is told to do, on which ground, and how its GNSS fares.

A scenario is a YAML file in `twin/params/scenarios` or the user's own, with
strict keys. Its numbers are choices, so they stand plain, unit in the key::

    description: two grounds
    duration_s: 60
    drive:
      - {duration_s: 5}
      - {duration_s: 55, v_mps: 1.0, yaw_rate_radps: 0.1}
    route:
      - {terrain: asphalt, length_m: 20}
      - {terrain: loose_sand}
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.config import Quantity, checked_number
from terrafusion.datasets.errors import ConfigError
from terrafusion.datasets.recording import Fix
from terrafusion.twin.ground import Patches, Variation
from terrafusion.twin.library import known_names, read_named

Array = NDArray[np.float64]

MAX_SLOPE_DEG = 25.0


@dataclass(frozen=True)
class DriveSegment:
    """Commanded twist over `duration_s`: v + v_amplitude sin(phase), likewise the yaw rate.

    The phase is zero at the segment's start and runs with `period_s`; with
    `end_period_s` the frequency rises (or falls) linearly to 1/end_period_s.
    """

    duration_s: float
    v_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    v_amplitude_mps: float = 0.0
    yaw_rate_amplitude_radps: float = 0.0
    period_s: float = 60.0
    end_period_s: float = 0.0

    def twist(self, t_s: Array) -> Array:
        """Twist (N, 2), m/s and rad/s, at times (N,) from the segment's start."""
        start = 1.0 / self.period_s
        sweep = (1.0 / self.end_period_s - start) / self.duration_s if self.end_period_s > 0 else 0.0
        wave = np.sin(2.0 * np.pi * (start * t_s + 0.5 * sweep * t_s**2))
        v = self.v_mps + self.v_amplitude_mps * wave
        return np.stack([v, self.yaw_rate_radps + self.yaw_rate_amplitude_radps * wave], axis=1)


@dataclass(frozen=True)
class RouteLeg:
    """Ground `terrain` for `length` metres (or seconds, see `Scenario.route_over`); the last has none."""

    terrain: str
    length: float | None = None


@dataclass(frozen=True)
class Interval:
    """From `start_s` for `duration_s` seconds."""

    start_s: float
    duration_s: float

    def covers(self, t_s: Array) -> NDArray[np.bool_]:
        """Which of the times lie inside."""
        return (t_s >= self.start_s) & (t_s < self.start_s + self.duration_s)


@dataclass(frozen=True)
class Scenario:
    """One drive.

    `route_over` is "travel" (legs in metres driven) or "time" (in seconds);
    grounds join smoothly over `transition` metres or seconds. `variation` and `patches`
    make the whole plane uneven, another way for each seed (see `ground`). With `waypoints`
    ((x, y) m in the plane from the start, x east on flat ground) the robot steers by
    its true pose at `waypoint_speed_mps` instead of following `drive`.
    `gnss_fix` is the receiver's fix class, None for its best.
    """

    name: str
    duration_s: float
    description: str = ""
    drive: tuple[DriveSegment, ...] = ()
    stops: tuple[Interval, ...] = ()
    waypoints: tuple[tuple[float, float], ...] = ()
    waypoint_speed_mps: float = 1.0
    max_accel_mps2: float = 1.5
    route: tuple[RouteLeg, ...] = (RouteLeg("asphalt"),)
    route_over: str = "travel"
    transition: float = 0.3
    variation: Variation | None = None
    patches: Patches | None = None
    slope_deg: float = 0.0
    aspect_deg: float = 0.0
    heading_deg: float = 0.0
    gnss_fix: Fix | None = None
    gnss_outages: tuple[Interval, ...] = ()

    def commanded(self, t_s: Array) -> Array:
        """Wanted twist (N, 2) at times (N,) from the start, m/s and rad/s, before any slew limit."""
        twist = np.zeros((len(t_s), 2))
        start = 0.0
        for segment in self.drive:
            inside = (t_s >= start) & (t_s < start + segment.duration_s)
            twist[inside] = segment.twist(t_s[inside] - start)
            start += segment.duration_s
        for stop in self.stops:
            twist[stop.covers(t_s)] = 0.0
        return twist

    def with_ground(self, terrain: str | None, slope_deg: float | None) -> Scenario:
        """The same drive on one terrain throughout and on another slope, where given.

        Raises:
            ConfigError: slope outside 0 to 25 deg.
        """
        changed = self
        if terrain is not None:
            changed = dataclasses.replace(changed, route=(RouteLeg(terrain),))
        if slope_deg is not None:
            if not 0.0 <= slope_deg <= MAX_SLOPE_DEG:
                raise ConfigError(
                    f"slope {slope_deg:g} deg is out of range", remedy=f"give 0 to {MAX_SLOPE_DEG:g} deg"
                )
            changed = dataclasses.replace(changed, slope_deg=slope_deg)
        return changed


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios that come with the library."""
    return known_names("scenarios")


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A scenario by its name in the library, or from a YAML file.

    Raises:
        ConfigError: unknown name (the known ones are listed), unknown key, or a value out of range.
    """
    raw, file = read_named("scenarios", name_or_path, kind="scenario")
    return _scenario(raw, file, Path(str(name_or_path)).stem)


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
    "aspect_deg": Quantity("deg", -360.0, 360.0),
    "heading_deg": Quantity("deg", -360.0, 360.0),
    "transition": Quantity("m or s", 0.01, 100.0),
}
_INTERVAL = {"start_s": _SECONDS, "duration_s": _DURATION}
_LENGTH = Quantity("m", 0.1, 1000.0)
_VARIATION = {"strength_sigma": Quantity("", 0.0, 1.0), "length_m": _LENGTH}
_PATCHES = {"share": Quantity("", 0.0, 1.0), "length_m": _LENGTH}


def _scenario(raw: dict[str, Any], file: str, stem: str) -> Scenario:
    lists = ("drive", "stops", "waypoints", "route", "gnss_outages")
    words = ("name", "description", "route_over", "gnss_fix")
    _known(raw, (*_NUMBERS, *lists, *words, "variation", "patches"), file, "")
    values: dict[str, Any] = {
        "name": str(raw.get("name", stem)),
        "description": str(raw.get("description", "")),
    }
    values |= {
        key: checked_number(raw[key], q, file=file, key=key) for key, q in _NUMBERS.items() if key in raw
    }
    values["drive"] = tuple(DriveSegment(**r) for r in _rows(raw, "drive", _DRIVE, ("duration_s",), file))
    for key in ("stops", "gnss_outages"):
        values[key] = tuple(Interval(**r) for r in _rows(raw, key, _INTERVAL, tuple(_INTERVAL), file))
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
        values["patches"] = Patches(**_section(raw, "patches", _PATCHES, file, "terrain"))
    if not values["drive"] and not points:
        raise ConfigError(
            "the scenario drives nowhere", file=file, remedy="add 'drive' segments or 'waypoints'"
        )
    if values["drive"] and points:
        raise ConfigError("'drive' and 'waypoints' exclude each other", file=file, remedy="keep one of them")
    if "duration_s" not in values:
        if points:
            raise ConfigError("'duration_s' is missing", file=file, remedy="say how long the robot may take")
        values["duration_s"] = sum(segment.duration_s for segment in values["drive"])
    return Scenario(**values)


def _route(raw: dict[str, Any], over: str, file: str) -> tuple[RouteLeg, ...]:
    key = "length_m" if over == "travel" else "length_s"
    legs = []
    rows = _list(raw, "route", file)
    for i, row in enumerate(rows):
        here = f"route[{i}]"
        _known(row, ("terrain", key), file, here)
        if not isinstance(row.get("terrain"), str):
            raise ConfigError(f"'{here}.terrain' is missing", file=file, remedy="name a terrain")
        length = None
        if i < len(rows) - 1:
            if key not in row:
                raise ConfigError(
                    f"'{here}.{key}' is missing", file=file, remedy="only the last leg has no length"
                )
            length = float(checked_number(row[key], Quantity("", 0.1, 1e6), file=file, key=f"{here}.{key}"))  # type: ignore[arg-type]
        legs.append(RouteLeg(row["terrain"], length))
    if not legs:
        raise ConfigError("'route' is empty", file=file, remedy="name at least one terrain")
    return tuple(legs)


def _rows(
    raw: dict[str, Any], key: str, quantities: dict[str, Quantity], needed: tuple[str, ...], file: str
) -> list[dict[str, Any]]:
    out = []
    for i, row in enumerate(_list(raw, key, file)):
        here = f"{key}[{i}]"
        _known(row, tuple(quantities), file, here)
        for name in needed:
            if name not in row:
                raise ConfigError(f"'{here}.{name}' is missing", file=file, remedy="add it")
        out.append(
            {n: checked_number(v, quantities[n], file=file, key=f"{here}.{n}") for n, v in row.items()}
        )
    return out


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
            raise ConfigError(f"'{key}.{name}' is '{section[name]}'", file=file, remedy="give a name")
    numbers = {n: checked_number(section[n], q, file=file, key=f"{key}.{n}") for n, q in quantities.items()}
    return numbers | {name: section[name] for name in words}


def _list(raw: dict[str, Any], key: str, file: str) -> list[Any]:
    value = raw.get(key, [])
    if not isinstance(value, list):
        raise ConfigError(f"'{key}' is '{value}'", file=file, remedy="give a list")
    return value


def _word(raw: dict[str, Any], key: str, allowed: tuple[str, ...], file: str) -> str:
    value = raw.get(key, allowed[0])
    if value not in allowed:
        raise ConfigError(f"'{key}' is '{value}'", file=file, remedy=f"give one of {', '.join(allowed)}")
    return str(value)


def _known(row: Any, names: tuple[str, ...], file: str, here: str) -> None:
    if not isinstance(row, Mapping):
        raise ConfigError(f"'{here}' is '{row}'", file=file, remedy=f"give a mapping of {', '.join(names)}")
    for name in row:
        if name not in names:
            key = f"{here}.{name}" if here else str(name)
            raise ConfigError(f"unknown key '{key}'", file=file, remedy=f"known here: {', '.join(names)}")
