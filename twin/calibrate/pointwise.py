"""A CasADi function evaluated at many samples by compiled code: a calibration in the virtual machine takes 7
times as long."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.engine.compiler import load

_LOOP = """
void tf_many(long n, const double **first, const long *stride, double **out, const long *size,
             long arguments, long results, long long *iw, double *w, const double **arg, double **res) {{
  for (long i = 0; i < n; i++) {{
    for (long k = 0; k < arguments; k++) arg[k] = first[k] + i * stride[k];
    for (long k = 0; k < results; k++) res[k] = out[k] + i * size[k];
    {name}(arg, res, iw, w, 0);
  }}
}}
"""


class Pointwise:
    """`function`, whose results are dense, compiled with a loop over samples."""

    def __init__(self, function: Any, library: ctypes.CDLL) -> None:
        self._many = library.tf_many
        self._many.restype = None
        self._many.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * 4, ctypes.c_long, ctypes.c_long,
                               *[ctypes.c_void_p] * 4]  # fmt: skip
        self._in, self._out = function.n_in(), function.n_out()
        self._shapes = [function.size_out(i) for i in range(self._out)]
        self._work = (function.sz_iw() + 1, function.sz_w() + 1, function.sz_arg(), function.sz_res())

    def __call__(self, count: int, *arguments: Array) -> list[Array]:
        """Results (count, rows, columns) for arguments (count, k), or (k,) where all samples share them."""
        given = [np.ascontiguousarray(a, dtype=float) for a in arguments]
        outs = [np.empty((count, columns, rows)) for rows, columns in self._shapes]
        iw, w, arg, res = self._work
        strides = [a.shape[1] if a.ndim == 2 else 0 for a in given]
        sizes = [rows * columns for rows, columns in self._shapes]
        ints, reals = (ctypes.c_longlong * iw)(), (ctypes.c_double * w)()
        pointers, results = (ctypes.c_void_p * max(arg, 1))(), (ctypes.c_void_p * max(res, 1))()
        self._many(
            count, (ctypes.c_void_p * self._in)(*(a.ctypes.data for a in given)),
            (ctypes.c_long * self._in)(*strides),
            (ctypes.c_void_p * self._out)(*(o.ctypes.data for o in outs)),
            (ctypes.c_long * self._out)(*sizes),
            self._in, self._out, ints, reals, pointers, results,
        )  # fmt: skip
        return [out.transpose(0, 2, 1) for out in outs]


def pointwise(function: Any) -> Pointwise | None:
    """The compiled function, None where there is no compiler (or it fails, which is logged)."""
    import casadi as ca

    generator = ca.CodeGenerator("twin.c", {"with_header": False, "casadi_int": "long long"})
    generator.add(function)
    source = generator.dump() + _LOOP.format(name=function.name())
    library = load("a graph", None, lambda: source)
    return Pointwise(function, library) if library is not None else None
