"""Many runs at once, each with its own vehicle, ground and commands, in the lanes of vectors.

Every lane does what `integrate.integrate` does, in the same order and with the same functions: a run has the
same bits alone and among others. With numbers of 32 bits twice as many go together; these have other bits,
again the same alone and among others.
"""

from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine import vm
from terrafusion.twin.engine.codegen import LANES, LANES_32, SINGLE, Variant
from terrafusion.twin.engine.integrate import chosen
from terrafusion.twin.engine.native import CPlant, Driver
from terrafusion.twin.engine.stability import stable_steps
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.physics.layout import INPUTS, STATES


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
    order: int = 4,
    short: bool = False,
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
        substeps: RK4 steps a sample; by default each run's own `stable_steps`.
        every: only every so many-th sample is returned, from the first on.
        jobs: threads (compiled code runs outside Python's global lock).
        order: of the Runge-Kutta steps, 4 or 3 (a quarter less work).
        short: numbers of 32 bits, twice as many runs at once (compiled code only).

    Raises:
        ValueError: an array is misshapen, or there is no such order.
    """
    count = len(plants)
    inputs = np.ascontiguousarray(inputs, dtype=float)
    shared = inputs.ndim == 2
    shape = inputs.shape if shared else inputs.shape[1:]
    if len(shape) != 2 or shape[1] != len(INPUTS) or not shape[0] or not (shared or len(inputs) == count):
        raise ValueError(f"inputs {inputs.shape} are misshapen for {count} runs")
    out = np.empty((count, (shape[0] - 1) // every + 1, len(STATES)))
    out[:, 0] = x0
    fleet = Fleet.of(plants, dt_s, backend, substeps, order, short)
    fleet.drive([inputs] * count if shared else list(inputs), list(out), t0_s, every, jobs)
    blank_what_diverged(out)
    return out


class _Task(NamedTuple):
    """Runs that one call drives (a lane may repeat a run), and their plants as the driver reads them."""

    native: Driver | None
    held: list[CPlant]
    steps: int
    runs: list[int]


@dataclass(frozen=True, eq=False)
class Fleet:
    """Plants prepared to be driven together, as often as needed."""

    plants: Sequence[Plant]
    dt_s: float
    tasks: list[_Task]
    order: int

    @classmethod
    def of(
        cls,
        plants: Sequence[Plant],
        dt_s: float,
        backend: str = "auto",
        substeps: Sequence[int] | int | None = None,
        order: int = 4,
        short: bool = False,
    ) -> Self:
        """Groups plants that share graph and step, as many as a driver has lanes; arguments as those of
        `integrate_many`, `substeps` also by plant.

        Raises:
            ValueError: `order`, that of the Runge-Kutta steps, is not 3 or 4.
        """
        if order not in (3, 4):
            raise ValueError(f"there is no step of order {order}: 3 and 4 are known")
        alike: dict[tuple[tuple[str, ...], bool, int], list[int]] = defaultdict(list)
        for i, plant in enumerate(plants):
            own = substeps[i] if isinstance(substeps, Sequence) else substeps
            steps = own if own is not None else stable_steps(dt_s, plant, order)
            alike[plant.effect_names(), plant.route.is_fixed(), steps].append(i)
        tasks: list[_Task] = []
        for (effects, fixed, steps), runs in alike.items():
            kind = LANES_32 if short else LANES if len(runs) > 1 else SINGLE
            native = chosen(backend, Variant(kind, effects, fixed))
            lanes = 1 if native is None else native.lanes
            for first in range(0, len(runs), lanes):
                some = runs[first : first + lanes]
                some = some + some[-1:] * (lanes - len(some))
                held = [] if native is None else native.held([plants[i] for i in some])
                tasks.append(_Task(native, held, steps, some))
        return cls(plants, dt_s, tasks, order)

    def drive(
        self, inputs: Sequence[Array], outs: Sequence[Array], t0_s: float = 0.0, every: int = 1, jobs: int = 1
    ) -> None:
        """Fill `outs` (N // every + 1, X), whose first rows hold the starts, by the runs' inputs (N + 1, U).

        All arrays are contiguous; those of several runs may be one.
        """

        def one(task: _Task) -> None:
            some = [inputs[i] for i in task.runs]
            if task.native is not None:
                own = [outs[i] for i in task.runs]
                task.native.run(task.held, some, own, self.dt_s, t0_s, task.steps, every, self.order)
                return
            for i, u in zip(task.runs, some, strict=True):
                states = vm.run(outs[i][0], u, self.dt_s, self.plants[i], t0_s, task.steps, self.order)
                outs[i][:] = states[::every]

        if jobs > 1 and all(task.native is not None for task in self.tasks):
            with ThreadPoolExecutor(jobs) as pool:  # CasADi's virtual machine is not safe in threads
                list(pool.map(one, self.tasks))
            return
        for task in self.tasks:
            one(task)


def blank_what_diverged(out: Array) -> None:
    """Set runs (B, N, X) to NaN from their first sample that is not finite (none becomes finite again)."""
    if np.isfinite(out[:, -1]).all():
        return
    with np.errstate(invalid="ignore", over="ignore"):
        bad = ~np.isfinite(out.sum(axis=2))
    out[np.logical_or.accumulate(bad, axis=1)] = np.nan
