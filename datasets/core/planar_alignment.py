"""Least-squares alignment of points in the plane; points are complex numbers, east + i north."""

import numpy as np

from terrafusion.datasets.core.arrays import Array, Complex


def planar_rotation(source: Complex, target: Complex, weights: Array | None = None) -> tuple[complex, float]:
    """Rotation that aligns points `source` (N,) with `target` (N,), and its information.

    The rotation is the argument of sum w_i conj(s_i - s) (t_i - t), s and t being the means (the planar case
    of Horn 1987, JOSA A 4(4), and Umeyama 1991, IEEE T-PAMI 13(4)). Its size over the information
    sum w_i |s_i - s|^2 is the scale.
    """
    if weights is None:
        a, b = source - _mean(source), target - _mean(target)
        return complex(np.sum(np.conj(a) * b)), float(np.sum(np.abs(a) ** 2))
    share = weights / weights.sum()
    from_mean = source - share @ source
    weighted = weights * from_mean.conj()
    return complex(weighted @ (target - share @ target)), float((weighted @ from_mean).real)


def _mean(points: Complex) -> complex:
    east, north = np.ascontiguousarray(points).view(np.float64).reshape(-1, 2).mean(axis=0)
    return complex(east, north)
