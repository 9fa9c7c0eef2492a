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

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.config import Quantity, checked_number, shown
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.model.library import known_names, read_named
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import MAX_SLOPE_DEG, Scenario
from terrafusion.twin.sweep.plan import AXES, Axis, Sweep, top_speed_mps

MAX_LEVELS = 10_000
_MAX_SEED = 2**31 - 1
_KEYS = ("description", "scenario", "vehicle", "axes", "random", "random_seed", "sensors")
_SPAN = ("from", "to", "count")


def sweep_names() -> tuple[str, ...]:
    """Names of the sweeps that come with the library."""
    return known_names("sweeps")


def load_sweep(name_or_path: str | Path) -> Sweep:
    """A sweep by its name in the library, or from a YAML file.

    Paths of a scenario, a vehicle or a terrain in the file are relative to it.

    Raises:
        ConfigError: unknown name or key, a wrong type, or a number out of range.
    """
    raw, file = read_named("sweeps", name_or_path, kind="sweep")
    for name in raw:
        if name not in _KEYS:
            raise ConfigError(
                f"unknown key '{shown(name)}'", file=file, remedy=f"known here: {', '.join(_KEYS)}"
            )
    folder = Path(file).parent
    scenario = load_scenario(_near(_text(raw, "scenario", file), folder))
    vehicle = load_vehicle(_near(_text(raw, "vehicle", file, "elevate"), folder))
    random = _whole(raw, "random", 1, 10**7, file)
    axes = _axes(raw, file, vehicle, random is not None)
    if any(axis.name == "speed_mps" for axis in axes) and top_speed_mps(scenario) <= 0.0:
        raise ConfigError(
            f"'axes.speed_mps' needs a forward speed, and '{scenario.name}' has none",
            file=file,
            remedy="use 'speed_scale'",
        )
    return Sweep(
        name=Path(file).stem,
        description=_text(raw, "description", file, ""),
        scenario=scenario,
        vehicle=vehicle,
        axes=axes,
        random=random,
        random_seed=_whole(raw, "random_seed", 0, _MAX_SEED, file) or 0,
        sensors=_flag(raw, "sensors", file),
        soils=_soils(scenario, axes, folder),
    )


def _axes(raw: dict[str, Any], file: str, vehicle: VehicleParams, random: bool) -> tuple[Axis, ...]:
    section = raw.get("axes")
    if not isinstance(section, dict) or not section:
        raise ConfigError(
            f"'axes' is '{shown(section)}'", file=file, remedy=f"give axes from {', '.join(AXES)}"
        )
    for name in section:
        if name not in AXES:
            raise ConfigError(
                f"unknown key 'axes.{shown(name)}'", file=file, remedy=f"known here: {', '.join(AXES)}"
            )
    if "speed_scale" in section and "speed_mps" in section:
        raise ConfigError(
            "'axes.speed_scale' and 'axes.speed_mps' exclude each other", file=file, remedy="keep one of them"
        )
    ranges = {
        "friction": Quantity("", 0.01, 2.0),
        "slope_deg": Quantity("deg", 0.0, MAX_SLOPE_DEG),
        "payload_kg": Quantity("kg", 0.0, vehicle.body.payload_max_kg),
        "speed_scale": Quantity("", 0.01, 10.0),
        "speed_mps": Quantity("m/s", 0.01, vehicle.drive.max_speed_mps),
        "seed": Quantity("", 0, _MAX_SEED),
    }
    axes = []
    for name in (n for n in AXES if n in section):
        if name == "terrain":
            axes.append(Axis(name, _terrains(section[name], file)))
        else:
            axes.append(_axis(name, section[name], ranges[name], file, random))
    return tuple(axes)


def _terrains(raw: Any, file: str) -> tuple[str, ...]:
    if not isinstance(raw, list) or not raw or not all(isinstance(word, str) for word in raw):
        raise ConfigError(f"'axes.terrain' is '{shown(raw)}'", file=file, remedy="give a list of terrains")
    return _distinct("axes.terrain", tuple(raw), file)


def _axis(name: str, raw: Any, allowed: Quantity, file: str, random: bool) -> Axis:
    key = f"axes.{name}"
    if isinstance(raw, dict):
        return _span(name, raw, allowed, file, random)
    if not isinstance(raw, list) or not 0 < len(raw) <= MAX_LEVELS:
        raise ConfigError(
            f"'{key}' is '{shown(raw)}'",
            file=file,
            remedy=f"give a list of 1 to {MAX_LEVELS} values, or {{from, to, count}}",
        )
    numbers = [_level(name, value, allowed, file, f"{key}[{i}]") for i, value in enumerate(raw)]
    return Axis(name, _distinct(key, tuple(numbers), file))


def _span(name: str, raw: dict[str, Any], allowed: Quantity, file: str, random: bool) -> Axis:
    key = f"axes.{name}"
    needed = ("from", "to") if random else _SPAN
    for entry in raw:
        if entry not in _SPAN:
            raise ConfigError(
                f"unknown key '{key}.{shown(entry)}'", file=file, remedy=f"known here: {', '.join(_SPAN)}"
            )
    for entry in needed:
        if entry not in raw:
            raise ConfigError(f"'{key}.{entry}' is missing", file=file, remedy="add it")
    low, high = (_level(name, raw[end], allowed, file, f"{key}.{end}") for end in ("from", "to"))
    if low >= high:
        raise ConfigError(
            f"'{key}.from' is {low:g}, not below 'to' {high:g}", file=file, remedy="swap them or give a list"
        )
    count = _whole(raw, "count", 2, MAX_LEVELS, file, f"{key}.")
    if count is None:
        return Axis(name, span=(float(low), float(high)))
    # Twelve digits: 0.15, not 0.15000000000000002.
    numbers = [round(x, 12) for x in np.linspace(low, high, count).tolist()]
    return Axis(name, tuple(_level(name, x, allowed, file, key) for x in numbers))


def _level(name: str, value: Any, allowed: Quantity, file: str, key: str) -> float | int:
    number = checked_number(value, allowed, file=file, key=key)
    assert isinstance(number, float)
    if name != "seed":
        return number
    if not number.is_integer():
        raise ConfigError(f"'{key}' is {number:g}", file=file, remedy="give whole numbers")
    return int(number)


def _distinct(key: str, levels: tuple[Any, ...], file: str) -> tuple[Any, ...]:
    if len(set(levels)) < len(levels):
        twice = next(x for x in levels if levels.count(x) > 1)
        raise ConfigError(f"'{key}' has {shown(twice)} twice", file=file, remedy="name each level once")
    return levels


def _whole(raw: dict[str, Any], key: str, low: int, high: int, file: str, prefix: str = "") -> int | None:
    if key not in raw:
        return None
    number = checked_number(raw[key], Quantity("", low, high), file=file, key=prefix + key)
    if int(number) != number:  # type: ignore[arg-type]
        raise ConfigError(f"'{prefix}{key}' is {number:g}", file=file, remedy="give a whole number")
    return int(number)


def _flag(raw: dict[str, Any], key: str, file: str) -> bool:
    value = raw.get(key, False)
    if not isinstance(value, bool):
        raise ConfigError(f"'{key}' is '{shown(value)}'", file=file, remedy="give true or false")
    return value


def _text(raw: dict[str, Any], key: str, file: str, default: str | None = None) -> str:
    value = raw.get(key, default)
    if not isinstance(value, str):
        what = f"'{key}' is '{shown(value)}'" if key in raw else f"'{key}' is missing"
        raise ConfigError(what, file=file, remedy="give a text")
    return value


def _near(name: str, folder: Path) -> str:
    """A path as it stands from the sweep's own folder; a name as it is."""
    path = folder / name
    return str(path) if path.suffix in (".yaml", ".yml") and path.is_file() else name


def _soils(scenario: Scenario, axes: tuple[Axis, ...], folder: Path) -> tuple[tuple[str, SoilParams], ...]:
    terrains = next((axis.levels for axis in axes if axis.name == "terrain"), None)
    names = list(terrains if terrains is not None else [leg.terrain for leg in scenario.route])
    names += [scenario.patches.terrain] if scenario.patches else []
    return tuple((str(name), load_soil(_near(str(name), folder))) for name in dict.fromkeys(names))
