"""Many runs at once: vehicles, grounds and commands of their own, side by side in the lanes of vectors.

Every lane does what `integrate.integrate` does, in the same order and with the same functions: a run has the
same bits alone and among others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.engine import vm
from terrafusion.twin.engine.codegen import LANES, SINGLE, Variant
from terrafusion.twin.engine.integrate import chosen, steps_a_sample
from terrafusion.twin.engine.native import Driver
from terrafusion.twin.engine.plant import Plant
from terrafusion.twin.layout import INPUTS, STATES

Array = NDArray[np.float64]


def integrate_many(
    x0: Array,
    inputs: Array,
    dt_s: float,
    plants: Sequence[Plant],
    *,
    t0_s: float = 0.0,
    backend: str = "auto",
    substeps: int | None = None,
    every: int = 1,
    jobs: int = 1,
) -> Array:
    """States (B, N // every + 1, X) of B runs; see `integrate.integrate`.

    A run that diverges is NaN from its first sample that is not finite; the others are as they are alone.

    Args:
        x0: initial states (B, X), or one (X,) for all.
        inputs: (B, N + 1, U), or (N + 1, U) for all.
        dt_s: sample interval, s.
        plants: B vehicles, grounds and optional effects.
        t0_s: time of the first sample.
        backend: "c", "vm", or "auto" (C where a compiler is found).
        substeps: RK4 steps a sample; by default each run's own `steps_a_sample`.
        every: only every so many-th sample is returned, from the first on.
        jobs: threads (compiled code runs outside Python's global lock).

    Raises:
        ValueError: an array is misshapen.
    """
    count = len(plants)
    inputs = np.ascontiguousarray(inputs, dtype=float)
    shared = inputs.ndim == 2
    shape = inputs.shape if shared else inputs.shape[1:]
    if len(shape) != 2 or shape[1] != len(INPUTS) or not shape[0] or not (shared or len(inputs) == count):
        raise ValueError(f"inputs {inputs.shape} are misshapen for {count} runs")
    out = np.empty((count, (shape[0] - 1) // every + 1, len(STATES)))
    out[:, 0] = x0

    def drive(native: Driver | None, steps: int, runs: Sequence[int]) -> None:
        some = [inputs if shared else inputs[i] for i in runs]
        group = [plants[i] for i in runs]
        if native is not None:
            native.run(group, some, [out[i] for i in runs], dt_s, t0_s, steps, every)
            return
        for i, u, plant in zip(runs, some, group, strict=True):
            out[i] = vm.run(out[i, 0], u, dt_s, plant, t0_s, steps)[::every]

    tasks = _tasks(plants, backend, dt_s, substeps)
    native = all(driver is not None for driver, _, _ in tasks)
    with ThreadPoolExecutor(jobs if native else 1) as pool:  # CasADi's virtual machine is not safe in threads
        list(pool.map(lambda task: drive(*task), tasks))
    _blank_what_diverged(out)
    return out


_Task = tuple[Driver | None, int, list[int]]


def _tasks(plants: Sequence[Plant], backend: str, dt_s: float, substeps: int | None) -> list[_Task]:
    """Runs that share a graph and a step, as many together as a driver has lanes."""
    alike: dict[tuple[tuple[str, ...], bool, int], list[int]] = defaultdict(list)
    for i, plant in enumerate(plants):
        steps = substeps if substeps is not None else steps_a_sample(dt_s, plant.vehicle)
        alike[plant.effect_names(), plant.route.is_fixed(), steps].append(i)
    tasks: list[_Task] = []
    for (effects, fixed, steps), runs in alike.items():
        native = chosen(backend, Variant(LANES if len(runs) > 1 else SINGLE, effects, fixed))
        lanes = 1 if native is None else native.lanes
        for first in range(0, len(runs), lanes):
            some = runs[first : first + lanes]
            tasks.append((native, steps, some + some[-1:] * (lanes - len(some))))
    return tasks


def _blank_what_diverged(out: Array) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        bad = ~np.isfinite(out.sum(axis=2))
    out[np.logical_or.accumulate(bad, axis=1)] = np.nan
