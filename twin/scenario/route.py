"""The ground of a run: soil parameters for the integrator, labels and shares for the sensors."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.model.ground import SoilPatches, Variation, soil_field
from terrafusion.twin.model.plant import RouteTable, smoothstep
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vectors import soil_vector
from terrafusion.twin.scenario.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Route:
    """Soils of the legs and the borders (L - 1,) between them, in metres driven or seconds.

    `variation` and `patches` hold for the whole plane; `patch_soil` is the soil of the patches.
    """

    soils: tuple[SoilParams, ...]
    borders: Array
    coordinate: str
    transition: float
    variation: Variation | None = None
    patches: SoilPatches | None = None
    patch_soil: SoilParams | None = None

    @classmethod
    def of(cls, scenario: Scenario, soils: Mapping[str, SoilParams] | None = None) -> Self:
        """The scenario's route with its soils: those given by name, the others loaded.

        Raises:
            ConfigError: unknown terrain, or a leg shorter than the transition between two grounds.
        """
        known = soils or {}
        names = [leg.terrain for leg in scenario.route]

        def soil(name: str) -> SoilParams:
            return known[name] if name in known else load_soil(name)

        lengths = np.array([leg.length for leg in scenario.route[:-1]], dtype=float)
        if (lengths < scenario.transition).any():
            raise ConfigError(
                f"a leg of the route is shorter than the transition of {scenario.transition:g}",
                file=scenario.name,
                remedy="lengthen the leg or lower 'transition'",
            )
        patches = scenario.patches
        return cls(
            tuple(soil(name) for name in names), np.cumsum(lengths), scenario.route_over,
            scenario.transition, scenario.variation, patches, soil(patches.terrain) if patches else None,
        )  # fmt: skip

    def table(self, seed: int = 0) -> RouteTable:
        """Knots of the soil parameters, each border crossed within `transition`, and the field of the seed.

        Raises:
            ConfigError: the lengths of `variation` and `patches` are too far apart.
        """
        vectors = np.array([soil_vector(soil) for soil in self.soils])
        patch = None if self.patch_soil is None else soil_vector(self.patch_soil)
        field = soil_field(self.variation, self.patches, patch, seed)
        return RouteTable.joined(self.coordinate, vectors, self.borders, self.transition, field)

    def along(self, t_s: Array, travel_m: Array) -> Array:
        """The route's coordinate (N,) at times and distances driven (N,)."""
        return t_s if self.coordinate == "time" else travel_m

    def labels(self, coordinate: Array, patch_share: Array | None = None) -> NDArray[np.object_]:
        """Terrain name (N,) under the robot; that of the patches where their share (N,) is above one half."""
        names = np.array([soil.name for soil in self.soils], dtype=object)
        own = np.asarray(names[np.searchsorted(self.borders, coordinate, side="right")])
        if self.patch_soil is None or patch_share is None:
            return own
        return np.where(patch_share > 0.5, self.patch_soil.name, own)

    def shares(
        self, coordinate: Array, patch_share: Array | None = None
    ) -> dict[str, tuple[SoilParams, Array]]:
        """Share (N,) from 0 to 1 of each soil, by name; they sum to one and join as the parameters do."""
        ramps = []
        for border in self.borders:
            w = np.clip((coordinate - border) / self.transition + 0.5, 0.0, 1.0)
            ramps.append(smoothstep(w))
        edges = [np.ones_like(coordinate), *ramps, np.zeros_like(coordinate)]
        parts = [(s, a - b) for s, a, b in zip(self.soils, edges[:-1], edges[1:], strict=True)]
        if self.patch_soil is not None and patch_share is not None:
            parts = [(soil, share * (1.0 - patch_share)) for soil, share in parts]
            parts.append((self.patch_soil, patch_share))
        out: dict[str, tuple[SoilParams, Array]] = {}
        for soil, share in parts:
            known = out.get(soil.name)
            out[soil.name] = (soil, share if known is None else known[1] + share)
        return out
