"""A planar extended Kalman filter with fixed weights: wheel speed, yaw rate and fixes.

State: x, y, heading, gyro bias, wheel scale. What anyone would write who wants outages bridged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.studies.opponents.protocol import Blocked, Streams

Array = NDArray[np.float64]

LONGEST_STEP_S = 5.0
HEAVY_TAIL_SIGMA = 3.0
"""A larger innovation raises the noise of its fix: an outlier counts less, none is locked out."""


@dataclass(frozen=True)
class Noise:
    """Fixed weights: noise of speed (share) and yaw rate (rad/sqrt(s), share), walks, and of fixes (m)."""

    speed_share: float = 0.05
    yaw_radpsqrts: float = 0.01
    yaw_share: float = 0.03
    bias_walk: float = 1e-4
    scale_walk: float = 1e-3
    fix_floor_m: float = 0.3
    fix_factor: float = 1.0


PLAIN = Noise()


def run(streams: Streams, blocked: Blocked, noise: Noise = PLAIN) -> tuple[Array, Array]:
    """The streams' times (N,) and positions (N, 2), without the fixes whose time is blocked."""
    t, v, w, fixes = streams.t_s, streams.v_mps, streams.w_radps, streams.fixes
    x, P = start(streams)
    out, j = np.empty((len(t), 2)), 0
    for i in range(len(t)):
        dt = t[i] - t[i - 1] if i else 0.0
        if 0.0 < dt < LONGEST_STEP_S:
            x, P = _moved(x, P, v[i], w[i], dt, noise)
        while j < len(fixes) and fixes[j, 0] <= t[i]:
            if not blocked(fixes[j, 0]):
                x, P = _corrected(x, P, fixes[j], noise)
            j += 1
        out[i] = x[:2]
    return t, out


def start(streams: Streams) -> tuple[Array, Array]:
    """State at the first fix: heading from the fixes of the first metres, less half of what was turned."""
    t, v, w, g = streams.t_s, streams.v_mps, streams.w_radps, streams.fixes
    path = np.r_[0.0, np.cumsum(np.hypot(*np.diff(g[:, 1:3], axis=0).T))]
    k = min(int(np.searchsorted(path, max(2.0, 2.0 * float(np.median(g[:, 3]))))), len(g) - 1)
    heading = np.arctan2(g[k, 2] - g[0, 2], g[k, 1] - g[0, 1])
    if np.sum(v[(t >= g[0, 0]) & (t <= g[k, 0])]) < 0.0:
        heading += np.pi
    turned = np.interp(g[k, 0], t, np.r_[0.0, np.cumsum(w[1:] * np.diff(t))])
    x = np.array([g[0, 1], g[0, 2], heading - 0.5 * turned, 0.0, 1.0])
    return x, np.diag(np.square([g[0, 3], g[0, 3], 0.5, 0.01, 0.05]))


def _moved(x: Array, P: Array, v: float, w: float, dt: float, noise: Noise) -> tuple[Array, Array]:
    cos, sin, step = np.cos(x[2]), np.sin(x[2]), v * x[4] * dt
    F = np.eye(5)
    F[0, 2], F[1, 2] = -sin * step, cos * step
    F[0, 4], F[1, 4] = cos * v * dt, sin * v * dt
    F[2, 3] = -dt
    along = (noise.speed_share * abs(v)) ** 2 + 1e-4
    turning = noise.yaw_radpsqrts**2 + (noise.yaw_share * w) ** 2
    Q = np.array([along, along, turning, noise.bias_walk**2, noise.scale_walk**2]) * dt
    moved = x + np.array([cos * step, sin * step, (w - x[3]) * dt, 0.0, 0.0])
    return moved, F @ P @ F.T + np.diag(Q)


def _corrected(x: Array, P: Array, fix: Array, noise: Noise) -> tuple[Array, Array]:
    sigma = noise.fix_factor * fix[3]
    if fix[3] > 0.1:  # RTK is believed as reported
        sigma = max(sigma, noise.fix_floor_m)
    r = fix[1:3] - x[:2]
    S = P[:2, :2] + np.eye(2) * sigma**2
    S = S + np.eye(2) * max(0.0, (r @ r) / HEAVY_TAIL_SIGMA**2 - np.trace(S) / 2.0)
    K = P[:, :2] @ np.linalg.inv(S)
    return x + K @ r, P - K @ P[:2, :]
