"""Whitened rows of one keyframe of the chain, at its linearisation point.

The last column of rows is the right-hand side; rows over two keyframes have the older one's columns first.
"""

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph import gnss_factor, velocity_factor
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.key_state import DIM, IMU_ROTATION, NAV, POSE, skew
from terrafusion.fusion.graph.node import Node
from terrafusion.fusion.graph.variables import VARIABLES
from terrafusion.fusion.graph.wheel_factor import linearised

WHEEL_ROWS = 4
_PLACES = np.arange(DIM - NAV.stop)
_IN_TIME_ORDER = np.r_[0:9, 18:24, 9:18, 24:31]
"""Columns of a `CombinedImuFactor`, keyframe by keyframe."""


def own_rows(node: Node, k: int, values: gtsam.Values, further: int = 0, width: int = 1) -> Array:
    """Prior and rows over keyframe k alone, shape (m + `further`, `width` dim + 1), the last ones free."""
    dim = len(node.delta)
    blocks = [node.prior, *measured_rows(node, k, values)]
    rows = np.zeros((sum(map(len, blocks)) + further, width * dim + 1), order="F")
    begin = 0
    for block in blocks:
        end = begin + len(block)
        rows[begin:end, :dim], rows[begin:end, -1] = block[:, :dim], block[:, dim]
        begin = end
    return rows


def measured_rows(node: Node, k: int, values: gtsam.Values) -> list[Array]:
    """Rows (m, dim + 1) of the factors that touch keyframe k alone."""
    made_of = node.point, node.unary, node.unary.size(), *node.fixes, *node.velocities
    return node.own_rows.of(made_of, lambda: _measured_rows(node, k, values))


def _measured_rows(node: Node, k: int, values: gtsam.Values) -> list[Array]:
    dim = len(node.delta)
    blocks = [_gtsam_rows(node, k, values)] if node.unary.size() else []
    blocks += [gnss_factor.rows(fix, node.point, dim) for fix in node.fixes]
    blocks += [velocity_factor.rows(velocity, node.point, dim) for velocity in node.velocities]
    return blocks


def _gtsam_rows(node: Node, k: int, values: gtsam.Values) -> Array:
    dim, keys = len(node.delta), set(node.unary.keyVector())
    touched = [(symbol(k), place) for symbol, place in VARIABLES if symbol(k) in keys]
    ordering = gtsam.Ordering()
    for key, _ in touched:
        ordering.push_back(key)
    packed = node.unary.linearize(values).augmentedJacobian(ordering)
    rows = np.zeros((len(packed), dim + 1))
    columns = np.concatenate([np.arange(dim)[place] for _, place in touched])
    rows[:, [*columns, dim]] = packed
    return rows


def link_rows(before: Node, node: Node, k: int, values: gtsam.Values) -> Array:
    """Rows (m, 2 dim + 1) of all that links keyframe k - 1, `before`, and keyframe k."""
    made_of = before.point, node.point, node.link, node.link.size(), node.markov, node.wheels
    return node.link_rows.of(made_of, lambda: _link_rows(before, node, k, values))


def _link_rows(before: Node, node: Node, k: int, values: gtsam.Values) -> Array:
    dim, packed = len(node.delta), linearised_link(node, k, values)
    n, linear = len(packed), dim - NAV.stop
    rows = np.zeros((n + linear + WHEEL_ROWS, 2 * dim + 1), order="F")
    _fill_navigation(rows[:n], packed, before, node)
    if node.markov is not None:
        fill_markov(rows[n : n + linear], node.markov, before.point.linear, node.point.linear)
    if node.wheels is not None:
        fill_wheels(rows[n + linear :], linearised(before.point, node.point, node.wheels), node.wheels.sigma)
    return rows


def fill_markov(rows: Array, step: MarkovStep, before: Array, now: Array) -> None:
    """Fill rows (..., states, 2 dim + 1) with a step of the linear states, (..., 15) before and now."""
    n, dim = rows.shape[-2], rows.shape[-1] // 2
    i, sigma = _PLACES[:n], step.sigma[..., :n]
    rows[..., i, NAV.stop + i] = -step.decay[..., :n] / sigma
    rows[..., i, dim + NAV.stop + i] = 1.0 / sigma
    rows[..., -1] = -step.residual(before, now)[..., :n] / sigma


def fill_wheels(rows: Array, linearised_at: tuple[Array, Array, Array, Array], sigma: Array) -> None:
    """Fill rows (..., 4, 2 dim + 1) with wheel factors of 1 sigma (..., 4), as `linearised` gives them."""
    (left, H_i, H_j, H_linear), dim = linearised_at, rows.shape[-1] // 2
    wide = sigma[..., None]
    rows[..., POSE], rows[..., dim : dim + POSE.stop] = H_i / wide, H_j / wide
    rows[..., dim + NAV.stop : -1] = H_linear[..., : dim - NAV.stop] / wide
    rows[..., -1] = -left / sigma


def linearised_link(node: Node, k: int, values: gtsam.Values) -> Array:
    """Rows (n, 31) of GTSAM's link over X, V and B of keyframe k - 1, then of k."""
    link = node.link
    if link.size() == 1 and node.preintegrated:  # over X, V, X, V, B, B
        return np.asarray(link.at(0).linearize(values).augmentedJacobian()[:, _IN_TIME_ORDER])
    ordering = gtsam.Ordering()
    for i in (k - 1, k):
        for symbol, _ in VARIABLES:
            ordering.push_back(symbol(i))
    return np.asarray(link.linearize(values).augmentedJacobian(ordering))


def _fill_navigation(rows: Array, packed: Array, before: Node, node: Node) -> None:
    dim = len(node.delta)
    rows[:, NAV], rows[:, dim : dim + NAV.stop] = packed[:, :15], packed[:, 15:30]
    rows[:, 2 * dim] = packed[:, 30]
    if node.preintegrated and dim > IMU_ROTATION.start:
        # The bias walk enters with opposite signs at both ends: their sum is what preintegration does
        # with a bias, and a small rotation d of the IMU acts as the bias -d x measured.
        by_bias = packed[:, 9:15] + packed[:, 24:30]
        turn = by_bias[:, :3] @ skew(node.accel_mps2) + by_bias[:, 3:] @ skew(node.gyro_radps)
        rows[:, IMU_ROTATION] = turn
        rows[:, 2 * dim] -= turn @ before.point.of(IMU_ROTATION)


def carried_prior(rows: Array, offset: Array) -> Array:
    """Rows (m, dim + 1) of a prior at a state that lies `offset` (`KeyState.local`) from their own."""
    dim = rows.shape[1] - 1
    out = rows.copy()
    out[:, dim] -= rows[:, :dim] @ offset[:dim]
    turn, place = slice(0, 3), slice(3, 6)
    out[:, turn] = rows[:, turn] @ gtsam.Rot3.LogmapDerivative(offset[turn])
    out[:, place] = rows[:, place] @ gtsam.Rot3.Expmap(offset[turn]).matrix()
    return out
