"""Fixed-step RK4 integration of the twin: in compiled C, or in CasADi's virtual machine.

Both backends run the same graph with the same step, inputs linear between
samples and the soil following the route; they agree to rounding.
"""

from __future__ import annotations

import ctypes
import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.twin.dynamics import INDEX, INPUTS, SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS, rhs
from terrafusion.twin.engine.codegen import driver

Array = NDArray[np.float64]

BACKENDS = ("auto", "c", "vm")
MAX_STEP_S = 1.0 / 300.0
"""Longest RK4 step."""
MAX_STEP_LAGS = 5.0 / 3.0
"""Longest RK4 step in motor lags, the fastest mode of the model: RK4 is stable to 2.78 of them."""

_VM_CHUNK = 50


@dataclass(frozen=True, eq=False)
class RouteTable:
    """Soil parameters along the route.

    Attributes:
        coordinate: "travel" (metres driven forward) or "time" (seconds).
        at: (K,) increasing knots of the coordinate.
        soil: (K, 16) `SOIL_PARAMETERS` at the knots, joined smoothly between them.
    """

    coordinate: str
    at: Array
    soil: Array

    def weights(self) -> tuple[float, float]:
        """Factors of time and travel that make the coordinate."""
        return (1.0, 0.0) if self.coordinate == "time" else (0.0, 1.0)


def integrate(
    x0: Array,
    inputs: Array,
    dt_s: float,
    vehicle: Array,
    route: RouteTable,
    *,
    t0_s: float = 0.0,
    backend: str = "auto",
    substeps: int | None = None,
) -> Array:
    """States (N + 1, 38) at t0 + i dt from the state `x0` (38,) under the inputs (N + 1, 2).

    Args:
        x0: initial state, in the order of `STATES`.
        inputs: commanded side speeds at the samples, rad/s, linear in between.
        dt_s: sample interval, s.
        vehicle: (22,) `VEHICLE_PARAMETERS`.
        route: soil along the way.
        t0_s: time of the first sample (matters for routes over time).
        backend: "c", "vm", or "auto" (C where a compiler is found).
        substeps: RK4 steps a sample; by default `steps_a_sample`.

    Raises:
        TerrafusionError: the state ceased to be finite (the message names the time).
    """
    if backend not in BACKENDS:
        raise TerrafusionError(f"unknown backend '{backend}'", remedy=f"known are {', '.join(BACKENDS)}")
    steps = substeps if substeps is not None else steps_a_sample(dt_s, vehicle)
    x0, inputs = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(inputs, dtype=float)
    if x0.shape != (len(STATES),) or inputs.ndim != 2 or inputs.shape[1] != len(INPUTS) or not len(inputs):
        raise ValueError(f"x0 {x0.shape} or inputs {inputs.shape} are misshapen")
    library = None if backend == "vm" else driver()
    if library is None and backend == "c":
        raise TerrafusionError(
            "no C compiler was found", remedy="install one, or use the backend 'auto' or 'vm'"
        )
    run = _run_c if library is not None else _run_vm
    states, last = run(library, x0, inputs, dt_s, vehicle, route, t0_s, steps)
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
    return driver() is not None


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _run_c(
    library: Any,
    x0: Array,
    inputs: Array,
    dt: float,
    vehicle: Array,
    route: RouteTable,
    t0: float,
    steps: int,
) -> tuple[Array, int]:
    out = np.empty((len(inputs), len(STATES)))
    out[0] = x0
    vehicle, at, soil = (np.ascontiguousarray(a, dtype=float) for a in (vehicle, route.at, route.soil))
    last = library.tf_simulate(
        len(inputs) - 1, steps, t0, dt, _pointer(inputs), _pointer(vehicle), _pointer(out),
        *route.weights(), len(at), _pointer(at), _pointer(soil),
    )  # fmt: skip
    if last < 0:
        raise MemoryError("the twin's work arrays")
    return out, int(last)


def _run_vm(
    library: Any,
    x0: Array,
    inputs: Array,
    dt: float,
    vehicle: Array,
    route: RouteTable,
    t0: float,
    steps: int,
) -> tuple[Array, int]:
    n = len(inputs) - 1
    out = np.full((n + 1, len(STATES)), np.nan)
    out[0] = x0
    constants = np.concatenate([[dt, *route.weights()], vehicle])
    for first in range(0, n, _VM_CHUNK):
        count = min(_VM_CHUNK, n - first)
        sample = _vm_sample(len(route.at), steps).mapaccum("tf_chunk", count)
        times = t0 + dt * np.arange(first, first + count)
        block = sample(
            out[first], times[None, :], inputs[first : first + count].T,
            inputs[first + 1 : first + 1 + count].T, constants, route.at, route.soil.ravel(),
        )  # fmt: skip
        out[first + 1 : first + 1 + count] = np.asarray(block).T
    bad = np.flatnonzero(~np.isfinite(out.sum(axis=1)))
    return out, int(bad[0]) - 1 if bad.size else n


@functools.lru_cache(maxsize=16)
def _vm_sample(knots: int, steps: int) -> Any:
    """CasADi `Function`: the state one sample later, by `steps` RK4 steps."""
    import casadi as ca

    f = rhs()
    nx, nu, np_ = len(STATES), len(INPUTS), len(SOIL_PARAMETERS)
    x0, t0 = ca.MX.sym("x", nx), ca.MX.sym("t")
    ua, ub = ca.MX.sym("ua", nu), ca.MX.sym("ub", nu)
    constants = ca.MX.sym("constants", f.size1_in(2) + 3)
    at, flat = ca.MX.sym("at", knots), ca.MX.sym("table", knots * np_)
    soil_at = _vm_soil(knots)
    h = constants[0] / steps

    def slope(t: Any, x: Any, u: Any) -> Any:
        c = constants[1] * t + constants[2] * x[INDEX["travel"]]
        return f(x, u, constants[3:], soil_at(c, at, flat))

    x = x0
    for j in range(steps):
        t = t0 + j * h
        u = [ua + (j + 0.5 * m) / steps * (ub - ua) for m in range(3)]
        k1 = slope(t, x, u[0])
        k2 = slope(t + 0.5 * h, x + 0.5 * h * k1, u[1])
        k3 = slope(t + 0.5 * h, x + 0.5 * h * k2, u[1])
        k4 = slope(t + h, x + h * k3, u[2])
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return ca.Function("tf_sample", [x0, t0, ua, ub, constants, at, flat], [x])


def _vm_soil(knots: int) -> Any:
    """CasADi `Function`: soil parameters (16,) at a coordinate of the route."""
    import casadi as ca

    n = len(SOIL_PARAMETERS)
    c, at, flat = ca.SX.sym("c"), ca.SX.sym("at", knots), ca.SX.sym("table", knots * n)
    soil = flat[:n]
    for k in range(knots - 1):
        s = ca.fmin(1.0, ca.fmax(0.0, (c - at[k]) / (at[k + 1] - at[k])))
        soil += s * s * (3.0 - 2.0 * s) * (flat[(k + 1) * n : (k + 2) * n] - flat[k * n : (k + 1) * n])
    return ca.Function("tf_soil", [c, at, flat], [soil])
