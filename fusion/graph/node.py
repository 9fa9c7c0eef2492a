"""One keyframe of the chain, with all that touches it."""

from dataclasses import dataclass, field

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.gnss_factor import GnssPosition
from terrafusion.fusion.graph.kept import Kept
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.velocity_factor import GnssVelocity
from terrafusion.fusion.graph.wheel_factor import WheelIncrement


@dataclass(eq=False)
class Node:
    """A keyframe in the chain: its factors, its linearisation point and the result of its elimination.

    `gyro_radps` and `accel_mps2` (3,) are the mean IMU readings since the keyframe before;
    `preintegrated`: `link` is one `CombinedImuFactor` of them. `prior` (m, dim + 1) are whitened rows of
    all older keyframes, `delta` (dim,) leads from `point` to the estimate.
    """

    point: KeyState
    t_ns: int
    prior: Array
    delta: Array
    link: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    markov: MarkovStep | None = None
    wheels: WheelIncrement | None = None
    gyro_radps: Array = field(default_factory=lambda: np.zeros(3))
    accel_mps2: Array = field(default_factory=lambda: np.zeros(3))
    preintegrated: bool = False
    unary: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    fixes: list[GnssPosition] = field(default_factory=list)
    velocities: list[GnssVelocity] = field(default_factory=list)
    conditional: Array | None = None

    def __post_init__(self) -> None:
        # No fields: a snapshot leaves them out.
        self._state, self.own_rows, self.link_rows = Kept[KeyState](), Kept[list[Array]](), Kept[Array]()

    def state(self) -> KeyState:
        """The estimate: `point` moved by `delta`."""
        return self._state.of((self.point, self.delta), lambda: self.point.retract(self.delta))
