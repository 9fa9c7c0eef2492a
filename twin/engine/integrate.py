"""Fixed-step RK4 integration of the twin: in compiled C, or in CasADi's virtual machine.

Both backends run the same graph with the same step, inputs linear between
samples and the soil following the route; they agree to rounding.
"""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.twin.dynamics import rhs
from terrafusion.twin.engine.codegen import CPlant, driver
from terrafusion.twin.engine.plant import Plant, SoilField
from terrafusion.twin.layout import INDEX, INPUTS, SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS

Array = NDArray[np.float64]

BACKENDS = ("auto", "c", "vm")
MAX_STEP_S = 1.0 / 300.0
"""Longest RK4 step."""
MAX_STEP_LAGS = 5.0 / 3.0
"""Longest RK4 step in motor lags, the fastest mode of the model: RK4 is stable to 2.78 of them."""

_VM_CHUNK = 50
_AHEAD, _LEFT = (0.5, 0.5, -0.5, -0.5), (0.5, -0.5, 0.5, -0.5)
"""Hubs in the order of `WHEELS`, in wheelbases ahead and tracks to the left of the body origin."""


def integrate(
    x0: Array,
    inputs: Array,
    dt_s: float,
    plant: Plant,
    *,
    t0_s: float = 0.0,
    backend: str = "auto",
    substeps: int | None = None,
) -> Array:
    """States (N + 1, X) at t0 + i dt from the state `x0` (X,) under the inputs (N + 1, U).

    Args:
        x0: initial state, in the order of `STATES`.
        inputs: `INPUTS` at the samples, linear in between (see `drive.told`).
        dt_s: sample interval, s.
        plant: vehicle, ground and optional effects.
        t0_s: time of the first sample (matters for routes over time).
        backend: "c", "vm", or "auto" (C where a compiler is found).
        substeps: RK4 steps a sample; by default `steps_a_sample`.

    Raises:
        TerrafusionError: the state ceased to be finite (the message names the time).
    """
    if backend not in BACKENDS:
        raise TerrafusionError(f"unknown backend '{backend}'", remedy=f"known are {', '.join(BACKENDS)}")
    steps = substeps if substeps is not None else steps_a_sample(dt_s, plant.vehicle)
    x0, inputs = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(inputs, dtype=float)
    if x0.shape != (len(STATES),) or inputs.ndim != 2 or inputs.shape[1] != len(INPUTS) or not len(inputs):
        raise ValueError(f"x0 {x0.shape} or inputs {inputs.shape} are misshapen")
    library = None if backend == "vm" else driver(plant.effect_names())
    if library is None and backend == "c":
        raise TerrafusionError(
            "no C compiler was found", remedy="install one, or use the backend 'auto' or 'vm'"
        )
    run = _run_c if library is not None else _run_vm
    states, last = run(library, x0, inputs, dt_s, plant, t0_s, steps)
    if last < len(inputs) - 1:
        raise TerrafusionError(
            "the simulation diverged: its state is no longer finite",
            time_s=t0_s + (last + 1) * dt_s,
            remedy="check the vehicle's and the soil's parameters",
        )
    return states


def steps_a_sample(dt_s: float, vehicle: Array) -> int:
    """RK4 steps in a sample interval: few enough to be fast, short enough for the vehicle's motor lag."""
    lag_s = float(vehicle[VEHICLE_PARAMETERS.index("lag_s")])
    return max(1, math.ceil(dt_s / min(MAX_STEP_S, MAX_STEP_LAGS * lag_s) - 1e-9))


def compiled() -> bool:
    """Whether `backend="auto"` runs compiled code."""
    return driver(()) is not None


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _run_c(
    library: Any, x0: Array, inputs: Array, dt: float, plant: Plant, t0: float, steps: int
) -> tuple[Array, int]:
    out = np.empty((len(inputs), len(STATES)))
    out[0] = x0
    held = CPlant(plant)
    last = library.tf_simulate(
        ctypes.byref(held.struct), len(inputs) - 1, steps, t0, dt, _pointer(inputs), _pointer(out)
    )
    if last < 0:
        raise MemoryError("the twin's work arrays")
    return out, int(last)


def _run_vm(
    library: Any, x0: Array, inputs: Array, dt: float, plant: Plant, t0: float, steps: int
) -> tuple[Array, int]:
    n, route = len(inputs) - 1, plant.route
    out = np.full((n + 1, len(STATES)), np.nan)
    out[0] = x0
    constants = np.concatenate([[dt, *route.weights()], plant.vehicle])
    effects = plant.effect_values()
    one = _vm_sample(len(route.at), steps, plant.effect_names(), _Held(route.field))
    for first in range(0, n, _VM_CHUNK):
        count = min(_VM_CHUNK, n - first)
        times = t0 + dt * np.arange(first, first + count)
        block = one.mapaccum("tf_chunk", count)(
            out[first], times[None, :], inputs[first : first + count].T,
            inputs[first + 1 : first + 1 + count].T, constants, effects, route.at, route.soil.ravel(),
        )  # fmt: skip
        out[first + 1 : first + 1 + count] = np.asarray(block).T
    bad = np.flatnonzero(~np.isfinite(out.sum(axis=1)))
    return out, int(bad[0]) - 1 if bad.size else n


class _Held:
    """A field as a key of the cache: equal only to itself."""

    def __init__(self, field: SoilField | None) -> None:
        self.field = field

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held) and other.field is self.field

    def __hash__(self) -> int:
        return id(self.field)


@functools.lru_cache(maxsize=16)
def _vm_sample(knots: int, steps: int, effects: tuple[str, ...], held: _Held) -> Any:
    """CasADi `Function`: the state one sample later, by `steps` RK4 steps."""
    import casadi as ca

    f = rhs(effects)
    nx, nu, np_ = len(STATES), len(INPUTS), len(SOIL_PARAMETERS)
    x0, t0 = ca.MX.sym("x", nx), ca.MX.sym("t")
    ua, ub = ca.MX.sym("ua", nu), ca.MX.sym("ub", nu)
    constants, pe = ca.MX.sym("constants", f.size1_in(2) + 3), ca.MX.sym("effects", len(effects))
    at, flat = ca.MX.sym("at", knots), ca.MX.sym("table", knots * np_)
    h, vehicle, soil_at = constants[0] / steps, constants[3:], _vm_soil(knots)
    ahead = [sign * vehicle[VEHICLE_PARAMETERS.index("wheelbase_m")] for sign in _AHEAD]

    def slope(t: Any, x: Any, u: Any, vary: Any) -> Any:
        travel = [x[INDEX["travel"]] + a for a in ahead]
        soils = [soil_at(constants[1] * t + constants[2] * s, at, flat) for s in travel]
        return f(x, u, vehicle, ca.vertcat(*(vary(k, soil) for k, soil in enumerate(soils))), pe)

    x = x0
    for j in range(steps):
        t = t0 + j * h
        u = [ua + (j + 0.5 * m) / steps * (ub - ua) for m in range(3)]
        vary = _vm_field(held.field, x, vehicle)
        k1 = slope(t, x, u[0], vary)
        k2 = slope(t + 0.5 * h, x + 0.5 * h * k1, u[1], vary)
        k3 = slope(t + 0.5 * h, x + 0.5 * h * k2, u[1], vary)
        k4 = slope(t + h, x + h * k3, u[2], vary)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return ca.Function("tf_sample", [x0, t0, ua, ub, constants, pe, at, flat], [x])


def _vm_soil(knots: int) -> Any:
    """CasADi `Function`: soil parameters (S,) at a coordinate of the route."""
    import casadi as ca

    n = len(SOIL_PARAMETERS)
    c, at, flat = ca.SX.sym("c"), ca.SX.sym("at", knots), ca.SX.sym("table", knots * n)
    soil = flat[:n]
    for k in range(knots - 1):
        s = ca.fmin(1.0, ca.fmax(0.0, (c - at[k]) / (at[k + 1] - at[k])))
        soil += s * s * (3.0 - 2.0 * s) * (flat[(k + 1) * n : (k + 2) * n] - flat[k * n : (k + 1) * n])
    return ca.Function("tf_soil", [c, at, flat], [soil])


def _vm_field(field: SoilField | None, x: Any, vehicle: Any) -> Any:
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
    half_base = vehicle[VEHICLE_PARAMETERS.index("wheelbase_m")]
    half_track = vehicle[VEHICLE_PARAMETERS.index("track_m")]

    def vary(wheel: int, soil: Any) -> Any:
        ahead, left = _AHEAD[wheel] * half_base, _LEFT[wheel] * half_track
        cell = ca.vertcat(
            x[INDEX["x"]] + cosine * ahead - sine * left, x[INDEX["y"]] + sine * ahead + cosine * left
        ) / field.cell_m  # fmt: skip
        size = np.array([shape[1], shape[0]], dtype=float)
        at = cell - size * ca.floor(cell / size)
        own = soil * ca.exp(field.response * gains(at))
        return own + shares(at) * (field.patch_soil - own)

    return vary
