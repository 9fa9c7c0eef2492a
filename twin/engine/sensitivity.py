"""Forward sensitivities: the derivatives of a run's states by its start, vehicle, soils and effects.

The tangents S = dx/dtheta follow dS/dt = f_x S + f_theta D, integrated together with the states by the same
RK4 steps: the result is the exact derivative of the discrete run, up to rounding (Hairer, Norsett and Wanner
1993, sec. II.6, internal differentiation).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine import vm
from terrafusion.twin.engine.codegen import TANGENT, Variant
from terrafusion.twin.engine.integrate import checked, chosen, raise_if_diverged
from terrafusion.twin.engine.native import MAX_BLOCKS
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS


@dataclass(frozen=True, eq=False)
class Directions:
    """M directions in the space of everything a run depends on smoothly.

    Attributes:
        start: (X, M) change of the initial state.
        vehicle: (V, M) change of `Plant.vehicle`.
        soil: (K, S, M) change of the route's soil parameters at its knots; the knots and the field stay.
        effects: (M,) change of each named optional parameter. A named one is in the graph even where its
            value is 0.
    """

    start: Array
    vehicle: Array
    soil: Array
    effects: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def zeros(cls, plant: Plant, count: int, effects: Iterable[str] = ()) -> Self:
        """`count` directions that change nothing yet: fill in what each of them changes."""
        return cls(
            np.zeros((len(STATES), count)), np.zeros((len(VEHICLE_PARAMETERS), count)),
            np.zeros((*plant.route.soil.shape, count)), {name: np.zeros(count) for name in effects},
        )  # fmt: skip

    @property
    def count(self) -> int:
        """M."""
        return int(np.shape(self.start)[1])


def integrate_with_sensitivity(
    x0: Array,
    inputs: Array,
    dt_s: float,
    plant: Plant,
    directions: Directions,
    *,
    t0_s: float = 0.0,
    backend: str = "auto",
    substeps: int | None = None,
    every: int = 1,
) -> tuple[Array, Array]:
    """States (N + 1, X), as `integrate` gives them, and their derivatives (N + 1, X, M) along M directions.

    The ground's dependence on the travel (borders of a route) and on the pose (a field) is part of the
    derivative. A field's gradient is that of its bilinear cells: it jumps where a wheel crosses from one cell
    into the next, and the derivative of such a run is that of the run as computed.

    Args:
        x0, inputs, dt_s, plant, t0_s, backend, substeps: as for `integrate.integrate`.
        directions: what changes in each direction.
        every: only every so many-th sample is returned, from the first on.

    Raises:
        TerrafusionError: the state or a derivative ceased to be finite (the message names the time).
        ValueError: an array is misshapen.
    """
    x0, inputs = checked(x0, inputs)
    steps = substeps if substeps is not None else stable_steps(dt_s, plant, 4)
    effects = plant.effect_names(directions.effects)
    tangents = _tangents(plant, directions, effects)
    fixed = plant.route.is_fixed()
    native = chosen(backend, Variant(TANGENT, effects, fixed, _active(tangents, fixed)))
    nx, count = len(STATES), directions.count
    if native is None:
        out = vm.run_with_tangents(x0, inputs, dt_s, plant, t0_s, steps, tangents, effects)[::every]
        raise_if_diverged(out, t0_s, every * dt_s)
        return out[:, :nx], out[:, nx:].reshape(len(out), count, nx).transpose(0, 2, 1)
    states, parts = np.empty(((len(inputs) - 1) // every + 1, nx)), list[Array]()
    together = native.lanes * MAX_BLOCKS  # as many directions at a time as the driver carries
    for first in range(0, max(count, 1), together):
        some = [a[:, first : first + together] for a in tangents]
        missing = -some[0].shape[1] % native.lanes
        padded = [np.pad(a, ((0, 0), (0, missing))) for a in some]
        states[0] = x0
        wide = native.run_with_tangents(plant, inputs, states, dt_s, t0_s, steps, every, padded)
        parts.append(wide[:, :, : some[0].shape[1]])
        raise_if_diverged(states, t0_s, every * dt_s)
        raise_if_diverged(wide.reshape(len(wide), -1), t0_s, every * dt_s)
    return states, parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)


def _active(tangents: tuple[Array, ...], fixed_ground: bool) -> frozenset[tuple[str, int]]:
    """The parameters that change along some direction; all of the soil on ground that changes."""
    _, vehicle, effects, table = (a.any(axis=1) for a in tangents)
    soil = table.reshape(-1, len(SOIL_PARAMETERS)).any(axis=0) | (not fixed_ground)
    named = {"vehicle": vehicle, "effects": effects, "soil": soil}
    return frozenset((name, int(i)) for name, some in named.items() for i in np.flatnonzero(some))


def _tangents(plant: Plant, d: Directions, effects: tuple[str, ...]) -> tuple[Array, ...]:
    """Tangents of start (X, M), vehicle (V, M), effects (E, M) and route table (K S, M)."""
    count = d.count
    wanted = {
        "start": (d.start, (len(STATES), count)),
        "vehicle": (d.vehicle, (len(VEHICLE_PARAMETERS), count)),
        "soil": (d.soil, (len(plant.route.at), len(SOIL_PARAMETERS), count)),
        **{name: (values, (count,)) for name, values in d.effects.items()},
    }
    for name, (values, shape) in wanted.items():
        if np.shape(values) != shape:
            raise ValueError(f"directions of '{name}' have shape {np.shape(values)}, not {shape}")
    effect = np.array([d.effects.get(name, np.zeros(count)) for name in effects]).reshape(-1, count)
    arrays = (d.start, d.vehicle, effect, np.reshape(d.soil, (-1, count)))
    return tuple(np.ascontiguousarray(a, dtype=float) for a in arrays)
