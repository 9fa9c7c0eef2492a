"""Ellipses of position uncertainty along a path, and the fixes that were rejected."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.plots import style

ELLIPSE_SIGMAS = 2.0
"""Half axes of the ellipses; two dimensions have 1 - exp(-2) = 86 % of their probability inside."""
ELLIPSE_S, MOST_ELLIPSES = 10.0, 60
"""Seconds between ellipses; longer drives get at most so many, outside and inside outages."""


def rejected_fixes(estimate: Estimate) -> TimesNs:
    """Times (N,) of the fixes whose position was rejected by a gate."""
    rejected = [i.t_ns for i in estimate.innovations if i.sensor == "gnss" and not i.accepted]
    return np.array(rejected, dtype=np.int64)


def ellipse_rows(estimate: Estimate, start_ns: int, outages: Sequence[Outage]) -> NDArray[np.int64]:
    """Keyframes that get an ellipse: one in ten seconds, and one in two seconds in an outage.

    An outage is one of `outages`, or where the estimate's status says so. The last keyframe of each is
    among them: there the position is the least certain.
    """
    t_ns = estimate.trajectory.t_ns
    alone = np.asarray(estimate.status == "outage")
    for outage in outages:
        alone |= outage.covers(t_ns, start_ns)
    rows: list[int] = []
    for inside, every_s in ((False, ELLIPSE_S), (True, ELLIPSE_S / 5.0)):
        chosen = np.flatnonzero(alone == inside)
        slot = ((t_ns[chosen] - start_ns) // round(every_s * 1e9)).astype(np.int64)
        first = chosen[np.flatnonzero(np.diff(slot, prepend=-1))]
        rows += first[style.thin(len(first), MOST_ELLIPSES)].tolist()
    ends = np.flatnonzero(alone & ~np.append(alone[1:], False))
    return np.unique(np.array([*rows, *ends.tolist()], dtype=np.int64))


def ellipses(estimate: Estimate, rows: NDArray[np.int64]) -> Array:
    """Ellipses (K, 41, 2) of the position, m, at those of the keyframes `rows` whose covariance is known."""
    path = estimate.trajectory
    if path.covariance is None:
        return np.zeros((0, 41, 2))
    P = path.covariance[rows, :2, :2]
    known = np.isfinite(P).all(axis=(1, 2)) & np.isfinite(path.position_m[rows, :2]).all(axis=1)
    size, axes = np.linalg.eigh(P[known])
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = ring * ELLIPSE_SIGMAS * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    return np.asarray(np.einsum("kij,knj->kni", axes, points) + path.position_m[rows[known], None, :2])
