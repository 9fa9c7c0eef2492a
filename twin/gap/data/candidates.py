"""The candidates of a diagnosis: every effect with its forms, their parameters as columns, and priors.

An effect is one hypothesis; its functional forms are alternatives within it. A column is one parameter,
counted in its catalogue scale ("typical" size), so that all columns are comparable.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.effects.catalogue import catalogue, effect_names, lookup, moves, parameters
from terrafusion.twin.effects.form import Form

Array = NDArray[np.float64]

SOIL = "soil_strength"
"""The effect that is a known parameter of the ground, not missing physics: verdict `parameters`."""


@dataclass(frozen=True)
class Hypothesis:
    """One functional form of one effect: the columns (indices) that it may move."""

    effect: str
    form: str
    columns: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Candidates:
    """All effects that take part.

    Attributes:
        keys: parameter keys of the catalogue, one a column.
        scale, low, high: typical size and range of each, in its unit.
        units: of each.
        hypotheses: the forms, in the order of the catalogue.
        moving: keys that change how the robot moves, sorted as the engine wants them.
        world_fixed: those of them that act by where in the plane the robot is or faces.
    """

    keys: tuple[str, ...]
    scale: Array
    low: Array
    high: Array
    units: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    moving: tuple[str, ...]
    world_fixed: frozenset[str]

    @classmethod
    def of(cls, effects: Iterable[str] | None = None, present: Iterable[str] = ()) -> Candidates:
        """The named effects; None: all of the catalogue that are candidates, the user's own included.

        Args:
            present: keys of what the twin has already: their forms take part.

        Raises:
            ConfigError: no effect, or one that is unknown; the nearest ones are named.
        """
        effects = None if effects is None else tuple(effects)
        _check(effects)
        wanted, there = None if effects is None else set(effects), {lookup(key)[0].key for key in present}

        def taken(form: Form) -> bool:
            return form.key in there or (form.candidate if wanted is None else form.effect in wanted)

        known = {k: v for k, v in parameters().items() if taken(v[0])}
        keys = tuple(known)
        forms = [
            Hypothesis(f.effect, f.name, tuple(i for i, key in enumerate(keys) if known[key][0].key == f.key))
            for f in catalogue().values()
            if taken(f)
        ]
        numbers = [p for _, p in known.values()]
        return cls(
            keys, np.array([p.scale for p in numbers]), np.array([p.low for p in numbers]),
            np.array([p.high for p in numbers]), tuple(p.unit for p in numbers), tuple(forms),
            tuple(sorted(key for key in keys if moves(key))),
            frozenset(key for key in keys if known[key][0].world_fixed()),
        )  # fmt: skip

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects, in the order of the catalogue."""
        return tuple(dict.fromkeys(h.effect for h in self.hypotheses))

    def any_world_fixed(self, effects: Mapping[str, float]) -> bool:
        """Whether these, by key, do something else at another place, or to a robot that faces elsewhere."""
        return any(value != 0.0 and key in self.world_fixed for key, value in effects.items())

    def columns(self, effect: str) -> tuple[int, ...]:
        """All columns of an effect, whatever their form."""
        return tuple(i for h in self.hypotheses if h.effect == effect for i in h.columns)


def _check(effects: tuple[str, ...] | None) -> None:
    if effects is not None and not effects:
        raise ConfigError("no effect is named", remedy="name some, or none at all for the whole catalogue")
    for name in effects or ():
        if name not in effect_names():
            near = difflib.get_close_matches(name, effect_names(), n=3, cutoff=0.5)
            remedy = f"did you mean {' or '.join(near)}" if near else "see docs/effects.md"
            raise ConfigError(f"unknown effect '{name}'", remedy=remedy)
