"""Poses, velocities and biases of keyframes as variables of GTSAM: X(k), V(k) and B(k)."""

from collections.abc import Iterable

import gtsam
from gtsam.symbol_shorthand import B, V, X

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.key_state import BIAS, POSE, VELOCITY, KeyState

VARIABLES = ((X, POSE), (V, VELOCITY), (B, BIAS))
"""Symbol and place in the tangent."""

# Values are set by keyword: without, Python's binding tries 43 other types before the bias, for 25 us.


def insert(values: gtsam.Values, k: int, point: KeyState) -> None:
    """Insert the variables of keyframe k."""
    values.insert(X(k), pose3=point.pose)
    values.insert(V(k), vector=point.velocity)
    values.insert(B(k), constant_bias=point.bias)


def update(values: gtsam.Values, k: int, point: KeyState) -> None:
    """Give the variables of keyframe k other values."""
    values.update(X(k), pose3=point.pose)
    values.update(V(k), vector=point.velocity)
    values.update(B(k), constant_bias=point.bias)


def erase(values: gtsam.Values, k: int) -> None:
    """Erase the variables of keyframe k."""
    for symbol, _ in VARIABLES:
        values.erase(symbol(k))


def retracted(values: gtsam.Values, first: int, steps: Iterable[Array]) -> gtsam.Values:
    """The values with the keyframes from `first` on moved by tangent vectors (dim,), of which the linear
    states are left out.
    """
    delta = gtsam.VectorValues()
    for k, step in enumerate(steps, first):
        for symbol, place in VARIABLES:
            delta.insert(symbol(k), step[place])
    return values.retract(delta)


def state_of(values: gtsam.Values, k: int, linear: Array) -> KeyState:
    """The state of keyframe k, with its linear states."""
    return KeyState(values.atPose3(X(k)), values.atVector(V(k)), values.atConstantBias(B(k)), linear)
