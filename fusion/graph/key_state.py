"""The state of one keyframe and its tangent space."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DIM = 18
POSE, VELOCITY, BIAS, SLIP, DRIFT = slice(0, 6), slice(6, 9), slice(9, 15), 15, slice(16, 18)
NAV, MARKOV = slice(0, 15), slice(15, 18)
"""The states that GTSAM holds, and the Gauss-Markov states."""


@dataclass(frozen=True, eq=False)
class KeyState:
    """State of one keyframe: `pose` Pose3, `velocity` (3,), `bias` ConstantBias, `slip`, `drift` (2,) m."""

    pose: gtsam.Pose3
    velocity: Array
    bias: gtsam.imuBias.ConstantBias
    slip: float
    drift: Array

    def markov(self) -> Array:
        """Slip and drift (3,)."""
        return np.array([self.slip, self.drift[0], self.drift[1]])

    def retract(self, delta: Array) -> KeyState:
        """The state moved by a tangent vector (18,)."""
        bias = gtsam.imuBias.ConstantBias(
            self.bias.accelerometer() + delta[9:12], self.bias.gyroscope() + delta[12:15]
        )
        return KeyState(
            self.pose.retract(delta[POSE]),
            self.velocity + delta[VELOCITY],
            bias,
            self.slip + float(delta[SLIP]),
            self.drift + delta[DRIFT],
        )

    def local(self, other: KeyState) -> Array:
        """The tangent vector (18,) that leads from this state to `other`."""
        return np.concatenate(
            [
                self.pose.localCoordinates(other.pose),
                other.velocity - self.velocity,
                other.bias.vector() - self.bias.vector(),
                other.markov() - self.markov(),
            ]
        )


def quaternion_of(pose: gtsam.Pose3) -> Array:
    """Orientation (4,) x, y, z, w."""
    return np.asarray(pose.rotation().toQuaternion().coeffs())  # type: ignore[attr-defined,unused-ignore]
