"""What one drive says of the numbers, its nodes eliminated: normal equations in slices of bounded work.

The nodes of a drive follow each other, so that their normal equations are block-tridiagonal, with the numbers
as a border. They are assembled a few nodes at a time and factored as a band.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import LEAST_STEP_S, Complex, MotionSegment, Path, dead_reckoned
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    GNSS_DELAY,
    GYRO_BIAS,
    NUMBERS,
    WHEEL_SCALE,
    feigned_by_slip,
)
from terrafusion.fusion.calibration.slip import SlipMoments

Places = NDArray[np.intp]

X, Y, YAW, RATIO, DRIFT_E, DRIFT_N, BIAS = range(7)
NODE, SHARED = 7, len(NUMBERS)
LINK_SHARE, LINK_M = 0.01, 0.02
"""Error of a link's position: a share of its distance, and a constant."""
FIRST_BIAS_RADPS, LEAST_BIAS_WALK = 1e-6, 1e-7
"""1 sigma of the first node's bias about the number, and of its walk without a gyro, rad/s/sqrt(s): none."""
CAUCHY_SQUARE = 6.0
"""Squared normalised residual of a fix (two axes) at which it counts half: 95 % of good ones are below."""
MOST_SHARED = 0.95
"""Largest correlation of successive residuals that is allowed for (assumed)."""
SLICE_SAMPLES, SLICE_FIXES = 400, 200
"""Samples and fixes of a slice at most, but one node at least: they bound its computing time."""
_ROW, _COLUMN = np.meshgrid(np.arange(NODE), np.arange(NODE), indexing="ij")
_LOWER = _ROW >= _COLUMN


@dataclass(frozen=True)
class Noise:
    """Noise of the smoother.

    Attributes:
        yaw_density_radps: white noise of the turn's source, rad/s/sqrt(Hz); turn_share: of a turn.
        drift_share: drifting share of a fix's variance; drift_time_s: its correlation time.
        bias_walk_radps: random walk of the gyro's bias, rad/s/sqrt(s); 0 without a gyro.
        skids: whether wheels or tracks skid in every turn.
    """

    yaw_density_radps: float
    turn_share: float
    drift_share: float
    drift_time_s: float
    bias_walk_radps: float = 0.0
    skids: bool = False


@dataclass(eq=False)
class Nodes:
    """A drive and the estimates of its nodes: (M, 7) as `X` ... `BIAS`, the last about the number."""

    drive: MotionSegment
    state: Array


@dataclass(eq=False)
class Reduction:
    """A drive's information about the numbers, which `advance` assembles, and how its nodes follow them.

    Attributes:
        part: the drive; its nodes move with `apply`.
        numbers, spread, noise: about which all is linearised.
        fixes, interval, node: the fixes inside the drive, the sample before each, its node.
        rows, left: of the fixes, (F, 2, 16) and (F, 2), whitened without the robust weight.
        diagonal, below, border, own: normal equations of the nodes: blocks (M, 7, 7) of each and of it with
            the one after; (M, 7, 9) with the numbers; right-hand side (M, 7).
        information, right: of the numbers, (9, 9) and (9,); without the nodes once all is done.
        factor: Cholesky factor (14, 7 M) of the nodes' band.
        done_nodes, done_fixes: how many are assembled.
        misfit: variance of the fixes' residuals, by their median, over that of their white noise; at least 1.
    """

    part: Nodes
    numbers: Array
    spread: float
    noise: Noise
    fixes: Places
    interval: Places
    node: Places
    rows: Array
    left: Array
    diagonal: Array
    below: Array
    border: Array
    own: Array
    information: Array = field(default_factory=lambda: np.zeros((SHARED, SHARED)))
    right: Array = field(default_factory=lambda: np.zeros(SHARED))
    factor: Array | None = None
    done_nodes: int = 0
    done_fixes: int = 0
    misfit: float = 1.0

    @classmethod
    def of(cls, part: Nodes, numbers: Array, spread: float, noise: Noise) -> Self:
        """Nothing assembled yet."""
        drive = part.drive
        at_s = drive.fix_t_s - numbers[GNSS_DELAY]
        fixes = np.flatnonzero((at_s > drive.t_s[0]) & (at_s < drive.t_s[-1]))
        interval = np.clip(np.searchsorted(drive.t_s, at_s[fixes]) - 1, 0, len(drive.t_s) - 2)
        order = np.argsort(interval, kind="stable")
        fixes, interval = fixes[order], interval[order]
        node = np.searchsorted(drive.first, interval, side="right") - 1
        n, count = len(drive.first), len(fixes)
        return cls(
            part, numbers, spread, noise, fixes, interval, node,
            np.zeros((count, 2, NODE + SHARED)), np.zeros((count, 2)),
            np.zeros((n, NODE, NODE)), np.zeros((n, NODE, NODE)), np.zeros((n, NODE, SHARED)),
            np.zeros((n, NODE)),
        )  # fmt: skip

    def advance(self) -> bool:
        """One slice; True when all is done.

        Raises:
            LinAlgError: the drive determines no path.
        """
        if self.done_nodes < len(self.own):
            self._assemble_links()
        elif self.done_fixes < len(self.fixes):
            self._assemble_fixes()
        else:
            self._eliminate()
            return True
        return False

    def without_feigned(self) -> tuple[Array, Array]:
        """Information (9, 9) and right-hand side (9,) with the changes that slip feigns as unknowns."""
        if not self.noise.skids:
            return self.information, self.right
        changes = feigned_by_slip(_one_sided(self.part.drive))
        across = self.information @ changes
        gain = across @ np.linalg.inv(np.eye(changes.shape[1]) + changes.T @ across)
        return self.information - gain @ across.T, self.right - gain @ (changes.T @ self.right)

    def apply(self, step: Array, numbers: Array) -> SlipMoments:
        """Move the nodes by the step of the numbers; moments of the ratios about the wheel scale."""
        part, n = self.part, self.own.size
        moved = self._solved((self.own - self.border @ step).reshape(n))
        part.state = part.state + moved.reshape(-1, NODE)
        drive = part.drive
        rolled = np.concatenate([[0.0], np.cumsum(np.abs(drive.distance_m))])[[*drive.first.tolist(), -1]]
        driving = np.flatnonzero(np.diff(rolled) > 1.0)
        unit = np.zeros((n, len(driving)), order="F")
        unit[driving * NODE + RATIO, np.arange(len(driving))] = 1.0
        covariance = self._solved(unit)[driving * NODE + RATIO]
        off, variance = part.state[driving, RATIO] - numbers[WHEEL_SCALE], np.diag(covariance)
        begin = np.flatnonzero(np.diff(driving) == 1)
        known = np.clip(1.0 - variance / self.spread**2, 0.0, 1.0)
        known = known[begin] * known[begin + 1]
        return SlipMoments(
            nodes=len(driving),
            squares=float((off**2 + variance).sum()),
            products=float((off[begin] * off[begin + 1] + covariance[begin, begin + 1]).sum()),
            known=float(known.sum()),
            apart_s=float(known @ np.diff(drive.t_s[drive.first])[driving[begin]]),
        )

    def _assemble_links(self) -> None:
        drive, begin = self.part.drive, self.done_nodes
        first, most = drive.first, len(drive.first)
        end = int(np.searchsorted(first, first[begin] + SLICE_SAMPLES, side="right")) - 1
        end = most if begin + 1 >= most else min(max(end, begin + 1), most)
        last = int(first[end]) if end < most else len(drive.t_s) - 1
        path = dead_reckoned(drive, self.numbers, int(first[begin]), last)
        chosen = slice(*np.searchsorted(self.node, [begin, end]).tolist())
        self.rows[chosen], self.left[chosen] = self._fix_rows(path, int(first[begin]), chosen)
        for rows, left, node, place in self._link_rows(path, begin, end):
            self._add(rows, left, node, place)
        self.done_nodes = end

    def _assemble_fixes(self) -> None:
        square = np.einsum("fr,fr->f", self.left, self.left)
        scatter = float(np.median(square)) / 1.386
        self.misfit, usual = max(1.0, scatter), max(1.0, scatter * _inflation(self.left))
        chosen = slice(self.done_fixes, self.done_fixes + SLICE_FIXES)
        weight = np.sqrt(1.0 / (1.0 + square[chosen] / (CAUCHY_SQUARE * usual)) / usual)
        rows, left = self.rows[chosen] * weight[:, None, None], self.left[chosen] * weight[:, None]
        self._add(rows, left, self.node[chosen], 1)
        self.done_fixes += len(rows)

    def _add(self, rows: Array, left: Array, node: Places, nodes: int) -> None:
        """Add whitened rows (m, r, 7 nodes + 9), residuals (m, r), over 1 or 2 nodes from `node` (m,) on."""
        if not len(rows):
            return
        across = rows.transpose(0, 2, 1)
        H, g = across @ rows, -(across @ left[:, :, None])[:, :, 0]
        at = np.flatnonzero(np.diff(node, prepend=-1))  # rows are in the order of their nodes
        here = node[at]
        H, g = np.add.reduceat(H, at, axis=0), np.add.reduceat(g, at, axis=0)
        numbers = slice(NODE * nodes, None)
        for i in range(nodes):
            block = slice(NODE * i, NODE * (i + 1))
            self.diagonal[here + i] += H[:, block, block]
            self.border[here + i] += H[:, block, numbers]
            self.own[here + i] += g[:, block]
        if nodes == 2:
            self.below[here] += H[:, NODE : 2 * NODE, :NODE]
        self.information += H[:, numbers, numbers].sum(axis=0)
        self.right += g[:, numbers].sum(axis=0)

    def _eliminate(self) -> None:
        n = self.own.size
        band = np.zeros((2 * NODE, n), order="F")
        start = NODE * np.arange(len(self.own))[:, None, None]
        row, column = np.broadcast_arrays(_ROW - _COLUMN, start + _COLUMN)
        within = np.broadcast_to(_LOWER, self.diagonal.shape)
        band[row[within], column[within]] = self.diagonal[within]
        band[row[:-1] + NODE, column[:-1]] = self.below[:-1]
        band[0] += 1e-12
        self.factor = linalg.cholesky_banded(band, lower=True, overwrite_ab=True)
        border, own = self.border.reshape(n, SHARED), self.own.reshape(n)
        back = self._solved(np.column_stack([border, own]))
        self.information = self.information - border.T @ back[:, :-1]
        self.right = self.right - border.T @ back[:, -1]

    def _solved(self, right: Array) -> Array:
        return np.asarray(linalg.cho_solve_banded((self.factor, True), right, check_finite=False))

    def _fix_rows(self, path: Path, begin: int, chosen: slice) -> tuple[Array, Array]:
        """Rows (m, 2, 16) and residuals (m, 2) of fixes, by a path from sample `begin` on."""
        drive, numbers, node, j = self.part.drive, self.numbers, self.node[chosen], self.interval[chosen]
        at_s = drive.fix_t_s[self.fixes[chosen]] - numbers[GNSS_DELAY]
        dt = drive.t_s[j + 1] - drive.t_s[j]
        share = (at_s - drive.t_s[j]) / dt
        j, start = j - begin, drive.first[node] - begin
        between = lambda x: x[j] + share.reshape(-1, *[1] * (x.ndim - 1)) * (x[j + 1] - x[j])  # noqa: E731
        own = self.part.state[node]
        leg = _legs(path, start, between, own[:, BIAS])
        rate = (path.yaw_rad[j + 1] - path.yaw_rad[j]) / dt
        velocity = (path.z[j + 1] - path.z[j]) / dt * np.exp(-1j * path.yaw_rad[start])
        heading, ratio = np.exp(1j * own[:, YAW]), 1.0 + own[:, RATIO]
        antenna = drive.antenna_m + complex(numbers[ANTENNA_X], numbers[ANTENNA_Y])
        turned = np.exp(1j * leg.yaw)
        lever = antenna * turned
        arm = ratio * leg.z + lever
        drift = own[:, DRIFT_E] + 1j * own[:, DRIFT_N]
        error = own[:, X] + 1j * own[:, Y] + heading * arm + drift - drive.fix[self.fixes[chosen]]
        by = np.zeros((len(node), NODE + SHARED), dtype=complex)
        by[:, X], by[:, Y], by[:, DRIFT_E], by[:, DRIFT_N] = 1.0, 1j, 1.0, 1j
        by[:, YAW], by[:, RATIO] = 1j * heading * arm, heading * leg.z
        shared = by[:, NODE:]
        shared[:] = heading[:, None] * (ratio[:, None] * leg.z_by + 1j * lever[:, None] * leg.yaw_by)
        by[:, BIAS] = shared[:, GYRO_BIAS]
        shared[:, ANTENNA_X] = heading * turned
        shared[:, ANTENNA_Y] = 1j * shared[:, ANTENNA_X]
        shared[:, GNSS_DELAY] = -heading * (ratio * velocity + 1j * lever * rate)
        white = drive.fix_sigma_m[self.fixes[chosen]] * np.sqrt(1.0 - self.noise.drift_share)
        rows = np.stack([by.real, by.imag], axis=1) / white[:, None, None]
        return rows, np.stack([error.real, error.imag], axis=1) / white[:, None]

    def _link_rows(self, path: Path, begin: int, end: int) -> list[tuple[Array, Array, Places, int]]:
        """Rows of the nodes `begin` to `end`: motion and drift to the next, the ratio and the first drift;
        residuals, nodes, and how many nodes they are over.
        """
        drive, noise, first = self.part.drive, self.noise, self.part.drive.first
        here = np.arange(begin, min(end, len(first) - 1))
        now, then = self.part.state[here], self.part.state[here + 1]
        after = first[here + 1] - first[begin]
        leg = _legs(path, first[here] - first[begin], lambda x: x[after], now[:, BIAS])
        heading, ratio = np.exp(1j * now[:, YAW]), 1.0 + now[:, RATIO]
        dt = drive.t_s[first[here + 1]] - drive.t_s[first[here]]
        moved = heading * ratio * leg.z
        error = then[:, X] + 1j * then[:, Y] - now[:, X] - 1j * now[:, Y] - moved
        by = np.zeros((len(here), 2 * NODE + SHARED), dtype=complex)
        by[:, X], by[:, Y], by[:, NODE + X], by[:, NODE + Y] = -1.0, -1j, 1.0, 1j
        by[:, YAW], by[:, RATIO] = -1j * moved, -heading * leg.z
        by[:, 2 * NODE :] = -(heading * ratio)[:, None] * leg.z_by
        by[:, BIAS] = by[:, 2 * NODE + GYRO_BIAS]
        position = 1.0 / (LINK_SHARE * np.abs(leg.z) + LINK_M)
        turned = then[:, YAW] - now[:, YAW] - leg.yaw
        by_yaw = np.zeros((len(here), 2 * NODE + SHARED))
        by_yaw[:, YAW], by_yaw[:, NODE + YAW], by_yaw[:, 2 * NODE :] = -1.0, 1.0, -leg.yaw_by
        by_yaw[:, BIAS] = -leg.yaw_by[:, GYRO_BIAS]
        angle = 1.0 / np.sqrt(noise.yaw_density_radps**2 * dt + (noise.turn_share * leg.yaw) ** 2)
        wandered = 1.0 / (np.hypot(noise.bias_walk_radps, LEAST_BIAS_WALK) * np.sqrt(dt))
        by_bias = np.zeros((len(here), 1, 2 * NODE + SHARED))
        by_bias[:, 0, BIAS], by_bias[:, 0, NODE + BIAS] = -wandered, wandered
        walked = ((then[:, BIAS] - now[:, BIAS]) * wandered)[:, None]
        decay = np.exp(-dt / noise.drift_time_s)
        sigma_m = float(np.median(drive.fix_sigma_m)) * np.sqrt(noise.drift_share) + 1e-4
        wander = 1.0 / (sigma_m * np.sqrt(1.0 - decay**2))
        by_drift = np.zeros((len(here), 2, 2 * NODE + SHARED))
        for row, place in enumerate((DRIFT_E, DRIFT_N)):
            by_drift[:, row, place], by_drift[:, row, NODE + place] = -decay * wander, wander
        drift = slice(DRIFT_E, DRIFT_N + 1)
        drifted = (then[:, drift] - decay[:, None] * now[:, drift]) * wander[:, None]
        rows = np.stack(
            [by.real * position[:, None], by.imag * position[:, None], by_yaw * angle[:, None]], axis=1
        )
        left = np.stack([error.real * position, error.imag * position, turned * angle], axis=1)
        every = np.arange(begin, end)
        alone = np.zeros((len(every), 1, NODE + SHARED))
        alone[:, 0, RATIO], alone[:, 0, NODE + WHEEL_SCALE] = 1.0 / self.spread, -1.0 / self.spread
        about = (self.part.state[every][:, [RATIO]] - self.numbers[WHEEL_SCALE]) / self.spread
        out = [
            (
                np.concatenate([rows, by_drift, by_bias], axis=1),
                np.concatenate([left, drifted, walked], axis=1),
                here,
                2,
            ),
            (alone, about, every, 1),
        ]
        if begin == 0:
            start = np.zeros((1, 3, NODE + SHARED))
            sigma = np.array([sigma_m, sigma_m, FIRST_BIAS_RADPS])
            start[0, [0, 1, 2], [DRIFT_E, DRIFT_N, BIAS]] = 1.0 / sigma
            out.append((start, self.part.state[:1, DRIFT_E:] / sigma, every[:1], 1))
        return out


def _one_sided(drive: MotionSegment) -> float:
    """Turns to the left less those to the right over all turns, by the squares of their rates."""
    squares = drive.turn_rad**2 / np.maximum(np.diff(drive.t_s), LEAST_STEP_S)
    return float(np.sum(np.sign(drive.turn_rad) * squares) / max(float(np.sum(squares)), 1e-9))


def _inflation(left: Array) -> float:
    """Factor on the variance of fixes, for residuals (F, 2) that do not scatter from one fix to the next.

    With a correlation r of successive ones, n of them determine a constant as n (1 - r) / (1 + r) independent
    ones do (Bartlett 1946, J. R. Stat. Soc. Suppl. 8).
    """
    size = np.hypot(left[:, 0], left[:, 1])
    held = left / np.maximum(size / (2.0 * np.median(size) + 1e-9), 1.0)[:, None]  # a wild fix counts less
    total = float(np.einsum("fr,fr->", held, held))
    shared = float(np.einsum("fr,fr->", held[1:], held[:-1])) / total if total > 0.0 else 0.0
    shared = min(max(shared, 0.0), MOST_SHARED)
    return (1.0 + shared) / (1.0 - shared)


@dataclass(frozen=True, eq=False)
class _Legs:
    """Position, turn and their derivatives from a node to a time after it."""

    z: Complex
    yaw: Array
    z_by: Complex
    yaw_by: Array


def _legs(path: Path, start: Places, at: Callable[[Any], Any], bias_radps: Array) -> _Legs:
    """Legs from the samples `start` of a path to where `at` takes the values of a series.

    `bias_radps` is each leg's bias about the number with which the path was dead-reckoned.
    """
    back = np.exp(-1j * path.yaw_rad[start])
    along = (at(path.z) - path.z[start]) * back
    own_by = path.yaw_by[start]
    by = (at(path.z_by) - path.z_by[start]) * back[:, None] - 1j * own_by * along[:, None]
    turned, yaw_by = at(path.yaw_rad) - path.yaw_rad[start], at(path.yaw_by) - own_by
    along = along + by[:, GYRO_BIAS] * bias_radps
    return _Legs(along, turned + yaw_by[:, GYRO_BIAS] * bias_radps, by, yaw_by)
