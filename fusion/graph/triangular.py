"""Square roots of information matrices: QR of stacked rows, and solving with the triangle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]


def triangular(stacked: Array) -> Array:
    """R (n - 1, n) of the QR decomposition of rows (m, n), the last column being the right-hand side."""
    rows, columns = stacked.shape
    if rows < columns:
        stacked = np.vstack([stacked, np.zeros((columns - rows, columns))])
    packed, _, _, _ = lapack.dgeqrf(stacked, overwrite_a=1)
    return np.asarray(np.triu(packed[: columns - 1]))


def back_substitute(R: Array, rhs: Array) -> Array:
    """Solve R x = rhs for an upper triangle R.

    Raises:
        ArithmeticError: R is singular, or the solution not finite.
    """
    solution, info = lapack.dtrtrs(R, rhs)
    if info or not np.isfinite(solution).all():
        raise ArithmeticError("a keyframe is not determined by its factors")
    return np.asarray(solution)
