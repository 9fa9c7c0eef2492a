"""What wrong antenna, delay of the fixes and course lag add to the reported covariance.

None is a state of the graph. Fixes that come d later than taken for show where the robot was: they hold the
place at -d v, and the heading at -d w where it turns at a mean rate w; an antenna farther by a holds the
place at R a, and a course that lags by l more the heading at -l w (sensitivities of a consider filter:
Schmidt 1966, Adv. Control Systems 3). Without fixes the place moves on with the heading.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.graph.key_state import POSE, KeyState

LINEAR_YAW_RAD = 0.8
"""1 sigma of the heading up to which an ellipse holds where the robot may be (assumed)."""
HEADING_TIME_S = 60.0
"""Longest time over which fixes and gyro hold the heading together (assumed)."""


class PlaceDoubt:
    """Sensitivity of the estimate to antenna (x, y), delay of the fixes and course lag, keyframe by keyframe.

    Attributes:
        sensitivity: derivatives (3, 4) of east, north and yaw by antenna x, y (m), delay and lag (s).
    """

    def __init__(self) -> None:
        self.sensitivity = np.zeros((3, 4))
        self._rate_radps, self._began_ns, self._t_ns = 0.0, 0, 0
        self._place_m = np.zeros(2)

    def step(self, t_ns: int, key: KeyState, yaw_rate_radps: float, aided: bool) -> None:
        """To the next keyframe, at `t_ns`; `aided`: fixes hold it."""
        place_m = np.asarray(key.pose.translation())[:2]
        if not self._t_ns:
            self._began_ns = self._t_ns = t_ns
        held_s = min((t_ns - self._began_ns) * 1e-9, HEADING_TIME_S)
        new = (t_ns - self._t_ns) * 1e-9 / held_s if held_s > 0.0 else 1.0
        self._rate_radps += min(new, 1.0) * (yaw_rate_radps - self._rate_radps)
        east_m, north_m = (place_m - self._place_m).tolist()
        self._place_m, self._t_ns = place_m, t_ns
        if aided:
            self.sensitivity = np.zeros((3, 4))
            self.sensitivity[:2, :2] = key.rotation[:2, :2]
            self.sensitivity[:2, 2] = -key.velocity[:2]
            self.sensitivity[2, 2:] = -self._rate_radps
        else:
            self.sensitivity[:2] += np.outer([-north_m, east_m], self.sensitivity[2])

    def widened(self, P: Array, R: Array, moments: Array) -> Array:
        """Covariance P (dim, dim) of a keyframe's tangent with the doubt of place and heading.

        Args:
            R: (3, 3) body to world.
            moments: (4,) second moments of the errors of antenna, delay and lag, m2 and s2.
        """
        tangent = np.zeros((6, 3))
        tangent[3:, :2], tangent[:3, 2] = R[:2].T, R[2]
        J = tangent @ self.sensitivity
        out = P.copy()
        out[POSE, POSE] += (J * moments) @ J.T
        return out


@dataclass(frozen=True, eq=False)
class OpenHeading:
    """A local path that begins at a known place with a heading that is known to `sigma_rad` only.

    The graph holds the path in a frame of its own: an unknown turn of all of it is not linear. `until_ns` is
    the newest fix that gave the place.
    """

    place_m: Array
    sigma_rad: float
    until_ns: int

    def widened(self, state: State) -> State:
        """A state of that frame with the doubt of the turn about the place."""
        x_m, y_m = (state.position_m[:2] - self.place_m[:2]).tolist()
        by_turn = np.array([-y_m, x_m, 0.0, 0.0, 0.0, 1.0])
        covariance = state.covariance + self.sigma_rad**2 * np.outer(by_turn, by_turn)
        east, north, _ = state.velocity_mps.tolist()
        across = self.sigma_rad * np.array([-north, east, 0.0])
        velocity = state.velocity_covariance + np.outer(across, across)
        return dataclasses.replace(state, covariance=covariance, velocity_covariance=velocity)


def rounded(state: State) -> State:
    """A state whose covariance is a circle where the heading is all but unknown.

    A path of unknown direction ends on an arc; the ellipse of its linear part is far too thin. A circle of
    the same trace holds the arc's second moments for any sigma of the heading beyond `LINEAR_YAW_RAD`.
    """
    if state.covariance[5, 5] <= LINEAR_YAW_RAD**2:
        return state
    covariance = state.covariance.copy()
    covariance[:2], covariance[:, :2] = 0.0, 0.0
    np.fill_diagonal(covariance[:2, :2], 0.5 * float(state.covariance[0, 0] + state.covariance[1, 1]))
    return dataclasses.replace(state, covariance=covariance)


def widened_smoothed(
    t_ns: TimesNs, keys: Sequence[KeyState], yaw_rates_radps: Sequence[float], P: Array, moments: Array
) -> Array:
    """Covariances P (N, dim, dim) of the keyframes of a batch, all of which fixes hold, with the doubt.

    `moments` (N, 4) are those of the numbers in use at the times (N,).
    """
    doubt, out = PlaceDoubt(), []
    for at_ns, key, rate, covariance, moment in zip(
        t_ns.tolist(), keys, yaw_rates_radps, P, moments, strict=True
    ):
        doubt.step(at_ns, key, rate, True)
        out.append(doubt.widened(covariance, key.rotation, moment))
    return np.array(out)
