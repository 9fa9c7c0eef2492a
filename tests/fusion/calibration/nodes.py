"""Nodes of a whole drive at once, as `SelfCalibration` begins them one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import node_due


def node_starts(t_s: Array, distance_m: Array, fix_sigma_m: float) -> NDArray[np.intp]:
    """Samples at which a node begins, from times (N + 1,) and distances (N,)."""
    rolled = np.concatenate([[0.0], np.cumsum(np.abs(distance_m))])
    found = [0]
    for i in range(1, len(t_s) - 1):
        last = found[-1]
        if node_due(float(t_s[i] - t_s[last]), float(rolled[i] - rolled[last]), fix_sigma_m):
            found.append(i)
    return np.array(found)
