"""Square roots of information matrices: QR of stacked rows, and solving with the triangle."""

import math
from collections.abc import Iterable

import numpy as np
from scipy.linalg import lapack

from terrafusion.datasets.core.arrays import Array

_UPPER = np.triu(np.ones((64, 65)))
"""Keeps the upper triangle; for two states of 30 at most."""


def eliminated(stacked: Array, known: Array) -> tuple[Array, Array]:
    """Eliminate the first of two states from rows over both.

    Args:
        stacked: (m, 2 d + 1) with m > 2 d, its first rows left free for `known`.
        known: (<= d, d + 1) rows over the first state alone.

    Returns:
        What the rows say of the first state given the second (d, 2 d + 1; numbers below the diagonal
        mean nothing), and of the second alone (d, d + 1).
    """
    d = known.shape[1] - 1
    stacked[: len(known), :d], stacked[: len(known), -1] = known[:, :d], known[:, d]
    packed, _, _, _ = lapack.dgeqrf(stacked, overwrite_a=1)
    return np.asfortranarray(packed[:d]), packed[d : 2 * d, d:] * _UPPER[:d, : d + 1]


def triangular(stacked: Array) -> Array:
    """R (n - 1, n) of the QR decomposition of rows (m, n), the last column being the right-hand side."""
    rows, columns = stacked.shape
    if rows < columns:
        stacked = np.vstack([stacked, np.zeros((columns - rows, columns))])
    packed, _, _, _ = lapack.dgeqrf(stacked, overwrite_a=1)
    return np.asarray(packed[: columns - 1] * _UPPER[: columns - 1, :columns])


def back_substitute(R: Array, rhs: Array) -> Array:
    """Solve R x = rhs for an upper triangle R.

    Raises:
        ArithmeticError: R is singular, or the solution not finite.
    """
    solution, info = lapack.dtrtrs(R, rhs)
    if info or not math.isfinite(solution.sum()):
        raise ArithmeticError("a keyframe is not determined by its factors")
    return np.asarray(solution)


def back_substitute_before(conditionals: Iterable[Array], following: Array) -> list[Array]:
    """Solutions of states from that of the one after them, and `eliminated`'s first rows; the newest first.

    Raises:
        ArithmeticError: as `back_substitute`.
    """
    dim, out = len(following), []
    for conditional in conditionals:
        rhs = conditional[:, 2 * dim] - conditional[:, dim : 2 * dim] @ following
        following, info = lapack.dtrtrs(conditional[:, :dim], rhs)
        if info:
            raise ArithmeticError("a keyframe is not determined by its factors")
        out.append(following)
    if not math.isfinite(following.sum()):  # what is not finite stays so
        raise ArithmeticError("a keyframe is not determined by its factors")
    return out


def covariance_before(conditional: Array, following: Array) -> Array:
    """Marginal covariance (d, d) of a state from that of the one after it, and `eliminated`'s first rows."""
    dim = len(conditional)
    inverse, _ = lapack.dtrtri(conditional[:, :dim] * _UPPER[:dim, :dim])
    gain = inverse @ conditional[:, dim : 2 * dim]
    return np.asarray(inverse @ inverse.T + gain @ following @ gain.T)
