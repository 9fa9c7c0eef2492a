"""Forward and sideways body velocity from noisy poses and a gyro.

The two speeds are piecewise linear between knots and fitted to the positions by penalised least squares
(Whittaker 1923; penalty on the change of acceleration) with Huber weights (1964) against outliers. The
heading is the gyro's, rotated once a chunk to the yaw of the poses: over two seconds it is better than a
lidar's.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array

KNOT_S = 0.25
"""Knot spacing of the velocity (assumed: half of the averaging time of errors)."""
CHUNK_S = 2.0
"""Positions have a free offset a chunk, which removes the drift of map and gyro."""
ACCEL_WALK = 2.0
"""Assumed random walk of the acceleration, m/s2/sqrt(s): sets the smoothing."""
MIN_SIGMA_M = 0.003
"""Smallest sigma of a pose (assumed)."""
MOVING_MPS = 0.2
HUBER, ROUNDS = 1.5, 5
"""Residual in sigma beyond which weights fall (Huber 1964), and number of reweighted fits."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses as they were logged.

    Attributes:
        t_s: (M,) times.
        xy_m: (M, 2) positions in some level frame.
        yaw_rad: (M,) headings, NaN throughout where the source has none.
        chunk: (M,) chunk numbers; every chunk may have its own origin.
    """

    t_s: Array
    xy_m: Array
    yaw_rad: Array
    chunk: NDArray[np.int64]

    def select(self, rows: NDArray[np.bool_]) -> "Poses":
        """The poses of a mask (M,)."""
        return Poses(self.t_s[rows], self.xy_m[rows], self.yaw_rad[rows], self.chunk[rows])


def heading(t_s: Array, yaw_rate_radps: Array) -> Array:
    """Heading (N,), rad, 0 at the start, by the trapezoid rule."""
    steps = 0.5 * (yaw_rate_radps[1:] + yaw_rate_radps[:-1]) * np.diff(t_s)
    return np.concatenate([[0.0], np.cumsum(steps)])


def body_velocity(t_s: Array, yaw_rate_radps: Array, poses: Poses, rolled_mps: Array) -> Array:
    """Forward and sideways speed (N, 2), m/s, at the times t_s (N,).

    Args:
        t_s: uniform times, s.
        yaw_rate_radps: (N,) of the gyro.
        poses: at least two.
        rolled_mps: (N,) mean speed of the wheels; gives the direction of a chunk if the poses have no yaw.

    The speeds are those of the point whose positions are given.
    """
    knots = np.arange(t_s[0], t_s[-1] + KNOT_S, KNOT_S)
    turned = _turned(t_s, heading(t_s, yaw_rate_radps), poses, rolled_mps)
    design = _design(t_s, heading(t_s, yaw_rate_radps), poses, knots)
    speeds = _solved(design, turned, np.interp(poses.t_s, t_s, rolled_mps), len(knots))
    return np.stack([np.interp(t_s, knots, speed) for speed in speeds], axis=1)


def _turned(t_s: Array, psi: Array, poses: Poses, rolled_mps: Array) -> Array:
    """Positions (M, 2) rotated into the frame of the gyro's heading `psi` (N,)."""
    at = np.interp(poses.t_s, t_s, psi)
    off = np.zeros(len(poses.t_s))
    if np.isfinite(poses.yaw_rad).all():
        away = poses.yaw_rad - at
    else:
        away = _track_direction(t_s, psi, poses, rolled_mps)
    for chunk in np.unique(poses.chunk):
        rows = poses.chunk == chunk
        middle = np.angle(np.exp(1j * away[rows]).mean())
        off[rows] = middle + np.median(np.angle(np.exp(1j * (away[rows] - middle))))
    plane = (poses.xy_m[:, 0] + 1j * poses.xy_m[:, 1]) * np.exp(-1j * off)
    return np.stack([plane.real, plane.imag], axis=1)


def _track_direction(t_s: Array, psi: Array, poses: Poses, rolled_mps: Array) -> Array:
    """(M,) angle from wheel odometry to the track, least squares a chunk (Procrustes)."""
    steps = rolled_mps * np.exp(1j * psi) * float(t_s[1] - t_s[0])
    walked = np.cumsum(steps)
    at = np.interp(poses.t_s, t_s, walked.real) + 1j * np.interp(poses.t_s, t_s, walked.imag)
    plane = poses.xy_m[:, 0] + 1j * poses.xy_m[:, 1]
    out = np.zeros(len(plane))
    for chunk in np.unique(poses.chunk):
        rows = poses.chunk == chunk
        a, b = at[rows] - at[rows].mean(), plane[rows] - plane[rows].mean()
        out[rows] = np.angle(np.vdot(a, b))
    return out


def _design(t_s: Array, psi: Array, poses: Poses, knots: Array) -> tuple[Any, Any]:
    """Sparse (M, 2K + C) of x and of y: integrals of the speeds from a chunk's first pose, and its origin."""
    from scipy import sparse

    dt, count, size = float(t_s[1] - t_s[0]), len(poses.t_s), len(knots)
    chunks, index = np.unique(poses.chunk, return_inverse=True)
    first = np.array([poses.t_s[poses.chunk == c].min() for c in chunks])[index]
    cells: list[tuple[Array, Array, Array, Array]] = []
    for i in range(count):
        # Midpoints of steps of about dt that fill the time from the chunk's first pose to this one.
        span = poses.t_s[i] - first[i]
        steps = max(1, int(np.ceil(span / dt)))
        at = first[i] + (np.arange(steps) + 0.5) * span / steps
        place = np.clip((at - knots[0]) / KNOT_S, 0.0, size - 1.000001)
        left = place.astype(int)
        share = place - left
        angle = np.interp(at, t_s, psi)
        k = np.concatenate([left, left + 1])
        w = np.concatenate([1.0 - share, share]) * span / steps
        two = np.concatenate([angle, angle])
        cells.append((np.full(len(k), i), k, w * np.cos(two), w * np.sin(two)))
    rows, columns, cosine, sine = (np.concatenate(part) for part in zip(*cells, strict=True))
    width = 2 * size + len(chunks)
    origin = sparse.coo_matrix((np.ones(count), (np.arange(count), 2 * size + index)), shape=(count, width))

    def matrix(u: Array, v: Array) -> Any:
        both = (np.concatenate([rows, rows]), np.concatenate([columns, columns + size]))
        body = sparse.coo_matrix((np.concatenate([u, v]), both), shape=(count, width))
        return (body + origin).tocsr()

    return matrix(cosine, -sine), matrix(sine, cosine)


def _solved(design: tuple[Any, Any], turned: Array, rolled: Array, size: int) -> Array:
    """Speeds (2, K) at the knots, by reweighted least squares; the positions' sigma is found on the way."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    ax, ay = design
    # The chunks' origins differ between x and y: two sets of unknowns.
    chunks = ax.shape[1] - 2 * size
    empty = sparse.csr_matrix((len(turned), chunks))
    A = sparse.vstack(
        [sparse.hstack([ax, empty]), sparse.hstack([ay[:, : 2 * size], empty, ay[:, 2 * size :]])]
    )
    A, b = A.tocsr(), np.concatenate([turned[:, 0], turned[:, 1]])
    bend = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(size - 2, size)) / (ACCEL_WALK * KNOT_S**1.5)
    smooth = sparse.block_diag([bend, bend])
    penalty = sparse.block_diag([smooth.T @ smooth, sparse.csr_matrix((2 * chunks, 2 * chunks))])
    # A weak prior on speeds and origins keeps spans without poses solvable.
    penalty = penalty + 1e-6 * sparse.identity(A.shape[1])
    speed = np.abs(rolled)
    sigma, weight = np.full(len(turned), 0.05), np.ones(len(turned))
    x = np.zeros(A.shape[1])
    for _ in range(ROUNDS):
        w = np.tile(weight / sigma**2, 2)
        x = spsolve((A.T @ sparse.diags(w) @ A + penalty).tocsc(), A.T @ (w * b))
        residual = b - A @ x
        off = np.hypot(residual[: len(turned)], residual[len(turned) :])
        sigma = _sigma(off, speed)
        weight = np.minimum(1.0, HUBER * sigma / np.maximum(off, 1e-12))
    return np.stack([x[:size], x[size : 2 * size]])


def _sigma(off: Array, speed: Array) -> Array:
    """(M,) sigma of the positions, m: scatter at rest, and jitter of the stamps times the speed."""
    # The median length of a 2-D Gaussian is 1.18 sigma, the median size of a 1-D one 0.67 sigma.
    slow = speed < MOVING_MPS
    if min(slow.sum(), (~slow).sum()) < 10:
        return np.full(len(off), max(float(np.median(off)) / 1.18, MIN_SIGMA_M))
    still = max(float(np.median(off[slow])) / 1.18, MIN_SIGMA_M)
    jitter_s = float(np.median(np.maximum(off[~slow] - still, 0.0) / speed[~slow])) / 0.67
    return np.sqrt(still**2 + (jitter_s * speed) ** 2)
