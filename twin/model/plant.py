"""What is integrated: vehicle parameters, the ground under the wheels, the optional effects."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from terrafusion.datasets.core.arrays import Array


@dataclass(frozen=True, eq=False)
class SoilField:
    """Ground that varies over the plane, on a grid that repeats in both directions.

    Between grid points the field is bilinear; a wheel meets the value under its
    hub at the start of an integration step.

    Attributes:
        cell_m: spacing of the grid.
        log_gain: (H, W) logarithm of the soil's local strength over its mean, rows along y, columns along x.
        response: (S,) how each of `SOIL_PARAMETERS` follows: value exp(response log_gain).
        patch_share: (H, W) from 0 to 1, share of the other ground `patch_soil`.
        patch_soil: (S,) `SOIL_PARAMETERS` of the patches.
    """

    cell_m: float
    log_gain: Array
    response: Array
    patch_share: Array
    patch_soil: Array


@dataclass(frozen=True, eq=False)
class RouteTable:
    """Soil parameters along the route.

    Attributes:
        coordinate: "travel" (metres driven forward; an axle ahead of the body origin meets it earlier) or
            "time" (seconds).
        at: (K,) increasing knots of the coordinate.
        soil: (K, S) `SOIL_PARAMETERS` at the knots, joined smoothly between them.
        field: how the ground varies about these numbers, None where it does not.
    """

    coordinate: str
    at: Array
    soil: Array
    field: SoilField | None = None

    @classmethod
    def joined(
        cls, coordinate: str, soils: Array, borders: Array, transition: float, field: SoilField | None = None
    ) -> Self:
        """Soils (K, S) with borders (K - 1,) between them, each crossed within `transition`."""
        if len(soils) == 1:
            return cls(coordinate, np.zeros(1), soils, field)
        at = np.repeat(borders, 2) + np.tile([-0.5 * transition, 0.5 * transition], len(borders))
        return cls(coordinate, at, np.repeat(soils, 2, axis=0)[1:-1], field)

    def along(self, table: Array, coordinate: Array) -> Array:
        """Rows of a table (K, ...) of the knots at coordinates (N,), joined as the engine joins them."""
        out = np.repeat(table[:1], len(coordinate), axis=0)
        for k in range(len(self.at) - 1):
            s = np.clip((coordinate - self.at[k]) / (self.at[k + 1] - self.at[k]), 0.0, 1.0)
            share = smoothstep(s).reshape(-1, *(1,) * (table.ndim - 1))
            out += share * (table[k + 1] - table[k])
        return out

    def weights(self) -> tuple[float, float]:
        """Factors of time and travel that make the coordinate."""
        return (1.0, 0.0) if self.coordinate == "time" else (0.0, 1.0)

    def is_fixed(self) -> bool:
        """Whether every wheel stays on the same ground throughout."""
        return len(self.at) == 1 and self.field is None


@dataclass(frozen=True, eq=False)
class Plant:
    """Everything that holds for a whole run.

    Attributes:
        vehicle: (V,) `VEHICLE_PARAMETERS`.
        route: ground along the path.
        effects: values of the optional parameters; one that is not named is absent.
    """

    vehicle: Array
    route: RouteTable
    effects: Mapping[str, float] = field(default_factory=dict)

    def effect_names(self, also: Iterable[str] = ()) -> tuple[str, ...]:
        """Names of the optional parameters that are not zero, and `also`, sorted: they choose the graph."""
        return tuple(sorted({*also, *(name for name, value in self.effects.items() if value != 0.0)}))

    def effect_values(self, also: Iterable[str] = ()) -> Array:
        """Values (E,) in the order of `effect_names(also)`."""
        return np.array([self.effects.get(name, 0.0) for name in self.effect_names(also)], dtype=float)


def smoothstep(share: Any) -> Any:
    """3 s^2 - 2 s^3 of a share from 0 to 1 (expressions, numbers or arrays): how two grounds join."""
    return share * share * (3.0 - 2.0 * share)
