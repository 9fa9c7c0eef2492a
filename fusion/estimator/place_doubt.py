"""What wrong antenna and delay of the fixes add to the reported covariance.

Neither is a state of the graph. Fixes that come d later than taken for show where the robot was: they hold
the place at -d v, and the heading at -d w where it turns at a mean rate w; an antenna farther by a holds the
place at R a (sensitivities of a consider filter: Schmidt 1966, Adv. Control Systems 3). Without fixes the
place moves on with the heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.fusion.graph.key_state import POSE, KeyState

HEADING_TIME_S = 10.0
"""Time over which fixes hold the heading (assumed)."""


class PlaceDoubt:
    """Sensitivity of the estimate to antenna (x, y) and delay of the fixes, keyframe by keyframe.

    Attributes:
        sensitivity: derivatives (3, 3) of east, north and yaw by antenna x, y (m) and delay (s).
    """

    def __init__(self) -> None:
        self.sensitivity = np.zeros((3, 3))
        self._rate_radps, self._t_ns = 0.0, 0
        self._place_m = np.zeros(2)

    def step(self, t_ns: int, key: KeyState, yaw_rate_radps: float, aided: bool) -> None:
        """To the next keyframe, at `t_ns`; `aided`: fixes hold it."""
        place_m = np.asarray(key.pose.translation())[:2]
        dt_s, self._t_ns = (t_ns - self._t_ns) * 1e-9, t_ns
        east_m, north_m = (place_m - self._place_m).tolist()
        self._place_m = place_m
        new = -math.expm1(-dt_s / HEADING_TIME_S)
        self._rate_radps += new * (yaw_rate_radps - self._rate_radps)
        if aided:
            self.sensitivity = np.zeros((3, 3))
            self.sensitivity[:2, :2] = key.rotation[:2, :2]
            self.sensitivity[:2, 2] = -key.velocity[:2]
            self.sensitivity[2, 2] = -self._rate_radps
        else:
            self.sensitivity[:2] += np.outer([-north_m, east_m], self.sensitivity[2])

    def widened(self, P: Array, R: Array, moments: Array) -> Array:
        """Covariance P (dim, dim) of a keyframe's tangent with the doubt of place and heading.

        Args:
            R: (3, 3) body to world.
            moments: (3,) of the errors of antenna and delay, as of `PlaceBelief`.
        """
        tangent = np.zeros((6, 3))
        tangent[3:, :2], tangent[:3, 2] = R[:2].T, R[2]
        J = tangent @ self.sensitivity
        out = P.copy()
        out[POSE, POSE] += (J * moments) @ J.T
        return out


def widened_smoothed(
    t_ns: TimesNs, keys: Sequence[KeyState], yaw_rates_radps: Sequence[float], P: Array, moments: Array
) -> Array:
    """Covariances P (N, dim, dim) of the keyframes of a batch, all of which fixes hold, with the doubt.

    `moments` (N, 3) are those of the antenna and delay in use at the times (N,).
    """
    doubt, out = PlaceDoubt(), []
    for at_ns, key, rate, covariance, moment in zip(
        t_ns.tolist(), keys, yaw_rates_radps, P, moments, strict=True
    ):
        doubt.step(at_ns, key, rate, True)
        out.append(doubt.widened(covariance, key.rotation, moment))
    return np.array(out)
