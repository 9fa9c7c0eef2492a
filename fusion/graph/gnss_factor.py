"""The GNSS factor: antenna position with a lever arm and a slow drift of the receiver.

Residual (3,), world frame, metres::

    r = p + R (lever + antenna) - (delay - allowed) v + share (drift, 0) - fix

A receiver repeats its error for tens of seconds (atmosphere, multipath). Were its fixes independent, their
average would turn the heading and the gyro bias; as a Gauss-Markov state the drift absorbs the error
instead (Groves 2013, Principles of GNSS, ch. 14.2.6). A fix of a far better class than the data sheet's
has a small `share` of the drift. `antenna` corrects the lever arm of the vehicle file, `delay` is the
lateness of the receiver's stamps while the antenna moves with v; both are states.
"""

from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.key_state import (
    ANTENNA,
    DRIFT,
    GNSS_DELAY,
    MARKOV,
    NAV,
    POSE,
    KeyState,
    among_linear,
    skew,
)

_DRIFT, _ANTENNA = among_linear(DRIFT), among_linear(ANTENNA)
_DELAY = GNSS_DELAY - NAV.stop


@dataclass(frozen=True, eq=False)
class GnssPosition:
    """A fix at a keyframe: antenna `enu_m`, `lever_m` in the body frame, white 1 `sigma_m`, each (3,).

    `velocity_mps` (3,) of the antenna in the world, `drift_share` of the receiver's drift in this fix;
    `delay_s` is the delay that `lever_m` allows for already; `weight` is that of a robust loss on the
    horizontal part, included in `sigma_m`.
    """

    enu_m: Array
    lever_m: Array
    sigma_m: Array
    drift_share: float = 1.0
    velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    weight: float = 1.0
    delay_s: float = 0.0


def rows(fix: GnssPosition, point: KeyState, dim: int) -> Array:
    """Whitened rows (3, dim + 1) at a keyframe's state, the last column being the right-hand side."""
    out = np.zeros((3, dim + 1))
    left, H_pose, H_linear = linearised(fix, point)
    out[:, POSE], out[:, NAV.stop : dim] = H_pose, H_linear[:, : dim - NAV.stop]
    out[:, dim] = -left
    return out / fix.sigma_m[:, None]


def linearised(fix: GnssPosition, at: KeyState) -> tuple[Array, Array, Array]:
    """The residual of the module's docstring, unwhitened, and its derivatives by the pose (3, 6; GTSAM
    tangent) and by the linear states (3, 15).
    """
    R, p, linear = at.rotation, at.pose.translation(), at.linear
    lever = fix.lever_m.copy()
    lever[:2] += linear[_ANTENNA]
    drift = np.zeros(3)
    drift[:2] = fix.drift_share * linear[_DRIFT]
    late_m = (linear[_DELAY] - fix.delay_s) * fix.velocity_mps
    left = p + R @ lever - late_m + drift - fix.enu_m
    H_pose, H = np.empty((3, 6)), np.zeros((3, MARKOV.stop - MARKOV.start))
    H_pose[:, :3], H_pose[:, 3:] = -R @ skew(lever), R
    H[0, _DRIFT.start] = H[1, _DRIFT.start + 1] = fix.drift_share
    H[:, _ANTENNA] = R[:, :2]
    H[:, _DELAY] = -fix.velocity_mps
    return left, H_pose, H
