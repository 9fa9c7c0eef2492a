"""A sweep from its strict YAML file.

::

    scenario: straight
    vehicle: elevate
    axes:
      terrain: [loose_sand]
      friction: {from: 0.1, to: 1.0, count: 10}
      slope_deg: [0, 5, 10]
    random: 1000
    sensors: false
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np

from terrafusion.datasets.core.config import refuse, structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Parsed, Quantity, RejectedError, Switch, Whole, shown
from terrafusion.twin.model.library import read_named
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import MAX_SLOPE_DEG, Scenario
from terrafusion.twin.sweep.plan import AXES, Axis, Sweep, top_speed_mps

MAX_LEVELS = 10_000
_COUNT = Whole("", 2, MAX_LEVELS)
_SEED = Whole("", 0, 2**31 - 1)


@dataclass(frozen=True)
class Span:
    """`{from, to, count}` of an axis; without a count, what a random sweep draws from."""

    low: float
    high: float
    count: int | None


@dataclass(frozen=True)
class Levels(Parsed):
    """Annotation of an axis: a list of numbers, each once, or a span."""

    quantity: Quantity

    def parse(self, raw: Any) -> tuple[float, ...] | Span:
        if isinstance(raw, dict):
            return self._span(raw)
        if not isinstance(raw, list) or not 0 < len(raw) <= MAX_LEVELS:
            remedy = f"give a list of 1 to {MAX_LEVELS} values, or {{from, to, count}}"
            raise RejectedError(f"'{{key}}' is '{shown(raw)}'", remedy)
        levels = tuple(self.quantity.parse_part(value, f"[{i}]") for i, value in enumerate(raw))
        if len(set(levels)) < len(levels):
            twice = next(x for x in levels if levels.count(x) > 1)
            raise RejectedError(f"'{{key}}' has {shown(twice)} twice", "name each level once")
        return levels

    def _span(self, raw: dict[Any, Any]) -> Span:
        ends = {"from": self.quantity, "to": self.quantity, "count": _COUNT}
        for name in raw:
            if name not in ends:
                raise RejectedError(f"unknown key '{{key}}.{shown(name)}'", "known here: from, to, count")
        for name in ("from", "to"):
            if name not in raw:
                raise RejectedError(f"'{{key}}.{name}' is missing", "add it")
        given = {name: ends[name].parse_part(value, f".{name}") for name, value in raw.items()}
        low, high, count = given["from"], given["to"], given.get("count")
        if low >= high:
            raise RejectedError(
                f"'{{key}}.from' is {low:g}, not below 'to' {high:g}", "swap them or give a list"
            )
        return Span(float(low), float(high), count)

    def spread(self, span: Span) -> tuple[float, ...]:
        """The levels of a span with a count; a RejectedError where one between the ends is not allowed."""
        # Twelve digits: 0.15, not 0.15000000000000002.
        numbers = [round(x, 12) for x in np.linspace(span.low, span.high, span.count or 0).tolist()]
        return tuple(self.quantity.parse(x) for x in numbers)  # type: ignore[misc]

    def schema(self) -> dict[str, Any]:
        number = self.quantity.schema()
        ends = {"from": number, "to": number, "count": _COUNT.schema()}
        span = {
            "type": "object",
            "properties": ends,
            "required": ["from", "to"],
            "additionalProperties": False,
        }
        listed = {
            "type": "array",
            "items": number,
            "minItems": 1,
            "maxItems": MAX_LEVELS,
            "uniqueItems": True,
        }
        return {"anyOf": [listed, span]}


@dataclass(frozen=True)
class AxesFile:
    """Axes of a sweep; the vehicle limits payload and speed further."""

    terrain: tuple[str, ...] | None = None
    friction: Annotated[Any, Levels(Quantity("", 0.01, 2.0))] = None
    slope_deg: Annotated[Any, Levels(Quantity("deg", 0.0, MAX_SLOPE_DEG))] = None
    payload_kg: Annotated[Any, Levels(Quantity("kg", 0.0, 5000.0))] = None
    speed_scale: Annotated[Any, Levels(Quantity("", 0.01, 10.0))] = None
    speed_mps: Annotated[Any, Levels(Quantity("m/s", 0.01, 50.0))] = None
    seed: Annotated[Any, Levels(_SEED)] = None


@dataclass(frozen=True)
class SweepFile:
    """Keys of a sweep file."""

    scenario: str
    axes: AxesFile
    vehicle: str = "elevate"
    description: str = ""
    random: Annotated[int, Whole("", 1, 10**7)] | None = None
    random_seed: Annotated[int, _SEED] = 0
    sensors: Switch = False


def load_sweep(name_or_path: str | Path) -> Sweep:
    """A sweep by its name in the library, or from a YAML file.

    Paths of a scenario, a vehicle or a terrain in the file are relative to it.

    Raises:
        ConfigError: unknown name or key, a wrong type, or a number out of range.
    """
    raw, file = read_named("sweeps", name_or_path, kind="sweep")
    found = structure(SweepFile, raw, file=file)
    folder = Path(file).parent
    scenario = load_scenario(_near(found.scenario, folder))
    vehicle = load_vehicle(_near(found.vehicle, folder))
    refuse(_problems(found, scenario), file)
    axes = _axes(raw["axes"], vehicle, file)
    return Sweep(
        name=Path(file).stem,
        description=found.description,
        scenario=scenario,
        vehicle=vehicle,
        axes=axes,
        random=found.random,
        random_seed=found.random_seed,
        sensors=found.sensors,
        soils=_soils(scenario, axes, folder),
    )


def _problems(found: SweepFile, scenario: Scenario) -> Iterator[tuple[str, str]]:
    """What is wrong beyond single values, and the remedy."""
    axes = found.axes
    if axes == AxesFile():
        yield "'axes' is empty", f"give axes from {', '.join(AXES)}"
    terrain = axes.terrain or ()
    if axes.terrain == ():
        yield "'axes.terrain' is '[]'", "give a list of terrains"
    if len(set(terrain)) < len(terrain):
        twice = next(name for name in terrain if terrain.count(name) > 1)
        yield f"'axes.terrain' has {shown(twice)} twice", "name each level once"
    if axes.speed_scale and axes.speed_mps:
        yield "'axes.speed_scale' and 'axes.speed_mps' exclude each other", "keep one of them"
    if axes.speed_mps and top_speed_mps(scenario) <= 0.0:
        yield f"'axes.speed_mps' needs a forward speed, and '{scenario.name}' has none", "use 'speed_scale'"
    for name in AXES:
        span = getattr(axes, name)
        if isinstance(span, Span) and span.count is None and found.random is None:
            yield f"'axes.{name}.count' is missing", "add it, or make the sweep 'random'"


def _axes(raw: dict[str, Any], vehicle: VehicleParams, file: str) -> tuple[Axis, ...]:
    """The axes in the order of `AXES`, within the limits of the vehicle."""
    kinds = {name: get_args(hint)[1] for name, hint in get_type_hints(AxesFile, include_extras=True).items()}
    kinds["payload_kg"] = Levels(Quantity("kg", 0.0, vehicle.body.payload_max_kg))
    kinds["speed_mps"] = Levels(Quantity("m/s", 0.01, vehicle.drive.max_speed_mps))
    axes, errors = [], []
    for name in (n for n in AXES if n in raw):
        try:
            value = tuple(raw[name]) if name == "terrain" else kinds[name].parse(raw[name])
            if isinstance(value, Span) and value.count is not None:
                value = kinds[name].spread(value)
            ends = (value.low, value.high) if isinstance(value, Span) else None
            axes.append(Axis(name, () if ends else value, ends))
        except RejectedError as error:
            errors.append(error.at(f"axes.{name}", file))
    if errors:
        raise ConfigError.joined(errors)
    return tuple(axes)


def _near(name: str, folder: Path) -> str:
    """A path as it stands from the sweep's own folder; a name as it is."""
    path = folder / name
    return str(path) if path.suffix in (".yaml", ".yml") and path.is_file() else name


def _soils(scenario: Scenario, axes: tuple[Axis, ...], folder: Path) -> tuple[tuple[str, SoilParams], ...]:
    terrains = next((axis.levels for axis in axes if axis.name == "terrain"), None)
    names = list(terrains if terrains is not None else [leg.terrain for leg in scenario.route])
    names += [scenario.patches.terrain] if scenario.patches else []
    return tuple((str(name), load_soil(_near(str(name), folder))) for name in dict.fromkeys(names))
