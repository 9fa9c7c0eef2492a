"""One keyframe of the chain, with all that touches it."""

import operator
from dataclasses import dataclass, field

import gtsam

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.gauss_markov import MarkovStep
from terrafusion.fusion.graph.gnss_factor import GnssPosition
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
    link: gtsam.NonlinearFactorGraph
    markov: MarkovStep | None
    wheels: WheelIncrement | None
    gyro_radps: Array
    accel_mps2: Array
    preintegrated: bool
    prior: Array
    delta: Array
    unary: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    unary_keys: set[str] = field(default_factory=set)
    fixes: list[GnssPosition] = field(default_factory=list)
    velocities: list[GnssVelocity] = field(default_factory=list)
    conditional: Array | None = None

    def __post_init__(self) -> None:
        # Results that hold while what they were made of does. They are no fields: a snapshot leaves them out.
        self._state: tuple[KeyState, Array, KeyState] | None = None
        self._rows: tuple[KeyState, list[Array]] | None = None
        self._link_rows: tuple[tuple[object, ...], Array] | None = None

    def state(self) -> KeyState:
        """The estimate: `point` moved by `delta`."""
        held = self._state
        if held is None or held[0] is not self.point or held[1] is not self.delta:
            held = self._state = self.point, self.delta, self.point.retract(self.delta)
        return held[2]

    def held_rows(self) -> list[Array] | None:
        """What `hold_rows` got, while it is true: until the linearisation point or a factor is another."""
        return self._rows[1] if self._rows is not None and self._rows[0] is self.point else None

    def hold_rows(self, rows: list[Array]) -> list[Array]:
        """Keep the whitened rows of its own factors."""
        self._rows = self.point, rows
        return rows

    def held_link(self, made_of: tuple[object, ...]) -> Array | None:
        """The whitened rows of its link, while what they were made of is the same."""
        held = self._link_rows
        same = held is not None and all(map(operator.is_, held[0], made_of))
        return held[1] if held is not None and same else None

    def hold_link(self, made_of: tuple[object, ...], rows: Array) -> Array:
        """Keep the whitened rows of its link."""
        self._link_rows = made_of, rows
        return rows

    def forget_rows(self) -> None:
        """A factor of its own changes."""
        self._rows = None
