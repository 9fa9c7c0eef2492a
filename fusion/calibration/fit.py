"""A robot's numbers from drives with fixes: a planar smoother with a node every few seconds.

Unknown are pose, distance ratio and receiver drift of each node, and `NUMBERS`, which all nodes of all
drives share. Between nodes the path is dead reckoning with the numbers (`motion`); distance ratios spread
about the wheel scale, the receiver drifts as a Gauss-Markov process, and fixes have a robust loss (Cauchy;
iteratively reweighted, Holland and Welsch 1977, Commun. Stat. A6). Gauss-Newton; each drive is reduced to
the numbers by a Schur complement, so that the result's covariance is that of the numbers with all else
unknown. The spread of slip is estimated by expectation maximisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import Complex, Drive, Path, dead_reckoned
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    GNSS_DELAY,
    NUMBERS,
    WHEEL_SCALE,
    Knowledge,
)

X, Y, YAW, RATIO, DRIFT_E, DRIFT_N = range(6)
NODE, SHARED = 6, len(NUMBERS)
LINK_SHARE, LINK_M = 0.01, 0.02
"""Error of a link's position: a share of its distance, and a constant."""
YAW_PER_S_RAD = 2e-4
"""Error of a link's turn by a wandering bias, rad per second."""
CAUCHY_SQUARE = 6.0
"""Squared normalised residual of a fix (two axes) at which it counts half: 95 % of good ones are below."""
SPREAD_PRIOR_NODES = 3.0
"""Nodes that the assumed spread of slip counts for."""
LEAST_SPREAD = 0.005
ITERATIONS, CONVERGED = 10, 0.02
"""Gauss-Newton steps at most; done when no number moves by more than this share of its sigma."""


@dataclass(frozen=True)
class Noise:
    """Noise of the smoother.

    Attributes:
        yaw_density_radps: white noise of the turn's source, rad/s/sqrt(Hz); turn_share: of a turn.
        drift_share: drifting share of a fix's variance; drift_time_s: its correlation time.
    """

    yaw_density_radps: float
    turn_share: float
    drift_share: float
    drift_time_s: float


@dataclass(eq=False)
class Nodes:
    """A drive and the estimates of its nodes: (M, 6) as `X` ... `DRIFT_N`."""

    drive: Drive
    state: Array


def fit(
    drives: Sequence[Drive],
    starts: Sequence[tuple[complex, float]],
    before: Knowledge,
    noise: Noise,
) -> Knowledge:
    """The numbers after `drives`, each of which starts about a position (east + i north) and yaw (rad).

    Raises:
        LinAlgError: the drives determine no path.
    """
    now = before
    parts = [started(drive, *start, now.mean) for drive, start in zip(drives, starts, strict=True)]
    for i in range(ITERATIONS):
        last, now = now, refined(parts, now, before, noise)
        if i > 2 and (np.abs(now.mean - last.mean) < CONVERGED * now.sigma).all():
            break
    return now


def refined(parts: Sequence[Nodes], now: Knowledge, before: Knowledge, noise: Noise) -> Knowledge:
    """One Gauss-Newton step from the numbers `now`, with those known `before`; moves the nodes, too."""
    information = np.linalg.inv(before.covariance)
    right = information @ (before.mean - now.mean)
    reduced = [_reduced(part, now.mean, now.slip_spread, noise) for part in parts]
    for one in reduced:
        information = information + one.information
        right = right + one.right
    covariance = np.linalg.inv(information)
    step = covariance @ right
    numbers = now.mean + step
    squares = [one.apply(part, step, numbers) for part, one in zip(parts, reduced, strict=True)]
    return Knowledge(numbers, covariance, _spread(squares, before.slip_spread))


def started(drive: Drive, start: complex, yaw_rad: float, numbers: Array) -> Nodes:
    """Nodes along dead reckoning from a position (east + i north) and yaw."""
    path, first = dead_reckoned(drive, numbers), drive.first
    state = np.zeros((len(first), NODE))
    at = start + np.exp(1j * yaw_rad) * path.z[first]
    state[:, X], state[:, Y] = at.real, at.imag
    state[:, YAW], state[:, RATIO] = yaw_rad + path.yaw_rad[first], numbers[WHEEL_SCALE]
    return Nodes(drive, state)


def _spread(squares: Sequence[Array], assumed: float) -> float:
    """Standard deviation of the distance ratio, from its expected squares (n,) of each drive."""
    total = SPREAD_PRIOR_NODES * assumed**2 + sum(float(s.sum()) for s in squares)
    count = SPREAD_PRIOR_NODES + sum(len(s) for s in squares)
    return max(float(np.sqrt(total / count)), LEAST_SPREAD)


@dataclass(frozen=True, eq=False)
class _Reduced:
    """One drive's information about the numbers, and how its nodes follow them."""

    information: Array
    right: Array
    factor: tuple[Array, bool]
    border: Array
    own: Array
    driving: NDArray[np.bool_]

    def apply(self, part: Nodes, step: Array, numbers: Array) -> Array:
        """Move the nodes by the step of the numbers; expected squares (n,) of the ratios about their mean."""
        moved = linalg.cho_solve(self.factor, self.own - self.border @ step)
        part.state = part.state + moved.reshape(-1, NODE)
        ratio = np.arange(RATIO, len(self.own), NODE)[self.driving]
        unit = np.zeros((len(self.own), len(ratio)))
        unit[ratio, np.arange(len(ratio))] = 1.0
        half = linalg.solve_triangular(self.factor[0], unit, lower=True)
        variance = (half**2).sum(axis=0)
        return np.asarray((part.state[self.driving, RATIO] - numbers[WHEEL_SCALE]) ** 2 + variance)


def _reduced(part: Nodes, numbers: Array, spread: float, noise: Noise) -> _Reduced:
    drive, first = part.drive, part.drive.first
    count = len(first)
    path = dead_reckoned(drive, numbers)
    n = NODE * count
    H, g = np.zeros((n + SHARED, n + SHARED)), np.zeros(n + SHARED)
    for rows, left, columns in (
        _fix_rows(part, path, numbers, noise),
        *_link_rows(part, path, spread, noise, numbers),
    ):
        _add(H, g, rows, left, columns)
    H[np.arange(n), np.arange(n)] += 1e-12
    factor = linalg.cho_factor(H[:n, :n], lower=True)
    back = linalg.cho_solve(factor, np.column_stack([H[:n, n:], g[:n]]))
    rolled = np.concatenate([[0.0], np.cumsum(np.abs(drive.distance_m))])[[*first.tolist(), -1]]
    return _Reduced(
        H[n:, n:] - H[n:, :n] @ back[:, :-1],
        g[n:] - H[n:, :n] @ back[:, -1],
        factor,
        H[:n, n:],
        g[:n],
        np.diff(rolled) > 1.0,
    )


def _add(H: Array, g: Array, rows: Array, left: Array, columns: NDArray[np.intp]) -> None:
    """Add whitened rows (m, r, c) with residuals (m, r) over the columns (m, c) to the normal equations."""
    np.add.at(H, (columns[:, :, None], columns[:, None, :]), np.einsum("mri,mrj->mij", rows, rows))
    np.add.at(g, columns, -np.einsum("mri,mr->mi", rows, left))


def _columns(node: NDArray[np.intp], count: int, nodes: int = 1) -> NDArray[np.intp]:
    """Columns (m, 6 nodes + 7) of rows over `nodes` nodes from `node` (m,) on and the numbers."""
    own = node[:, None] * NODE + np.arange(NODE * nodes)
    shared = np.broadcast_to(NODE * count + np.arange(SHARED), (len(node), SHARED))
    return np.hstack([own, shared])


@dataclass(frozen=True, eq=False)
class _Legs:
    """Position, turn and their derivatives from a node to a time after it."""

    z: Complex
    yaw: Array
    z_by: Complex
    yaw_by: Array


def _legs(path: Path, start: NDArray[np.intp], z: Complex, yaw: Array, z_by: Complex, yaw_by: Array) -> _Legs:
    back = np.exp(-1j * path.yaw_rad[start])
    along = (z - path.z[start]) * back
    own_by = path.yaw_by[start]
    by = (z_by - path.z_by[start]) * back[:, None] - 1j * own_by * along[:, None]
    return _Legs(along, yaw - path.yaw_rad[start], by, yaw_by - own_by)


def _fix_rows(part: Nodes, path: Path, numbers: Array, noise: Noise) -> tuple[Array, Array, NDArray[np.intp]]:
    drive, state = part.drive, part.state
    first = drive.first
    at_s = drive.fix_t_s - numbers[GNSS_DELAY]
    inside = (at_s > drive.t_s[0]) & (at_s < drive.t_s[-1])
    at_s, fix, sigma = at_s[inside], drive.fix[inside], drive.fix_sigma_m[inside]
    j = np.clip(np.searchsorted(drive.t_s, at_s) - 1, 0, len(drive.t_s) - 2)
    dt = drive.t_s[j + 1] - drive.t_s[j]
    share = ((at_s - drive.t_s[j]) / dt)[:, None]
    between = lambda x: x[j] + share.reshape(-1, *[1] * (x.ndim - 1)) * (x[j + 1] - x[j])  # noqa: E731
    node = np.searchsorted(first, j, side="right") - 1
    leg = _legs(path, first[node], *(between(x) for x in (path.z, path.yaw_rad, path.z_by, path.yaw_by)))
    rate = (path.yaw_rad[j + 1] - path.yaw_rad[j]) / dt
    velocity = (path.z[j + 1] - path.z[j]) / dt * np.exp(-1j * path.yaw_rad[first[node]])
    own = state[node]
    heading, ratio = np.exp(1j * own[:, YAW]), 1.0 + own[:, RATIO]
    antenna = drive.antenna_m + complex(numbers[ANTENNA_X], numbers[ANTENNA_Y])
    lever = antenna * np.exp(1j * leg.yaw)
    arm = ratio * leg.z + lever
    error = own[:, X] + 1j * own[:, Y] + heading * arm + own[:, DRIFT_E] + 1j * own[:, DRIFT_N] - fix
    by = np.zeros((len(node), NODE + SHARED), dtype=complex)
    by[:, X], by[:, Y], by[:, DRIFT_E], by[:, DRIFT_N] = 1.0, 1j, 1.0, 1j
    by[:, YAW], by[:, RATIO] = 1j * heading * arm, heading * leg.z
    shared = by[:, NODE:]
    shared[:] = heading[:, None] * (ratio[:, None] * leg.z_by + 1j * lever[:, None] * leg.yaw_by)
    shared[:, ANTENNA_X] = heading * np.exp(1j * leg.yaw)
    shared[:, ANTENNA_Y] = 1j * shared[:, ANTENNA_X]
    shared[:, GNSS_DELAY] = -heading * (ratio * velocity + 1j * lever * rate)
    white = sigma * np.sqrt(1.0 - noise.drift_share)
    square = (np.abs(error) / white) ** 2
    usual = max(1.0, float(np.median(square)) / 1.386) if len(square) else 1.0
    weight = np.sqrt(1.0 / (1.0 + square / (CAUCHY_SQUARE * usual)) / usual) / white
    rows = np.stack([by.real, by.imag], axis=1) * weight[:, None, None]
    return rows, np.stack([error.real, error.imag], axis=1) * weight[:, None], _columns(node, len(first))


def _link_rows(
    part: Nodes, path: Path, spread: float, noise: Noise, numbers: Array
) -> list[tuple[Array, Array, NDArray[np.intp]]]:
    """Rows of motion and drift between nodes, and of the ratio and the first drift of each."""
    drive, state = part.drive, part.state
    first = drive.first
    count = len(first)
    here, after = np.arange(count - 1), first[1:]
    leg = _legs(path, first[:-1], path.z[after], path.yaw_rad[after], path.z_by[after], path.yaw_by[after])
    now, then = state[:-1], state[1:]
    heading, ratio = np.exp(1j * now[:, YAW]), 1.0 + now[:, RATIO]
    dt = np.diff(drive.t_s[first])
    moved = heading * ratio * leg.z
    error = then[:, X] + 1j * then[:, Y] - now[:, X] - 1j * now[:, Y] - moved
    by = np.zeros((count - 1, 2 * NODE + SHARED), dtype=complex)
    by[:, X], by[:, Y], by[:, NODE + X], by[:, NODE + Y] = -1.0, -1j, 1.0, 1j
    by[:, YAW], by[:, RATIO] = -1j * moved, -heading * leg.z
    by[:, 2 * NODE :] = -(heading * ratio)[:, None] * leg.z_by
    position = 1.0 / (LINK_SHARE * np.abs(leg.z) + LINK_M)
    turned = then[:, YAW] - now[:, YAW] - leg.yaw
    by_yaw = np.zeros((count - 1, 2 * NODE + SHARED))
    by_yaw[:, YAW], by_yaw[:, NODE + YAW], by_yaw[:, 2 * NODE :] = -1.0, 1.0, -leg.yaw_by
    angle = 1.0 / np.sqrt(
        noise.yaw_density_radps**2 * dt + (noise.turn_share * leg.yaw) ** 2 + (YAW_PER_S_RAD * dt) ** 2
    )
    decay = np.exp(-dt / noise.drift_time_s)
    sigma_m = float(np.median(drive.fix_sigma_m)) * np.sqrt(noise.drift_share) + 1e-4
    wander = 1.0 / (sigma_m * np.sqrt(1.0 - decay**2))
    by_drift = np.zeros((count - 1, 2, 2 * NODE + SHARED))
    for row, place in enumerate((DRIFT_E, DRIFT_N)):
        by_drift[:, row, place], by_drift[:, row, NODE + place] = -decay * wander, wander
    drifted = (then[:, DRIFT_E:] - decay[:, None] * now[:, DRIFT_E:]) * wander[:, None]
    rows = np.stack(
        [by.real * position[:, None], by.imag * position[:, None], by_yaw * angle[:, None]], axis=1
    )
    left = np.stack([error.real * position, error.imag * position, turned * angle], axis=1)
    columns = _columns(here, count, 2)
    alone = np.zeros((count, 1, NODE + SHARED))
    alone[:, 0, RATIO], alone[:, 0, NODE + WHEEL_SCALE] = 1.0 / spread, -1.0 / spread
    about = (state[:, [RATIO]] - numbers[WHEEL_SCALE]) / spread
    begin = np.zeros((1, 2, NODE + SHARED))
    begin[0, 0, DRIFT_E] = begin[0, 1, DRIFT_N] = 1.0 / sigma_m
    return [
        (np.concatenate([rows, by_drift], axis=1), np.concatenate([left, drifted], axis=1), columns),
        (alone, about, _columns(np.arange(count), count)),
        (begin, state[:1, DRIFT_E:] / sigma_m, _columns(np.zeros(1, dtype=np.intp), count)),
    ]


def information_gained(before: Knowledge, after: Knowledge) -> Array:
    """Information gained on each number (7,), nats: the logarithm of its sigma before over after."""
    return np.asarray(np.log(before.sigma / after.sigma))
