"""Coefficients of Runge-Kutta-Chebyshev steps: second order, stable far along the negative real axis.

A stiff robot on hard ground needs few evaluations of the model that way: the stable range grows with the
square of the number of stages (Sommeijer, Shampine and Verwer 1998, J. Comput. Appl. Math. 88, eqs. 2.7 to
2.9).
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.polynomial import chebyshev

from terrafusion.datasets.core.arrays import Array

DAMPING = 5.0
"""Eps of the paper, which takes 2/13: more shortens the stable range, and widens it beside the real axis,
where the shear of the ground swings with a wheel."""
FEWEST, MOST = 3, 40  # stages


@functools.cache
def coefficients(stages: int) -> Array:
    """Those of each stage (stages, 5): mu, nu, mu~, gamma~, and the share of the step at which it is. Stage j
    adds up to x + d_j with d_0 = 0 and
    d_j = mu_j d_(j-1) + nu_j d_(j-2) + h (mu~_j f_(j-1) + gamma~_j f_0)."""
    w0, count = 1.0 + DAMPING / stages**2, stages
    T = np.array([chebyshev.Chebyshev.basis(j).deriv(m)(w0) if m else chebyshev.Chebyshev.basis(j)(w0)
                  for m in range(3) for j in range(count + 1)]).reshape(3, -1)  # fmt: skip
    w1 = T[1, -1] / T[2, -1]
    b = np.empty(count + 1)
    b[2:] = T[2, 2:] / T[1, 2:] ** 2
    b[:2] = b[2]
    a = 1.0 - b * T[0]
    out = np.zeros((count, 5))
    out[0, 2] = b[1] * w1
    out[1:, 0] = 2.0 * w0 * b[2:] / b[1:-1]
    out[1:, 1] = -b[2:] / b[:-2]
    out[1:, 2] = 2.0 * w1 * b[2:] / b[1:-1]
    out[1:, 3] = -a[1:-1] * out[1:, 2]
    out[1:, 4] = w1 * T[2, 2:] / T[1, 2:]
    out[0, 4] = out[1, 4] / T[1, 2]
    out.flags.writeable = False
    return out


@functools.cache
def reach(stages: int) -> float:
    """Step times rate, along the negative real axis, up to which a step of so many stages is stable."""
    w0 = 1.0 + DAMPING / stages**2
    basis = chebyshev.Chebyshev.basis(stages)
    return float((w0 + 1.0) * basis.deriv(2)(w0) / basis.deriv(1)(w0))
