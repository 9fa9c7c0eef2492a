"""The compiled drivers as Python calls them."""

import ctypes
import functools
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine import codegen, compiler, library_cache
from terrafusion.twin.engine.codegen import Variant
from terrafusion.twin.model.plant import Plant

MAX_BLOCKS = 4
"""Blocks of directions a run carries (TF_BLOCKS of tangent.c)."""
_DOUBLE_P = ctypes.POINTER(ctypes.c_double)
BUILDING = threading.RLock()  # CasADi's graphs are not safe in threads


class _PlantStruct(ctypes.Structure):
    """`tf_plant` of driver.c."""

    _fields_ = (
        ("vehicle", _DOUBLE_P), ("effects", _DOUBLE_P),
        ("time_weight", ctypes.c_double), ("travel_weight", ctypes.c_double),
        ("knots", ctypes.c_long), ("at", _DOUBLE_P), ("table", _DOUBLE_P),
        ("rows", ctypes.c_long), ("columns", ctypes.c_long), ("cell", ctypes.c_double),
        ("log_gain", _DOUBLE_P), ("patch_share", _DOUBLE_P),
        ("response", _DOUBLE_P), ("patch_soil", _DOUBLE_P),
    )  # fmt: skip


class CPlant:
    """A `Plant` as the C driver reads it, with the optional parameters of the graph it is driven by."""

    def __init__(self, plant: Plant, effects: tuple[str, ...]) -> None:
        route, field = plant.route, plant.route.field
        values = np.array([plant.effects.get(name, 0.0) for name in effects], dtype=float)
        arrays = [plant.vehicle, values, route.at, route.soil]
        if field is not None:
            arrays += [field.log_gain, field.patch_share, field.response, field.patch_soil]
        self._arrays = [
            np.ascontiguousarray(a, dtype=float) for a in arrays
        ]  # kept alive: C points into them
        pointers = [pointer(a) for a in self._arrays] + [None] * (8 - len(arrays))
        rows, columns = (0, 0) if field is None else field.log_gain.shape
        self.struct = _PlantStruct(
            *pointers[:2], *route.weights(), len(route.at), *pointers[2:4], rows, columns,
            1.0 if field is None else field.cell_m, *pointers[4:],
        )  # fmt: skip


class Driver:
    """A compiled driver of `lanes` runs at a time (of the kind `TANGENT`: directions).

    Calls release the GIL and share nothing.
    """

    def __init__(self, library: ctypes.CDLL, variant: Variant) -> None:
        self.effects = variant.effects
        self.lanes = ctypes.c_int.in_dll(library, "tf_lanes").value
        self._simulate = library.tf_simulate
        self._simulate.restype = None
        self._simulate.argtypes = [
            ctypes.c_void_p, *[ctypes.c_long] * 4, ctypes.c_double, ctypes.c_double, ctypes.c_void_p,
            ctypes.c_void_p,
        ]  # fmt: skip
        if variant.kind == codegen.TANGENT:
            self._simulate_wide = library.tf_simulate_wide
            self._simulate_wide.restype = None
            self._simulate_wide.argtypes = [
                ctypes.c_void_p, *[ctypes.c_long] * 3, ctypes.c_double, ctypes.c_double, ctypes.c_void_p,
                ctypes.c_void_p, ctypes.c_long, *[ctypes.c_void_p] * 5,
            ]  # fmt: skip

    def held(self, plants: Sequence[Plant]) -> list[CPlant]:
        """The plants as this driver reads them."""
        return [CPlant(plant, self.effects) for plant in plants]

    def run(
        self,
        held: Sequence[CPlant],
        inputs: Sequence[Array],
        outs: Sequence[Array],
        dt_s: float,
        t0_s: float,
        steps: int,
        every: int = 1,
        order: int = 4,
    ) -> None:
        """Fill each of `outs` (N // every + 1, X), whose first row holds the start, by its inputs (N + 1, U).

        All arrays are contiguous; there are as many of each as the driver has lanes. The Runge-Kutta steps
        are of `order` 4 or 3.
        """
        addresses = (ctypes.c_void_p * self.lanes)(*(ctypes.addressof(h.struct) for h in held))
        self._simulate(
            addresses, len(inputs[0]) - 1, steps, order, every, t0_s, dt_s,
            (ctypes.c_void_p * self.lanes)(*(a.ctypes.data for a in inputs)),
            (ctypes.c_void_p * self.lanes)(*(a.ctypes.data for a in outs)),
        )  # fmt: skip

    def run_with_tangents(
        self,
        plant: Plant,
        inputs: Array,
        out: Array,
        dt_s: float,
        t0_s: float,
        steps: int,
        every: int,
        tangents: Sequence[Array],
    ) -> Array:
        """Fill `out` as `run` does; the tangents (N // every + 1, X, M).

        `tangents` are those of start (X, M), vehicle (V, M), effects (E, M) and route table (K S, M), with
        M a multiple of `lanes` and at most `MAX_BLOCKS` of them.
        """
        count = tangents[0].shape[1]
        blocks = count // self.lanes
        split = [np.ascontiguousarray(a.reshape(len(a), blocks, self.lanes).swapaxes(0, 1)) for a in tangents]
        wide = np.empty((len(out), out.shape[1], count))
        held = CPlant(plant, self.effects)
        self._simulate_wide(
            ctypes.addressof(held.struct), len(inputs) - 1, steps, every, t0_s, dt_s, inputs.ctypes.data,
            out.ctypes.data, blocks, *(a.ctypes.data for a in split), wide.ctypes.data,
        )  # fmt: skip
        return wide


def pointer(array: Array) -> Any:
    """The array's first element as C takes it."""
    return array.ctypes.data_as(_DOUBLE_P)


def driver(variant: Variant) -> Driver | None:
    """The driver, None where it cannot be compiled (logged once)."""
    with BUILDING:
        return _driver(variant)


@functools.cache
def _driver(variant: Variant) -> Driver | None:
    what = codegen.follows_from((*variant[:-1], sorted(variant.active)), variant.effects)
    library = compiler.load("the twin's C code", what, lambda: codegen.source(variant))
    return Driver(library, variant) if library is not None else None


def forget() -> None:
    """Look for the compiler and load the drivers anew (for tests)."""
    _driver.cache_clear()
    library_cache.say.cache_clear()
