"""Reading a scenario file: strict keys and ranges; errors name the key, the value and what is allowed."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.config import OneOf, refuse, structure
from terrafusion.datasets.core.quantity import Quantity, Word
from terrafusion.twin.model.ground import SoilPatches, Variation
from terrafusion.twin.model.library import read_named
from terrafusion.twin.scenario.scenario import (
    MAX_SLOPE_DEG,
    PLACE,
    CanopyInterval,
    CanopyStretch,
    DriveSegment,
    Duration,
    Interval,
    RouteLeg,
    Scenario,
    Stretch,
)

_Degrees = Annotated[float, Quantity("deg", -360.0, 360.0)]
_LegLength = Annotated[float, Quantity("", 0.1, 1e6)]


@dataclass(frozen=True)
class LegFile:
    """A leg of `route`: its length in metres or seconds, as `route_over` has it; the last has none."""

    terrain: str
    length_m: _LegLength | None = None
    length_s: _LegLength | None = None
    moisture_percent: Annotated[float, Quantity("%", 0.0, 500.0)] | None = None


def _by_travel(raw: Any) -> bool:
    return isinstance(raw, dict) and "start_m" in raw


@dataclass(frozen=True)
class ScenarioFile:
    """Keys of a scenario file; what is not given has the default of `Scenario`."""

    name: str | None = None
    description: str = ""
    duration_s: Duration | None = None
    drive: tuple[DriveSegment, ...] = ()
    stops: tuple[Interval, ...] = ()
    waypoints: tuple[Annotated[tuple[float, ...], Quantity("m", -1e4, 1e4, size=2)], ...] = ()
    waypoint_speed_mps: Annotated[float, Quantity("m/s", 0.05, 20.0)] | None = None
    max_accel_mps2: Annotated[float, Quantity("m/s2", 0.01, 50.0)] | None = None
    route: tuple[LegFile, ...] | None = None
    route_over: Annotated[str, Word(("travel", "time"))] = "travel"
    transition: Annotated[float, Quantity("m or s", 0.01, 100.0)] | None = None
    variation: Variation | None = None
    patches: SoilPatches | None = None
    slope_deg: Annotated[float, Quantity("deg", 0.0, MAX_SLOPE_DEG)] | None = None
    cross_slope_deg: Annotated[float, Quantity("deg", -MAX_SLOPE_DEG, MAX_SLOPE_DEG)] | None = None
    aspect_deg: _Degrees | None = None
    heading_deg: _Degrees | None = None
    payload_kg: Annotated[float, Quantity("kg", 0.0, 5000.0)] | None = None
    payload_at_m: Annotated[tuple[float, ...], PLACE] | None = None
    gnss_fix: Annotated[str, Word(("best", "fixed", "float", "single"))] = "best"
    gnss_outages: tuple[Annotated[Interval | Stretch, OneOf(_by_travel, (Interval, Stretch))], ...] = ()
    canopy: tuple[
        Annotated[CanopyInterval | CanopyStretch, OneOf(_by_travel, (CanopyInterval, CanopyStretch))], ...
    ] = ()

    @property
    def leg_key(self) -> str:
        """Key of a leg's length."""
        return "length_m" if self.route_over == "travel" else "length_s"

    @property
    def total_s(self) -> float:
        """Duration of the drive; 0 where nothing says it."""
        return self.duration_s or sum(segment.duration_s for segment in self.drive)


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
    found = structure(ScenarioFile, raw, file=file)
    refuse(_problems(found), file)
    values = {"name": stem} | {key: getattr(found, key) for key in raw}
    values["duration_s"] = found.total_s
    values["gnss_fix"] = None if found.gnss_fix == "best" else Fix[found.gnss_fix.upper()]
    if found.route is not None:
        lengths = [*(getattr(leg, found.leg_key) for leg in found.route[:-1]), None]
        legs = zip(found.route, lengths, strict=True)
        values["route"] = tuple(RouteLeg(leg.terrain, length, leg.moisture_percent) for leg, length in legs)
    return Scenario(**values)


def _problems(found: ScenarioFile) -> Iterator[tuple[str, str]]:
    """What is wrong beyond single values, and the remedy."""
    if not found.drive and not found.waypoints:
        yield "the scenario drives nowhere", "add 'drive' segments or 'waypoints'"
    if found.drive and found.waypoints:
        yield "'drive' and 'waypoints' exclude each other", "keep one of them"
    if found.stops and not found.drive:
        yield "'stops' has no effect without 'drive'", "leave it out"
    if found.waypoint_speed_mps and not found.waypoints:
        yield "'waypoint_speed_mps' has no effect without 'waypoints'", "leave it out"
    if found.waypoints and found.duration_s is None:
        yield "'duration_s' is missing", "say how long the robot may take"
    yield from _leg_problems(found)
    zones = {"stops": found.stops, "gnss_outages": found.gnss_outages, "canopy": found.canopy}
    for key, many in zones.items() if found.total_s else ():
        for i, zone in enumerate(many):
            if isinstance(zone, Interval) and zone.start_s >= found.total_s:
                what = f"'{key}[{i}].start_s' is {zone.start_s:g}, after the drive's {found.total_s:g} s"
                yield what, "let it begin earlier, or leave it out"


def _leg_problems(found: ScenarioFile) -> Iterator[tuple[str, str]]:
    if found.route is not None and not found.route:
        yield "'route' is empty", "name at least one terrain"
    other = "length_s" if found.leg_key == "length_m" else "length_m"
    for i, leg in enumerate(found.route or ()):
        if getattr(leg, other) is not None:
            yield (
                f"unknown key 'route[{i}].{other}'",
                f"the route is over {found.route_over}: '{found.leg_key}'",
            )
        last = i == len(found.route or ()) - 1
        if not last and getattr(leg, found.leg_key) is None:
            yield f"'route[{i}].{found.leg_key}' is missing", "only the last leg has no length"
