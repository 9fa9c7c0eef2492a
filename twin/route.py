"""The ground along a route: soil parameters for the integrator, labels and shares for the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import ConfigError
from terrafusion.twin.engine.plant import RouteTable
from terrafusion.twin.layout import soil_vector
from terrafusion.twin.scenario import Scenario
from terrafusion.twin.soil import SoilParams, load_soil

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Route:
    """Soils of the legs and the borders (L - 1,) between them, in metres driven or seconds."""

    soils: tuple[SoilParams, ...]
    borders: Array
    coordinate: str
    transition: float

    @classmethod
    def of(cls, scenario: Scenario, soils: Mapping[str, SoilParams] | None = None) -> Route:
        """The scenario's route with its soils: those given by name, the others loaded.

        Raises:
            ConfigError: unknown terrain, or a leg shorter than the transition between two grounds.
        """
        known = soils or {}
        names = [leg.terrain for leg in scenario.route]
        grounds = tuple(known[name] if name in known else load_soil(name) for name in names)
        lengths = np.array([leg.length for leg in scenario.route[:-1]], dtype=float)
        if (lengths < scenario.transition).any():
            raise ConfigError(
                f"a leg of the route is shorter than the transition of {scenario.transition:g}",
                file=scenario.name,
                remedy="lengthen the leg or lower 'transition'",
            )
        return cls(grounds, np.cumsum(lengths), scenario.route_over, scenario.transition)

    def table(self) -> RouteTable:
        """Knots of the soil parameters: each border is crossed within `transition`."""
        vectors = np.array([soil_vector(soil) for soil in self.soils])
        if len(self.soils) == 1:
            return RouteTable(self.coordinate, np.zeros(1), vectors)
        half = 0.5 * self.transition
        at = np.repeat(self.borders, 2) + np.tile([-half, half], len(self.borders))
        return RouteTable(self.coordinate, at, np.repeat(vectors, 2, axis=0)[1:-1])

    def along(self, t_s: Array, travel_m: Array) -> Array:
        """The route's coordinate (N,) at times and distances driven (N,)."""
        return t_s if self.coordinate == "time" else travel_m

    def labels(self, coordinate: Array) -> NDArray[np.object_]:
        """Terrain name (N,) under the robot."""
        names = np.array([soil.name for soil in self.soils], dtype=object)
        return np.asarray(names[np.searchsorted(self.borders, coordinate, side="right")])

    def shares(self, coordinate: Array) -> dict[str, tuple[SoilParams, Array]]:
        """Share (N,) from 0 to 1 of each soil, by name; they sum to one and join as the parameters do."""
        ramps = []
        for border in self.borders:
            w = np.clip((coordinate - border) / self.transition + 0.5, 0.0, 1.0)
            ramps.append(w * w * (3.0 - 2.0 * w))
        edges = [np.ones_like(coordinate), *ramps, np.zeros_like(coordinate)]
        out: dict[str, tuple[SoilParams, Array]] = {}
        for soil, before, after in zip(self.soils, edges[:-1], edges[1:], strict=True):
            share = before - after
            known = out.get(soil.name)
            out[soil.name] = (soil, share if known is None else known[1] + share)
        return out
