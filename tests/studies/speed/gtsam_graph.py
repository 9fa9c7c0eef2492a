"""The graph of a drive in GTSAM's own optimisers, for `speed`.

`FULL` is the same graph as ours; wheels, fixes and linear states are Python `CustomFactor`s there. `NATIVE`
has C++ factors alone: the wheels as a `BetweenFactorPose3`, fixes as `GPSFactorArm`, velocities as priors, no
slip, no drift of the receiver, no yaw scale. It is the floor of what GTSAM needs, and not the same problem.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import Enum
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, M, V, X
from numpy.typing import NDArray

from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.key_state import BIAS, MARKOV, POSE, VELOCITY, KeyState
from terrafusion.fusion.graph.velocity_factor import GnssVelocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from tests import gtsam_factors

Array = NDArray[np.float64]


class Graph(Enum):
    """Which factors: see the module."""

    FULL = "same graph, Python factors"
    NATIVE = "fewer states, C++ factors"


def batch(chain: Chain, initial: list[KeyState], kind: Graph, optimiser: str) -> tuple[float, float]:
    """CPU seconds that a batch takes, and the error it ends with (nan where GTSAM gives up).

    Args:
        chain: all keyframes of a drive with their factors.
        initial: the states to start from, one for each keyframe.
        optimiser: "GaussNewton" or "LevenbergMarquardt"; both by multifrontal QR.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, state in enumerate(initial, chain.first):
        graph.push_back(factors(chain, k, kind))
        _insert(values, k, state, kind)
    params = getattr(gtsam, f"{optimiser}Params")()
    params.setLinearSolverType("MULTIFRONTAL_QR")
    run = getattr(gtsam, f"{optimiser}Optimizer")(graph, values, params)
    begun = time.process_time()
    try:
        run.optimize()
    except RuntimeError:  # an indeterminate system
        return time.process_time() - begun, float("nan")
    return time.process_time() - begun, run.error()


def fixed_lag(chain: Chain, kind: Graph, make: Callable[[float], Any], lag_s: float) -> Array:
    """CPU milliseconds of every keyframe of a fixed-lag smoother `make(lag_s)`, up to its estimate."""
    smoother = make(lag_s)
    taken = []
    for k, node in enumerate(chain.nodes, chain.first):
        graph, values = factors(chain, k, kind), gtsam.Values()
        guess = node.point
        if k > chain.first:  # the chain's prediction, carried to where this smoother is
            last = smoother.calculateEstimate()
            before = chain.nodes[k - 1 - chain.first].point
            pose = last.atPose3(X(k - 1)).compose(before.pose.between(guess.pose))
            guess = KeyState(pose, last.atVector(V(k - 1)), last.atConstantBias(B(k - 1)), guess.linear)
        _insert(values, k, guess, kind)
        times = dict.fromkeys(values.keys(), node.t_ns * 1e-9)
        begun = time.process_time()
        smoother.update(graph, values, times)
        smoother.calculateEstimate()
        taken.append((time.process_time() - begun) * 1e3)
    return np.array(taken)


def incremental(lag_s: float) -> Any:
    """GTSAM's `IncrementalFixedLagSmoother` (iSAM2) by QR, relinearising beyond 0.1."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(0.1)
    params.findUnusedFactorSlots = True
    return gtsam.IncrementalFixedLagSmoother(lag_s, params)


def batch_lag(lag_s: float) -> Any:
    """GTSAM's `BatchFixedLagSmoother`."""
    return gtsam.BatchFixedLagSmoother(lag_s)


def factors(chain: Chain, k: int, kind: Graph) -> gtsam.NonlinearFactorGraph:
    """The factors of keyframe k and of its link to the one before."""
    node, graph = chain.nodes[k - chain.first], gtsam.NonlinearFactorGraph()
    for part in (node.link, node.unary):
        graph.push_back(part)
    if k == chain.first:
        _add_prior(graph, k, node.point, 1.0 / np.diag(node.prior[:, :-1]), kind)
    if node.wheels is not None:
        graph.add(_wheels(node.wheels, k, kind))
    if node.markov is not None and kind is Graph.FULL:
        graph.add(gtsam_factors.markov_factor(node.markov, M(k - 1), M(k)))
    for fix in node.fixes:
        graph.add(_fix(fix, k, kind))
    for told in node.velocities:
        graph.add(_velocity(told, k, kind))
    return graph


def _add_prior(graph: gtsam.NonlinearFactorGraph, k: int, start: KeyState, sigma: Array, kind: Graph) -> None:
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    graph.add(gtsam.PriorFactorPose3(X(k), start.pose, diagonal(sigma[POSE])))
    graph.add(gtsam.PriorFactorVector(V(k), start.velocity, diagonal(sigma[VELOCITY])))
    graph.add(gtsam.PriorFactorConstantBias(B(k), start.bias, diagonal(sigma[BIAS])))
    if kind is Graph.FULL:
        graph.add(gtsam.PriorFactorVector(M(k), start.linear, diagonal(sigma[MARKOV])))


def _insert(values: gtsam.Values, k: int, state: KeyState, kind: Graph) -> None:
    values.insert(X(k), state.pose)
    values.insert(V(k), state.velocity)
    values.insert(B(k), state.bias)
    if kind is Graph.FULL:
        values.insert(M(k), state.linear)


def _wheels(wheels: WheelIncrement, k: int, kind: Graph) -> gtsam.NonlinearFactor:
    if kind is Graph.FULL:
        return gtsam_factors.wheel_factor_of(wheels, X(k - 1), X(k), M(k))
    moved = gtsam.Pose3(gtsam.Rot3.Rz(wheels.turn_rad), wheels.displacement_m)
    sigma = np.array([1.0, 1.0, wheels.sigma[3], *wheels.sigma[:3]])
    return gtsam.BetweenFactorPose3(X(k - 1), X(k), moved, gtsam.noiseModel.Diagonal.Sigmas(sigma))


def _fix(fix: GnssPosition, k: int, kind: Graph) -> gtsam.NonlinearFactor:
    if kind is Graph.FULL:
        return gtsam_factors.gnss_position_factor(fix, X(k), M(k))
    return gtsam.GPSFactorArm(X(k), fix.enu_m, fix.lever_m, gtsam.noiseModel.Diagonal.Sigmas(fix.sigma_m))


def _velocity(told: GnssVelocity, k: int, kind: Graph) -> gtsam.NonlinearFactor:
    if kind is Graph.FULL:
        return gtsam_factors.gnss_velocity_factor(told, X(k), V(k), M(k))
    noise = gtsam.noiseModel.Diagonal.Sigmas(told.sigma_mps)
    return gtsam.PriorFactorVector(V(k), told.velocity_mps, noise)
