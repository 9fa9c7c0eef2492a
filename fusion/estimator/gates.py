"""Gates: tests that keep wrong measurements out without locking good ones out."""

import dataclasses
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.graph.key_state import SLIP, VELOCITY, KeyState
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.policy import SensorNoise

FAULT = 3.0
"""A wheel increment this many limits off is no measurement at all (a counter that jumps)."""
LEAST_SLIP_TIME_S = 2.0
"""Slip that changes faster is what a gate is to find (assumed)."""
JUMP_MPS2 = 5.0
"""Change of wheel speed beyond the robot's (assumed): 5 cm in a keyframe of 0.1 s. Motors ramp by 1 to 3."""
JUMP_LASTS = 2
"""Keyframes a jump takes at most; wheels that keep their new speed for longer have it."""


class GateDecision(Enum):
    """Decision of a gate on a fix."""

    ACCEPT = "accept"
    REJECT = "reject"
    REACQUIRE = "reacquire"


@dataclass
class GnssGate:
    """Chi-square test of a fix against its prediction.

    When enough consecutive rejected fixes agree with each other the estimate, not GNSS, is taken to be
    wrong: `test` answers REACQUIRE. They agree when they lie on a line over time, since a wrong estimate
    moves on, too. After `limit` rejected fixes the next one is used in any case.

    Attributes:
        threshold: chi-square quantile of the innovations tested.
        patience: consecutive rejected fixes that must agree with each other.
        agreement_sigma: how well they must agree, in their own sigmas.
        limit: consecutive rejected fixes after which the next is used, whether they agree or not.
    """

    threshold: float
    patience: int = 5
    agreement_sigma: float = 4.0
    limit: int = 30
    rejected: list[tuple[Array, float]] = field(default_factory=list)

    def test(self, innovation_m: Array, covariance_m2: Array) -> tuple[GateDecision, float]:
        """Decision on the fix, and the normalised innovation squared.

        `innovation_m` (d,) is fix minus prediction, `covariance_m2` (d, d) of it.
        """
        nis = normalised_square(innovation_m, covariance_m2)
        if nis <= self.threshold:
            self.rejected.clear()
            return GateDecision.ACCEPT, nis
        self.rejected.append((innovation_m[:2].copy(), float(np.sqrt(covariance_m2[0, 0]))))
        if len(self.rejected) > self.limit or (len(self.rejected) >= self.patience and self._agree()):
            self.rejected.clear()
            return GateDecision.REACQUIRE, nis
        return GateDecision.REJECT, nis

    def _agree(self) -> bool:
        recent = self.rejected[-self.patience :]
        points = np.array([point for point, _ in recent])
        order = np.arange(len(points)) - 0.5 * (len(points) - 1)
        points = points - points.mean(axis=0)
        left_m = points - np.outer(order, order @ points) / float(order @ order)
        spread = float(np.sqrt((left_m**2).sum() / (len(points) - 2)))
        return spread <= self.agreement_sigma * max(sigma for _, sigma in recent)


@dataclass
class WheelGate:
    """Test of a wheel increment against the IMU's prediction.

    A burst of slip or a jammed wheel shows as an increment that the IMU does not confirm. Beyond the limit
    it counts less (Huber 1964, Ann. Math. Stat. 35(1)), far beyond not at all; but for at most `patience`
    consecutive keyframes, as the IMU drifts.

    An increment that is far off or abrupt is a fault. A faulty increment must not reset the slip (as a
    change of wheel speed does in `slow_states.step`), else the gate would accept whatever follows. The
    first one accepted after a fault has the change of speed since before it: none where a counter jumped,
    all of it where the wheels broke loose.

    Attributes:
        limit_sigma: normalised innovation up to which an increment is believed.
        patience: consecutive keyframes in which an increment may count less.
        faulty: the increment just tested is a fault.
        last_mps: speeds of wheels and robot in the last increment without fault.
    """

    limit_sigma: float
    patience: int = 10
    in_a_row: int = 0
    faulty: bool = False
    last_mps: tuple[float, float] | None = None

    def rejoined(self, wheels: WheelIncrement, dt_s: float) -> WheelIncrement:
        """An increment over `dt_s`; after faults with its change of speed since before them."""
        if not self.faulty or self.last_mps is None:
            return wheels
        change_mps = wheels.distance_m / dt_s - self.last_mps[0]
        return dataclasses.replace(wheels, speed_change_mps=change_mps)

    def test(
        self,
        innovation_m: float,
        sigma_m: float,
        wheels: WheelIncrement,
        robot_mps: tuple[float, float],
        dt_s: float,
    ) -> tuple[bool, float]:
        """Whether to believe an increment, and the normalised innovation squared.

        `wheels` is the increment, `rejoined`, over `dt_s`; `robot_mps` the forward speed by the IMU at its
        start and end.
        """
        since_mps = self.last_mps[1] if self.faulty and self.last_mps is not None else robot_mps[0]
        left_mps = abs(wheels.speed_change_mps - (robot_mps[1] - since_mps))
        abrupt = left_mps > JUMP_MPS2 * dt_s and self.in_a_row < JUMP_LASTS
        off = abs(innovation_m) / sigma_m
        believed = (off <= self.limit_sigma and not abrupt) or self.in_a_row >= self.patience
        self.in_a_row = 0 if believed else self.in_a_row + 1
        self.faulty = not believed and (self.faulty or abrupt or off >= FAULT * self.limit_sigma)
        if not self.faulty:
            self.last_mps = wheels.distance_m / dt_s, robot_mps[1]
        return believed, off**2

    def doubt(self, nis: float) -> float:
        """Factor on the variance of the rejected increment just tested, from 1 at the limit."""
        return np.inf if self.faulty else float(np.sqrt(nis)) / self.limit_sigma


def normalised_square(innovation: Array, covariance: Array) -> float:
    """Normalised square of an innovation (d,) with covariance (d, d), d being 1 or 2."""
    if len(innovation) == 1:
        return float(innovation[0] ** 2 / covariance[0, 0])
    (x, y), ((a, b), (_, d)) = innovation.tolist(), covariance.tolist()
    left = y - b / a * x
    return float(x * x / a + left * left / (d - b * b / a))


def wheel_innovation(
    wheels: WheelIncrement,
    before: KeyState,
    point: KeyState,
    P: Array,
    noise: SensorNoise,
    dt_s: float,
    switch: float,
) -> tuple[float, float]:
    """Displacement along body x by the IMU less that by the wheels, m, and its variance, m2.

    Args:
        before, point: the last keyframe with its covariance P (dim, dim), and the IMU's prediction from it.
        switch: share of the ground that has just changed.
    """
    R, rolled_m, sigma_m = before.rotation, float(wheels.displacement_m[0]), float(wheels.sigma[0])
    forward = R[:, 0]
    moved_m = float(forward @ (point.pose.translation() - before.pose.translation()))
    renewed = 2.0 * dt_s / max(noise.slip_time_s, LEAST_SLIP_TIME_S) + switch
    slip_variance = float(P[SLIP, SLIP]) + noise.slip_sigma**2 * renewed
    variance = (
        sigma_m * sigma_m
        + rolled_m * rolled_m * slip_variance
        + dt_s**2 * float(forward @ P[VELOCITY, VELOCITY] @ forward)
        + (0.5 * GRAVITY_MPS2 * dt_s**2) ** 2 * float(P[1, 1])
    )
    return moved_m - before.rolling * rolled_m, variance
