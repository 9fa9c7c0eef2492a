"""Whitened rows of many keyframes at once, for `batch`.

Rows of keyframe k are those of `Chain`: over k and k + 1, shape (m, 2 dim + 1), the last column being the
right-hand side. They lie in a block (n, m, 2 dim + 1): room for the prior (dim rows, left free), the
linear states' steps, the wheels (4), then whatever else a keyframe has.

Fixes and velocities repeat `Chain`'s on arrays: one product of 3 x 3 has other bits than many, and is faster.
tests/fusion/graph/test_batch.py compares both on random states.
"""

import functools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import (
    ANTENNA,
    BIAS,
    DRIFT,
    GNSS_DELAY,
    IMU_ROTATION,
    LINEAR,
    NAV,
    VELOCITY,
    among_linear,
)
from terrafusion.fusion.graph.keyframe_rows import fill_markov, fill_wheels
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.graph.variables import VARIABLES
from terrafusion.fusion.graph.velocity_factor import GnssVelocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement, linearised_steps

Places = NDArray[np.intp]
T = TypeVar("T")

_PLACES = {gtsam.Symbol(symbol(0)).chr(): place for symbol, place in VARIABLES}


@dataclass(frozen=True, eq=False)
class _Group:
    """Factors of GTSAM over the same states: indices in the graph, keyframes, first rows, rows per factor."""

    columns: Places
    factors: list[int]
    keyframes: Places
    first_row: Places
    height: int


class RowBlock:
    """The factors of the keyframes `begin` to `end - 1` and of their links to the keyframe after each."""

    def __init__(self, nodes: list[Node], first: int, begin: int, end: int) -> None:
        """`nodes` are all keyframes of the chain, from `first` on."""
        self.begin, self.end, self.dim = begin, end, len(nodes[0].delta)
        self._at = slice(begin - first, end - first)
        own = nodes[self._at]
        after = nodes[self._at.start + 1 : self._at.stop + 1]
        self._linked = len(after)
        self._markov = _Markov([node.markov for node in after])
        self._wheels = _Wheels([node.wheels for node in after])
        used = np.full(len(own), self.dim + (self.dim - NAV.stop) + 4)
        self._fixes = _Fixes([node.fixes for node in own], used)
        self._velocities = _Velocities([node.velocities for node in own], used)
        self._graph = gtsam.NonlinearFactorGraph()
        self._groups = self._grouped([node.unary for node in own], [node.link for node in after], used)
        # A small rotation of the IMU acts on what is preintegrated only.
        shape = (self._linked, 1)
        is_imu = np.array([node.preintegrated for node in after], dtype=float).reshape(shape)
        self._gyro = np.array([node.gyro_radps for node in after]).reshape(-1, 3) * is_imu
        self._accel = np.array([node.accel_mps2 for node in after]).reshape(-1, 3) * is_imu
        self._counts = np.maximum(used, 2 * self.dim + 1).tolist()

    def rows(
        self, values: gtsam.Values, linear: Array, poses: Array | None = None
    ) -> tuple[Array, list[int]]:
        """All rows, and their number per keyframe.

        Args:
            values: poses, velocities and biases at which to linearise, of all keyframes of the chain.
            linear: (n, 15) their linear states.
            poses: `extractPose3` of `values`, where the caller has it.
        """
        poses = gtsam.utilities.extractPose3(values) if poses is None else poses
        R, p = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:]
        rows = np.zeros((self.end - self.begin, max(self._counts), 2 * self.dim + 1))
        n, states = self._linked, self.dim - NAV.stop
        own, after = slice(self._at.start, self._at.start + n), slice(self._at.start + 1, self._at.stop + 1)
        if n:
            self._markov.fill(rows[:n, self.dim : self.dim + states], linear[own], linear[after])
            wheels = rows[:n, self.dim + states : self.dim + states + 4]
            self._wheels.fill(wheels, R[own], p[own], R[after], p[after], linear[after])
        self._fixes.fill(rows, R[self._at], p[self._at], linear[self._at])
        self._velocities.fill(rows, values, self.begin, R[self._at], linear[self._at])
        self._fill_graph(rows, values, linear[own])
        return rows, self._counts

    def _grouped(
        self, unary: list[gtsam.NonlinearFactorGraph], links: list[gtsam.NonlinearFactorGraph], used: Places
    ) -> list[_Group]:
        found: dict[tuple[tuple[int, ...], int], list[tuple[int, int, int]]] = defaultdict(list)
        count, rows = 0, used.tolist()
        for graphs in (links, unary):
            for i, graph in enumerate(graphs):
                for j in range(graph.size()):
                    factor = graph.at(j)
                    height = factor.dim()
                    key = (_columns(factor.keys(), self.begin + i, self.dim), height)
                    found[key].append((count, i, rows[i]))
                    self._graph.add(factor)
                    count += 1
                    rows[i] += height
        used[:] = rows
        groups = []
        for (columns, height), members in found.items():
            index, keyframes, first_row = zip(*members, strict=True)
            groups.append(
                _Group(np.array(columns), list(index), np.array(keyframes), np.array(first_row), height)
            )
        return groups

    def _fill_graph(self, rows: Array, values: gtsam.Values, linear: Array) -> None:
        linearised = self._graph.linearize(values)
        for group in self._groups:
            packed = np.array([linearised.at(i).augmentedJacobian() for i in group.factors])
            place = group.first_row[:, None] + np.arange(group.height)
            rows[group.keyframes[:, None, None], place[:, :, None], group.columns] = packed
            if self.dim > IMU_ROTATION.start and len(group.columns) == 2 * NAV.stop + 1:
                self._add_rotation(rows, group, place, linear)

    def _add_rotation(self, rows: Array, group: _Group, place: Places, linear: Array) -> None:
        """Rotation of the IMU, as in `Chain`: a small d acts as the bias -d x measured."""
        at, dim = group.keyframes, self.dim
        own = rows[at[:, None], place]
        by_bias = own[:, :, BIAS] + own[:, :, BIAS.start + dim : BIAS.stop + dim]
        measured = np.hstack([self._accel[at], self._gyro[at]])[:, None, :]
        # row @ skew(m) = row x m
        turn = np.cross(by_bias[:, :, :3], measured[:, :, :3]) + np.cross(
            by_bias[:, :, 3:], measured[:, :, 3:]
        )
        rows[at[:, None, None], place[:, :, None], np.arange(IMU_ROTATION.start, IMU_ROTATION.stop)] = turn
        d = linear[at][:, among_linear(IMU_ROTATION)]
        rows[at[:, None], place, -1] -= np.einsum("kri,ki->kr", turn, d)


def _columns(keys: Sequence[int], k: int, dim: int) -> tuple[int, ...]:
    """The columns of a factor's states in the rows of keyframe k, the right-hand side last."""
    return _places_of(tuple([key - k for key in keys]), dim)


@functools.lru_cache(maxsize=256)
def _places_of(keys: tuple[int, ...], dim: int) -> tuple[int, ...]:
    """`_columns` by the keys less the keyframe's index, which an index after a key's letter makes small."""
    columns: list[int] = []
    for symbol in map(gtsam.Symbol, keys):
        place, shift = _PLACES[symbol.chr()], symbol.index() * dim
        columns.extend(range(place.start + shift, place.stop + shift))
    return (*columns, 2 * dim)


class _Markov:
    """Steps of the linear states."""

    def __init__(self, steps: list[MarkovStep | None]) -> None:
        known = [step for step in steps if step is not None]
        self._at = np.array([step is not None for step in steps], dtype=bool)
        self._steps = MarkovStep(
            *(
                np.array([getattr(step, name) for step in known]).reshape(-1, len(LINEAR))
                for name in ("decay", "mean", "sigma")
            )
        )

    def fill(self, rows: Array, before: Array, now: Array) -> None:
        """Rows (n, states, 2 dim + 1)."""
        own = np.zeros((len(self._steps.decay), *rows.shape[1:]))
        fill_markov(own, self._steps, before[self._at], now[self._at])
        rows[self._at] = own


class _Wheels:
    """`wheel_factor.linearised` of many increments."""

    def __init__(self, increments: list[WheelIncrement | None]) -> None:
        known = [w for w in increments if w is not None]
        self._at = np.array([w is not None for w in increments], dtype=bool)
        moved_m = np.array([w.displacement_m for w in known]).reshape(-1, 3).T
        sigma = np.array([w.sigma for w in known]).reshape(-1, 4).T
        names = ("distance_m", "turn_rad", "yaw_rad", "speed_change_mps", "surge_m")
        numbers: list[Any] = [np.array([getattr(w, name) for w in known], dtype=float) for name in names]
        self._increments = WheelIncrement(moved_m, sigma, *numbers)

    def fill(self, rows: Array, R_i: Array, p_i: Array, R_j: Array, p_j: Array, linear: Array) -> None:
        """Rows (n, 4, 2 dim + 1)."""
        at, increments = self._at, self._increments
        R = R_i[at].transpose(0, 2, 1)
        moved, T = np.einsum("kij,kj->ki", R, p_j[at] - p_i[at]), R @ R_j[at]
        left, *by_states = linearised_steps(moved.T, T.transpose(1, 2, 0), linear[at].T, increments)
        by_before, by_now, by_linear = (H.transpose(2, 0, 1) for H in by_states)
        own = np.zeros((len(moved), *rows.shape[1:]))
        fill_wheels(own, (left.T, by_before, by_now, by_linear), increments.sigma.T)
        rows[at] = own


def _first_rows(measurements: list[list[T]], used: Places) -> tuple[list[T], Places, Places]:
    """Measurements of three rows each: all, their keyframes, their first rows; `used` moves on."""
    keyframes: list[int] = []
    first_row: list[int] = []
    for i, here in enumerate(measurements):
        for _ in here:
            keyframes.append(i)
            first_row.append(int(used[i]))
            used[i] += 3
    flat = [one for here in measurements for one in here]
    return flat, np.array(keyframes, dtype=np.intp), np.array(first_row, dtype=np.intp)


class _Fixes:
    """`gnss_factor.linearised` of many fixes."""

    def __init__(self, fixes: list[list[GnssPosition]], used: Places) -> None:
        flat, self._at, self._row = _first_rows(fixes, used)
        self._enu, self._lever, self._sigma, self._velocity = (
            np.array([getattr(fix, name) for fix in flat]).reshape(-1, 3)
            for name in ("enu_m", "lever_m", "sigma_m", "velocity_mps")
        )
        self._share, self._allowed = (
            np.array([getattr(fix, name) for fix in flat]) for name in ("drift_share", "delay_s")
        )

    def fill(self, rows: Array, R: Array, p: Array, linear: Array) -> None:
        """Into rows (n, m, 2 dim + 1)."""
        at, dim = self._at, (rows.shape[2] - 1) // 2
        R, x = R[at], linear[at]
        drift, antenna = among_linear(DRIFT), among_linear(ANTENNA)
        delay = GNSS_DELAY - NAV.stop
        lever = self._lever.copy()
        lever[:, :2] += x[:, antenna]
        H = np.zeros((len(at), 3, 6 + x.shape[1] + 1))
        H[:, :, :3] = np.cross(R, lever[:, None, :]) * -1.0  # -R skew(l), row by row
        H[:, :, 3:6] = R
        states = H[:, :, 6:-1]
        states[:, 0, drift.start] = states[:, 1, drift.start + 1] = self._share
        states[:, :, antenna] = R[:, :, :2]
        states[:, :, delay] = -self._velocity
        late = (x[:, delay] - self._allowed)[:, None]
        right = self._enu - p[at] - np.einsum("kij,kj->ki", R, lever) + late * self._velocity
        right[:, :2] -= self._share[:, None] * x[:, drift]
        H[:, :, -1] = right
        H /= self._sigma[:, :, None]
        place = (self._row[:, None] + np.arange(3))[:, :, None]
        pick = np.r_[0:6, 6 : 6 + dim - NAV.stop, H.shape[2] - 1]
        columns = np.r_[0:6, NAV.stop : dim, 2 * dim]
        rows[at[:, None, None], place, columns] = H[:, :, pick]


class _Velocities:
    """`velocity_factor.linearised` of many velocities."""

    def __init__(self, measurements: list[list[GnssVelocity]], used: Places) -> None:
        flat, self._at, self._row = _first_rows(measurements, used)
        self._velocity, self._lever = (
            np.array([getattr(one, name) for one in flat]).reshape(-1, 3)
            for name in ("velocity_mps", "lever_m")
        )
        self._by_lever = np.array([one.velocity_by_lever for one in flat]).reshape(-1, 3, 3)
        self._sigma = np.array([one.sigma_mps for one in flat]).reshape(-1, 3, 1)

    def fill(self, rows: Array, values: gtsam.Values, begin: int, R: Array, linear: Array) -> None:
        """Into rows (n, m, 2 dim + 1) of the keyframes from `begin` on."""
        if not len(self._at):
            return
        at, dim = self._at, (rows.shape[2] - 1) // 2
        R, antenna = R[at], among_linear(ANTENNA)
        lever = self._lever.copy()
        lever[:, :2] += linear[at][:, antenna]
        lever_velocity = np.einsum("kij,kj->ki", self._by_lever, lever)
        velocity = np.array([values.atVector(V(begin + int(i))) for i in at])
        H = np.zeros((len(at), 3, dim + 1))
        H[:, :, :3] = np.cross(R, lever_velocity[:, None, :]) * -1.0  # -R skew(s), row by row
        H[:, :, VELOCITY] = np.eye(3)
        if dim >= ANTENNA.stop:
            H[:, :, ANTENNA] = (R @ self._by_lever)[:, :, :2]
        H[:, :, -1] = self._velocity - velocity - np.einsum("kij,kj->ki", R, lever_velocity)
        place = (self._row[:, None] + np.arange(3))[:, :, None]
        rows[at[:, None, None], place, np.r_[0:dim, 2 * dim]] = H / self._sigma
