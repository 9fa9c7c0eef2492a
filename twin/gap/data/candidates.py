"""Candidate effects of a diagnosis: their functional forms, parameters and ranges.

An effect is one hypothesis and its forms are alternatives within it. A column is one parameter, measured in
its typical size (`scale` of the catalogue), so that all columns are comparable.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.effects.catalogue import catalogue, forms_of, lookup, moves, parameters
from terrafusion.twin.effects.form import Form
from terrafusion.twin.model.vehicle import VehicleParams

SOIL_STRENGTH = "soil_strength"
"""The effect that is a known parameter of the soil, not missing physics: verdict `parameters`."""
RANGE_SHARE = 0.98  # share of its range within which a parameter is sought
SMALLEST = 0.1  # least size that is sought, in typical ones


@dataclass(frozen=True)
class Hypothesis:
    """One functional form of one effect and the indices of its columns."""

    effect: str
    form: str
    columns: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Candidates:
    """All candidate effects.

    Attributes:
        keys: parameter keys of the catalogue, one a column but for the last ones, of composite forms.
        scale, low, high: typical size and range of each, in its unit.
        units: of each.
        hypotheses: the forms, in the order of the catalogue.
        moving: keys that change the robot's motion, sorted as the engine expects them.
        world_fixed: those of `moving` that depend on position or heading in the world.
        base: (K,) the twin's own values, in the parameters' units: a candidate is a change of them.
        composite: keys of composite forms (`Form.composite`), which have no column.
    """

    keys: tuple[str, ...]
    scale: Array
    low: Array
    high: Array
    units: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    moving: tuple[str, ...]
    world_fixed: frozenset[str]
    base: Array
    composite: frozenset[str] = frozenset()

    @classmethod
    def of(cls, effects: Iterable[str] | None = None, present: Iterable[str] = ()) -> Self:
        """The named effects; None: all candidates of the catalogue, registered ones included.

        Args:
            present: keys of effects that the twin already has; their forms are always candidates.

        Raises:
            ConfigError: no effect, or an unknown one; the nearest names are listed.
        """
        wanted = None if effects is None else tuple(effects)
        if wanted == ():
            raise ConfigError(
                "no effect is named", remedy="name some, or none at all for the whole catalogue"
            )
        for name in wanted or ():
            forms_of(name)  # refuses unknown ones
        in_twin = {lookup(key)[0].key for key in present}

        def included(form: Form) -> bool:
            present = form.key in in_twin and form.candidate
            return present or (form.candidate if wanted is None else form.effect in wanted)

        known = {k: v for k, v in parameters().items() if included(v[0])}
        known = dict(sorted(known.items(), key=lambda one: one[1][0].composite))  # the others in their order
        keys = tuple(known)
        forms = [
            Hypothesis(f.effect, f.name, tuple(i for i, key in enumerate(keys) if known[key][0].key == f.key))
            for f in catalogue().values()
            if included(f)
        ]
        numbers = [p for _, p in known.values()]
        return cls(
            keys, np.array([p.scale for p in numbers]), np.array([p.low for p in numbers]),
            np.array([p.high for p in numbers]), tuple(p.unit for p in numbers), tuple(forms),
            tuple(sorted(key for key in keys if moves(key))),
            frozenset(key for key in keys if known[key][0].world_fixed()), np.zeros(len(keys)),
            frozenset(key for key in keys if known[key][0].composite),
        )  # fmt: skip

    def sized_for(self, vehicle: VehicleParams) -> Self:
        """With typical sizes and ranges of a robot of this mass and wheel radius."""
        known = [lookup(key)[1].sized(vehicle.body.mass_kg, vehicle.wheel.radius_m) for key in self.keys]
        scale, low, high = np.array([(p.scale, p.low, p.high) for p in known]).T
        return replace(self, scale=scale, low=low, high=high)

    def beside(self, effects: Mapping[str, float]) -> Self:
        """As changes of a twin that has these effects already."""
        return replace(self, base=np.array([effects.get(key, 0.0) for key in self.keys]))

    @property
    def count(self) -> int:
        """Of columns."""
        return len(self.keys) - len(self.composite)

    def is_composite(self, law: Hypothesis) -> bool:
        """Whether a law has no column."""
        return max(law.columns) >= self.count

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects, in the order of the catalogue."""
        return tuple(dict.fromkeys(h.effect for h in self.hypotheses))

    def any_world_fixed(self, effects: Mapping[str, float]) -> bool:
        """Whether one of these effects, by key, depends on position or heading in the world."""
        return any(value != 0.0 and key in self.world_fixed for key, value in effects.items())

    def bounds(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Least and greatest changes (k,), in typical sizes; zero where there is no room for `SMALLEST`."""
        at = list(columns)
        base, scale = self.base[at], self.scale[at]
        low, high = (RANGE_SHARE * end[at] / scale - base / scale for end in (self.low, self.high))
        return np.where(low <= -SMALLEST, low, 0.0), np.where(high >= SMALLEST, high, 0.0)

    def changed(self, columns: Sequence[int], change: Array) -> dict[str, float]:
        """The twin's parameters by key with a change (k,) of some, in typical sizes, within their ranges."""
        return {
            self.keys[i]: float(np.clip(self.base[i] + x * self.scale[i], self.low[i], self.high[i]))
            for i, x in zip(columns, change, strict=True)
        }
