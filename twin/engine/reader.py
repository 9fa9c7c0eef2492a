"""The sensors' readings along a run, compiled: several samples side by side in the lanes of vectors."""

import ctypes
import functools

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine import codegen, compiler
from terrafusion.twin.engine.native import BUILDING
from terrafusion.twin.physics.layout import OUTPUTS


class Reader:
    """`measurement.measured` with fixed names of effects; calls release the GIL and share nothing."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._read = library.tf_read
        self._read.restype = None
        self._read.argtypes = [
            ctypes.c_long, *[ctypes.c_void_p] * 3, ctypes.c_long, *[ctypes.c_void_p] * 4
        ]  # fmt: skip

    def __call__(
        self, states: Array, inputs: Array, soil: Array, vehicle: Array, effects: Array, mounting: Array
    ) -> Array:
        """Outputs (N, Y) of states (N, X), inputs (N, U) and soils, (N, S) or one (S,), alike for all wheels.

        Args:
            vehicle, mounting: as in `measurement.measured`.
            effects: (E,) in the order of the names.
        """
        given = [
            np.ascontiguousarray(a, dtype=float) for a in (states, inputs, soil, vehicle, effects, mounting)
        ]
        out = np.empty((len(states), len(OUTPUTS)))
        x, u, ground, *rest = (a.ctypes.data for a in given)
        step = soil.shape[1] if soil.ndim == 2 else 0
        self._read(len(out), x, u, ground, step, *rest, out.ctypes.data)
        return out


@functools.cache
def reader(effects: tuple[str, ...], fixed_ground: bool) -> Reader | None:
    """The compiled readings, None where they cannot be compiled (which is logged)."""
    with BUILDING:
        what = codegen.follows_from(("reader", fixed_ground), effects)
        source = functools.partial(codegen.reader_source, effects, fixed_ground)
        library = compiler.load("the sensors' graph", what, source)
    return Reader(library) if library is not None else None
