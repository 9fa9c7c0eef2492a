"""What is calibrated: a vehicle, its grounds and optional effects, and their parameters by dotted name.

`vehicle.body.mass_kg` and `soil.shear.friction_cap` are the names of the dataclasses in
`model.vehicle` and `model.soil`; `loose_sand.shear.friction_cap` is that of one ground of several;
`effects.NAME` is an optional effect. A name carries its unit, its range comes with its field.
"""

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.config import quantities
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity
from terrafusion.twin.effects.catalogue import lookup, parameters
from terrafusion.twin.effects.form import Parameter
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import SOIL_PARAMETERS, VEHICLE_PARAMETERS

STEP = 1e-6
"""Relative step of the central differences from a named number to parameters of the graph: these maps (a
tangent, a few products) are almost linear, so that the difference is right to about 1e-10."""


@dataclass(frozen=True, eq=False)
class Model:
    """A vehicle on its grounds, and the plane they lie in.

    Attributes:
        soils: grounds by name.
        effects: values of optional effects by name.
        slope_rad, aspect_rad, payload_kg: as for `vectors.vehicle_vector`.
    """

    vehicle: VehicleParams
    soils: Mapping[str, SoilParams]
    effects: Mapping[str, float] = field(default_factory=dict)
    slope_rad: float = 0.0
    aspect_rad: float = 0.0
    payload_kg: float = 0.0

    def vehicle_vector(self) -> Array:
        """(V,) `VEHICLE_PARAMETERS`."""
        return vehicle_vector(
            self.vehicle, slope_rad=self.slope_rad, aspect_rad=self.aspect_rad, payload_kg=self.payload_kg
        )

    def value(self, name: str) -> float:
        """The number a dotted name stands for."""
        group, _, path = name.partition(".")
        if group == "effects":
            return float(self.effects.get(path, 0.0))
        found: Any = self.vehicle if group == "vehicle" else self.soils[group]
        for part in path.split("."):
            found = getattr(found, part)
        return float(found)

    def parameter(self, key: str) -> Parameter:
        """An effect's parameter by its key, with size and range of this robot."""
        return lookup(key)[1].sized(self.vehicle.body.mass_kg, self.vehicle.wheel.radius_m)

    def full_names(self, name: str) -> list[str]:
        """The dotted names that a name stands for: `soil.` is every ground."""
        path = name.removeprefix("soil.")
        return [f"{soil}.{path}" for soil in self.soils] if name.startswith("soil.") else [name]

    def replaced(self, values: Mapping[str, float]) -> Self:
        """The model with other numbers, by dotted name."""
        vehicle, soils, effects = self.vehicle, dict(self.soils), dict(self.effects)
        for name, value in values.items():
            group, _, path = name.partition(".")
            if group == "effects":
                effects[path] = value
            elif group == "vehicle":
                vehicle = _replaced(vehicle, path.split("."), value)
            else:
                soils[group] = _replaced(soils[group], path.split("."), value)
        return dataclasses.replace(self, vehicle=vehicle, soils=soils, effects=effects)

    def vehicle_change(self, name: str) -> Array:
        """(V,) derivative of `vehicle_vector` by the named number.

        The dead time enters by its own entry only: it is applied to the inputs (`commands.delayed_inputs`).
        """
        if not name.startswith("vehicle."):
            return np.zeros(len(VEHICLE_PARAMETERS))
        change = self._central(name, lambda model: model.vehicle_vector())
        change[VEHICLE_PARAMETERS.index("dead_time_applied_s")] = 0.0
        return change

    def soil_change(self, name: str, soil: str) -> Array:
        """(S,) derivative of the parameters of the ground `soil` by the named number."""
        if name.partition(".")[0] != soil:
            return np.zeros(len(SOIL_PARAMETERS))
        return self._central(name, lambda model: soil_vector(model.soils[soil]))

    def _central(self, name: str, vector: Any) -> Array:
        value = self.value(name)
        step = STEP * (abs(value) or 1.0)
        ends = [vector(self.replaced({name: value + sign * step})) for sign in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))


def _replaced(parent: Any, path: list[str], value: float) -> Any:
    if len(path) > 1:
        value = _replaced(getattr(parent, path[0]), path[1:], value)
    return dataclasses.replace(parent, **{path[0]: value})


def resolve(names: tuple[str, ...], model: Model) -> dict[str, Quantity]:
    """The numbers that the names stand for (see `Model.full_names`), in the order given.

    Raises:
        ConfigError: a name that is unknown, given twice, or that no motion of the twin depends on.
    """
    vehicle = {f"vehicle.{k}": q for k, q in quantities(VehicleParams).items()}
    soil = quantities(SoilParams)
    known = vehicle | {f"{s}.{k}": q for s in model.soils for k, q in soil.items()}
    sized = {key: model.parameter(key) for key in parameters()}
    known |= {f"effects.{key}": Quantity(p.unit, p.low, p.high) for key, p in sized.items()}
    found: dict[str, Quantity] = {}
    for name in names:
        for one in model.full_names(name):
            if one not in known:
                options = [*vehicle, *(f"soil.{k}" for k in soil), *(k for k in known if k not in vehicle)]
                raise _unknown(name, options)
            if one in found:
                raise ConfigError(f"parameter '{one}' is given twice", remedy="give it once")
            if not _moves(one, model):
                raise ConfigError(
                    f"parameter '{one}' does not enter the twin's motion, so that no log can identify it",
                    remedy="leave it out",
                )
            found[one] = known[one]
    if not found:
        raise ConfigError("no parameter was named", remedy="name one, such as soil.shear.friction_cap")
    return found


def _moves(name: str, model: Model) -> bool:
    if name.startswith("effects."):
        return True
    soil = name.partition(".")[0]
    change = model.vehicle_change(name) if soil == "vehicle" else model.soil_change(name, soil)
    return bool(change.any())


def _unknown(name: str, known: list[str]) -> ConfigError:
    last = name.rpartition(".")[2]
    same = [k for k in known if k.rpartition(".")[2].startswith(last)]
    close = same[:3] or difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    remedy = (
        f"did you mean {' or '.join(close)}?" if close else "see docs/how-to/calibration.md for the names"
    )
    return ConfigError(f"unknown parameter '{name}'", remedy=remedy)
