"""Fixed-step RK4 integration of the twin: in compiled C, or in CasADi's virtual machine.

Both backends run the same graph with the same step, inputs linear between
samples and the soil following the route; they agree to rounding.
"""

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin.engine import vm
from terrafusion.twin.engine.codegen import SINGLE, Variant
from terrafusion.twin.engine.native import Driver, driver
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import INPUTS, STATES

BACKENDS = ("auto", "c", "vm")


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
        inputs: `INPUTS` at the samples, linear in between (see `commands.delayed_inputs`).
        dt_s: sample interval, s.
        plant: vehicle, ground and optional effects.
        t0_s: time of the first sample (matters for routes over time).
        backend: "c", "vm", or "auto" (C where a compiler is found).
        substeps: RK4 steps a sample; by default `stable_steps`.

    Raises:
        TerrafusionError: the state ceased to be finite (the message names the time).
    """
    steps = substeps if substeps is not None else stable_steps(dt_s, plant, 4)
    x0, inputs = checked(x0, inputs)
    native = chosen(backend, Variant(SINGLE, plant.effect_names(), plant.route.is_fixed()))
    if native is None:
        states = vm.run(x0, inputs, dt_s, plant, t0_s, steps)
    else:
        states = np.empty((len(inputs), len(STATES)))
        states[0] = x0
        native.run(native.held([plant]), [inputs], [states], dt_s, t0_s, steps)
    raise_if_diverged(states, t0_s, dt_s)
    return states


def checked(x0: Array, inputs: Array) -> tuple[Array, Array]:
    """The arrays as C reads them.

    Raises:
        ValueError: one is misshapen.
    """
    x0, inputs = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(inputs, dtype=float)
    if x0.shape != (len(STATES),) or inputs.ndim != 2 or inputs.shape[1] != len(INPUTS) or not len(inputs):
        raise ValueError(f"x0 {x0.shape} or inputs {inputs.shape} are misshapen")
    return x0, inputs


def chosen(backend: str, variant: Variant) -> Driver | None:
    """The compiled driver for a backend, None for the virtual machine.

    Raises:
        TerrafusionError: unknown backend, or "c" without a compiler.
    """
    if backend not in BACKENDS:
        raise TerrafusionError(f"unknown backend '{backend}'", remedy=f"known are {', '.join(BACKENDS)}")
    native = None if backend == "vm" else driver(variant)
    if native is None and backend == "c":
        raise TerrafusionError(
            "no C compiler was found", remedy="install one, or use the backend 'auto' or 'vm'"
        )
    return native


def raise_if_diverged(states: Array, t0_s: float, dt_s: float) -> None:
    """Raise a TerrafusionError that names the time of the first row (of N) that is not finite."""
    bad = np.flatnonzero(~np.isfinite(states.sum(axis=1)))
    if bad.size:
        raise TerrafusionError(
            "the simulation diverged: its state is no longer finite",
            time_s=t0_s + int(bad[0]) * dt_s,
            remedy="check the vehicle's and the soil's parameters",
        )


def compiled() -> bool:
    """Whether `backend="auto"` runs compiled code."""
    return driver(Variant(SINGLE, (), True)) is not None
