"""What a mode makes of single measurements: the interface between the estimator and its baselines."""

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise

NOTEWORTHY = 0.1
"""Relative change of a weight that is recorded."""


class NoiseInForce(Protocol):
    """The sensor noise that a mode may change, and where it records what it changed."""

    noise: SensorNoise

    def record(self, change: WeightChange) -> None:
        """Record a change."""


@dataclass(frozen=True, eq=False)
class InnovationTest:
    """A measurement against its prediction, its `dof` components d taken to be independent.

    Attributes:
        t_ns: its time.
        innovation_m: (d,) measurement minus prediction.
        predicted_m2: (d,) variance of the prediction, and of all errors that are not weighted.
        noise_m2: (d,) variance that the factor gives to the measurement itself.
        drift_m2: GNSS: variance of the part of its error that is a state.
        unit_m: (d,) unit of the noise: the receiver's sigma, or the time step (s).
        white_share: GNSS: least white share of the reported variance.
    """

    t_ns: int
    innovation_m: Array
    predicted_m2: Array
    noise_m2: Array
    unit_m: Array
    drift_m2: float = 0.0
    white_share: float = 1.0


class Weighting:
    """The trivial answers of modes "fixed" and "adaptive": a measurement keeps its sigma.

    Attributes:
        passed_nis: a fix that its gate rejects is used all the same up to this normalised square.
    """

    passed_nis = 0.0

    def wheels(self, wheels: WheelIncrement, test: InnovationTest) -> WheelIncrement:
        """The increment with the sigma to use; `test` is a `wheel_innovation_test`."""
        return wheels

    def gnss(self, test: InnovationTest) -> tuple[float, float]:
        """Factor on the horizontal sigma of a fix, and its weight by a robust loss (0 to 1)."""
        return 1.0, 1.0

    def revisit(self, chain: Chain) -> None:
        """Weight the fixes held in the window again, after new ones came."""


def wheel_innovation_test(
    t_ns: int, wheels: WheelIncrement, innovation_m: float, variance_m2: float, dt_s: float
) -> InnovationTest:
    """A wheel increment over `dt_s` against its prediction, along body x; the innovation and its variance."""
    own = wheels.sigma[0] ** 2
    predicted = max(variance_m2 - own, 0.0)
    return InnovationTest(
        t_ns, np.array([innovation_m]), np.array([predicted]), np.array([own]), np.array([dt_s])
    )


def white_variance(reported: float, drift: float, least_share: float) -> float:
    """White variance of a fix: the `reported` one less that of the `drift`, at least a share of it."""
    return max(reported - drift, least_share * reported)


def inflated(wheels: WheelIncrement, scale: float) -> WheelIncrement:
    """The increment with `scale` times the sigma along body x."""
    return dataclasses.replace(wheels, sigma=wheels.sigma * np.array([scale, 1.0, 1.0, 1.0]))
