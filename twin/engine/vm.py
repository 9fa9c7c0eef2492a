"""The twin in CasADi's virtual machine: where no C compiler is found, and to test the C code against."""

import functools
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.model.dynamics import rhs
from terrafusion.twin.model.plant import Plant, SoilField, smoothstep
from terrafusion.twin.physics.layout import (
    ENDS,
    INDEX,
    INPUTS,
    SIDES,
    SOIL_PARAMETERS,
    STATES,
    VEHICLE_PARAMETERS,
)

_CHUNK = 50
_ARGUMENTS = ("x", "t", "ua", "ub", "constants", "effects", "at", "table")


def run(
    x0: Array, inputs: Array, dt_s: float, plant: Plant, t0_s: float, steps: int, order: int = 4
) -> Array:
    """States (N + 1, X), as `integrate.integrate` returns them; not finite once they diverge."""
    one = _sample(len(plant.route.at), steps, plant.effect_names(), _Held(plant.route.field), order)
    return _accumulate(one, x0, inputs, dt_s, t0_s, _constants(plant, dt_s, plant.effect_values()))


def run_with_tangents(
    x0: Array,
    inputs: Array,
    dt_s: float,
    plant: Plant,
    t0_s: float,
    steps: int,
    tangents: tuple[Array, ...],
    effects: tuple[str, ...],
) -> Array:
    """(N + 1, X (1 + M)): the states, then their derivatives column by column.

    `tangents` are those of the start (X, M), vehicle (V, M), named effects (E, M)
    and route table (K S, M); the named effects are in the graph even where they are zero.
    """
    start, vehicle, effect, table = tangents
    count, route = start.shape[1], plant.route
    one = _sample_with_tangents(len(route.at), steps, effects, _Held(route.field), count)
    constants = _constants(plant, dt_s, plant.effect_values(effects))
    tangent_constants = np.vstack([np.zeros((3, count)), vehicle])
    z0 = np.concatenate([x0, start.T.ravel()])
    return _accumulate(one, z0, inputs, dt_s, t0_s, (*constants, tangent_constants, effect, table))


def _constants(plant: Plant, dt_s: float, effects: Array) -> tuple[Array, ...]:
    route = plant.route
    held = np.concatenate([[dt_s, *route.weights()], plant.vehicle])
    return held, effects, route.at, route.soil.ravel()


def _accumulate(
    one: Any, x0: Array, inputs: Array, dt_s: float, t0_s: float, constants: tuple[Array, ...]
) -> Array:
    n = len(inputs) - 1
    out = np.full((n + 1, len(x0)), np.nan)
    out[0] = x0
    chunks: dict[int, Any] = {}
    for first in range(0, n, _CHUNK):
        count = min(_CHUNK, n - first)
        times = t0_s + dt_s * np.arange(first, first + count)
        # mapaccum holds one column of each argument a step: what is constant is repeated by the map.
        if count not in chunks:
            chunks[count] = one.mapaccum("tf_chunk", count)
        repeated = (np.tile(c, count) if c.ndim == 2 else c for c in constants)
        block = chunks[count](
            out[first], times[None, :], inputs[first : first + count].T,
            inputs[first + 1 : first + 1 + count].T, *repeated,
        )  # fmt: skip
        out[first + 1 : first + 1 + count] = np.asarray(block).T
    return out


class _Held:
    """A field as a key of the cache: equal only to itself."""

    def __init__(self, field: SoilField | None) -> None:
        self.field = field

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and other.field is self.field

    def __hash__(self) -> int:
        return id(self.field)


@functools.lru_cache(maxsize=16)
def _sample(knots: int, steps: int, effects: tuple[str, ...], held: _Held, order: int) -> Any:
    """CasADi `Function`: the state one sample later, by `steps` Runge-Kutta steps (see driver.c)."""
    import casadi as ca

    f = rhs(effects)
    nx, nu, np_ = len(STATES), len(INPUTS), len(SOIL_PARAMETERS)
    x0, t0 = ca.MX.sym("x", nx), ca.MX.sym("t")
    ua, ub = ca.MX.sym("ua", nu), ca.MX.sym("ub", nu)
    constants, pe = ca.MX.sym("constants", f.size1_in(2) + 3), ca.MX.sym("effects", len(effects))
    at, flat = ca.MX.sym("at", knots), ca.MX.sym("table", knots * np_)
    h, vehicle, soil_at = constants[0] / steps, constants[3:], _soil(knots)
    ahead = [0.5 * end * vehicle[VEHICLE_PARAMETERS.index("wheelbase_m")] for end in ENDS]

    def slope(t: Any, x: Any, u: Any, vary: Any) -> Any:
        travel = [x[INDEX["travel"]] + a for a in ahead]
        soils = [soil_at(constants[1] * t + constants[2] * s, at, flat) for s in travel]
        return f(x, u, vehicle, ca.vertcat(*(vary(k, soil) for k, soil in enumerate(soils))), pe)

    x = x0
    for j in range(steps):
        t = t0 + j * h
        u = [ua + (j + 0.5 * m) / steps * (ub - ua) for m in range(3)]
        vary = _field(held.field, x, vehicle)
        k1 = slope(t, x, u[0], vary)
        k2 = slope(t + 0.5 * h, x + 0.5 * h * k1, u[1], vary)
        if order == 3:
            k3 = slope(t + h, x + h * (2.0 * k2 - k1), u[2], vary)
            x = x + h / 6.0 * (k1 + 4.0 * k2 + k3)
            continue
        k3 = slope(t + 0.5 * h, x + 0.5 * h * k2, u[1], vary)
        k4 = slope(t + h, x + h * k3, u[2], vary)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return ca.Function("tf_sample", [x0, t0, ua, ub, constants, pe, at, flat], [x], _ARGUMENTS, ["end"])


@functools.lru_cache(maxsize=16)
def _sample_with_tangents(knots: int, steps: int, effects: tuple[str, ...], held: _Held, count: int) -> Any:
    """CasADi `Function`: state and tangents (X (1 + M),) one sample later."""
    import casadi as ca

    one = _sample(knots, steps, effects, held, 4)
    forward = one.forward(count)
    nx = len(STATES)
    z = ca.MX.sym("z", nx * (1 + count))
    plain = {name: ca.MX.sym(name, one.size1_in(name)) for name in _ARGUMENTS[1:]}
    seeds = {
        name: ca.MX.sym(f"d_{name}", one.size1_in(name), count) for name in ("constants", "effects", "table")
    }
    x = z[:nx]
    end = one(x, *plain.values())
    moved = {f"fwd_{name}": seeds.get(name, ca.MX(one.size1_in(name), count)) for name in plain}
    tangent = forward(x=x, out_end=end, fwd_x=ca.reshape(z[nx:], nx, count), **plain, **moved)["fwd_end"]
    out = ca.vertcat(end, ca.vec(tangent))
    return ca.Function("tf_sample_tangents", [z, *plain.values(), *seeds.values()], [out])


def _soil(knots: int) -> Any:
    """CasADi `Function`: soil parameters (S,) at a coordinate of the route."""
    import casadi as ca

    n = len(SOIL_PARAMETERS)
    c, at, flat = ca.SX.sym("c"), ca.SX.sym("at", knots), ca.SX.sym("table", knots * n)
    soil = flat[:n]
    for k in range(knots - 1):
        s = ca.fmin(1.0, ca.fmax(0.0, (c - at[k]) / (at[k + 1] - at[k])))
        soil += smoothstep(s) * (flat[(k + 1) * n : (k + 2) * n] - flat[k * n : (k + 1) * n])
    return ca.Function("tf_soil", [c, at, flat], [soil])


def _field(field: SoilField | None, x: Any, vehicle: Any) -> Any:
    """vary(wheel, soil): the soil as the field has it under a wheel at the state `x`."""
    import casadi as ca

    if field is None:
        return lambda wheel, soil: soil
    shape = field.log_gain.shape
    points = [np.arange(n + 1.0) for n in reversed(shape)]
    gains, shares = (
        ca.interpolant("tf_field", "linear", points, np.pad(grid, (0, 1), mode="wrap").ravel())
        for grid in (field.log_gain, field.patch_share)
    )
    cosine, sine = ca.cos(x[INDEX["yaw"]]), ca.sin(x[INDEX["yaw"]])
    base = vehicle[VEHICLE_PARAMETERS.index("wheelbase_m")]
    track = vehicle[VEHICLE_PARAMETERS.index("track_m")]

    def vary(wheel: int, soil: Any) -> Any:
        ahead, left = 0.5 * ENDS[wheel] * base, 0.5 * SIDES[wheel] * track
        cell = ca.vertcat(
            x[INDEX["x"]] + cosine * ahead - sine * left, x[INDEX["y"]] + sine * ahead + cosine * left
        ) / field.cell_m  # fmt: skip
        size = np.array([shape[1], shape[0]], dtype=float)
        at = cell - size * ca.floor(cell / size)
        own = soil * ca.exp(field.response * gains(at))
        return own + shares(at) * (field.patch_soil - own)

    return vary
