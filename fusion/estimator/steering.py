"""The turn of steered wheels: curvature of their angles times the distance, with scale and zero learned.

The path has the curvature (1 + scale) m + zero, where m is that of the measured angles. Scale (ratio of the
steering and wheelbase) and zero are estimated from the gyro's turns by a Kalman filter beside the graph; what
is left of them makes the sigma of the turn, correlated over `CORRELATED_S`.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.robot import SKIDDING
from terrafusion.datasets.core.sensors import Rig, SteeringSpec
from terrafusion.fusion.config.assumptions import YAW_FACTOR_SIGMA
from terrafusion.fusion.config.sensor_config import SensorConfig, yaw_factor
from terrafusion.fusion.graph.key_state import BIAS
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.noise.policy import Policy, SensorNoise

WHEEL_RATIO, WHEEL_RATIO_SIGMA = 16.0, 0.3
"""Angle of a steering wheel over that of the front wheels, of cars (assumed), and its relative sigma."""
CORRELATED_S = 30.0
"""Time for which an error of the curvature lasts: tyres, camber of the ground, play (assumed)."""
CURVATURE_SHARE, CURVATURE_FLOOR = 0.03, 0.002
"""Error of the curvature by slip angles: share of it, and of one over the wheelbase (assumed)."""
WANDER_SHARE = 0.1
"""How far scale and zero wander in `CORRELATED_S`, in their first sigmas (assumed)."""
TYRE_SLIP_PER_GRADE = 0.05
"""Slip over the grade of tyres on firm ground, where most steered robots drive: half the grip takes some two
per cent of slip (assumed)."""
STEERED_SIGMA = 0.02
"""1 sigma of the scale of a steered robot's turn (assumed)."""
LEAST_M = 0.02
"""Distance a keyframe below which nothing is learned."""


def front_ratio(rig: Rig) -> float:
    """Angle of the steering wheel over that of the front wheels."""
    known = rig.steering.ratio if rig.steering is not None else None
    return known if known is not None else WHEEL_RATIO


def policy_of(rig: Rig, policy: Policy, yaw: str = "gyro") -> Policy:
    """The policy for a robot that does not skid to turn, or whose `yaw_factor` is known: its turns have no
    scale, or that one. On ground of no class, tyres of a steered robot slip little on a grade.

    Args:
        yaw: source of the yaw rate; where it is the wheels, their track holds the factor already.
    """
    if rig.drive in SKIDDING and rig.known.yaw_factor is None:
        return policy
    steered = rig.steering is not None
    scale = 0.0 if steered or yaw == "wheels" else yaw_factor(rig) - 1.0
    sigma = STEERED_SIGMA if steered else YAW_FACTOR_SIGMA

    def turning(noise: SensorNoise) -> SensorNoise:
        return dataclasses.replace(noise, yaw_scale_mean=scale, yaw_scale_sigma=sigma)

    classes = {name: turning(noise) for name, noise in policy.classes.items()}
    fixed = turning(policy.fixed)
    if steered:
        fixed = dataclasses.replace(fixed, slip_per_grade=min(fixed.slip_per_grade, TYRE_SLIP_PER_GRADE))
    return dataclasses.replace(policy, classes=classes, fixed=fixed)


def steered_turn(rig: Rig, inputs: SensorConfig) -> SteeredTurn | None:
    """The turn of a robot by its steering angles; None for one that does not steer."""
    if rig.steering is None:
        return None
    return SteeredTurn(rig, rig.steering, inputs.steering_wheel, by_gyro=inputs.yaw == "gyro")


def along(increment: WheelIncrement, course_rad: float) -> WheelIncrement:
    """The increment of wheels that roll at an angle to the body's x axis, as front and rear wheels that turn
    to one side do; its distance is that along the axis.
    """
    c, s = math.cos(course_rad), math.sin(course_rad)
    x, y, z = increment.displacement_m.tolist()
    moved = np.array([c * x - s * y, s * x + c * y, z])
    change = c * increment.speed_change_mps
    return dataclasses.replace(
        increment, displacement_m=moved, distance_m=c * increment.distance_m, speed_change_mps=change
    )


class SteeredTurn:
    """Turns from steering angles.

    Attributes:
        mean: (2,) scale and zero (1/m). covariance: (2, 2) of them.
    """

    def __init__(
        self, rig: Rig, spec: SteeringSpec, of_steering_wheel: bool = False, by_gyro: bool = True
    ) -> None:
        self._by_gyro = by_gyro
        scale = WHEEL_RATIO_SIGMA if of_steering_wheel and spec.ratio is None else max(spec.scale_sigma, 0.02)
        self._first = np.array([scale, max(spec.offset_sigma_rad, 1e-3) / rig.wheelbase_m])
        self._floor_per_m = CURVATURE_FLOOR / rig.wheelbase_m
        self._ahead_m = rig.ahead_m
        self.mean: Array = np.zeros(2)
        self.covariance: Array = np.diag(self._first**2)

    def between(
        self,
        start_ns: int,
        end_ns: int,
        increment: WheelIncrement,
        steering: SteeringStream,
        covariance: Array | None,
    ) -> WheelIncrement:
        """The increment between two keyframes, under the covariance of the states at the first; None where
        the gyro is missing.

        Where the angles are the only source of yaw, they are in the link of the keyframes, and not here.
        """
        dt_s = (end_ns - start_ns) * 1e-9
        increment = along(increment, steering.course_rad(start_ns, end_ns))
        if not self._by_gyro:
            return self.applied(increment, None, dt_s, 0.0)
        rate_sigma = math.inf if covariance is None else math.sqrt(covariance[BIAS, BIAS][5, 5])
        return self.applied(increment, steering.curvature_per_m(start_ns, end_ns), dt_s, rate_sigma)

    def turn_rad(self, distance_m: float, curvature_per_m: float) -> float:
        """Turn over a distance by the measured curvature."""
        return distance_m * float(curvature_per_m + np.array([curvature_per_m, 1.0]) @ self.mean)

    def applied(
        self, increment: WheelIncrement, curvature_per_m: float | None, dt_s: float, rate_sigma_radps: float
    ) -> WheelIncrement:
        """The increment with the turn of the steered wheels; scale and zero learn from its gyro's.

        Args:
            increment: with the turn by the gyro, bias removed, as `yaw_rad`.
            curvature_per_m: of the measured angles; None where there is none.
            dt_s: its time.
            rate_sigma_radps: 1 sigma of the gyro's bias; infinite without a gyro.
        """
        moved = increment.displacement_m.copy()
        moved[1] += self._ahead_m * increment.yaw_rad  # the middle of the rear axle does not go sideways
        increment = dataclasses.replace(increment, displacement_m=moved)
        if curvature_per_m is None:
            return increment.without_turn()
        distance = increment.distance_m
        H = np.array([curvature_per_m, 1.0])
        turn = self.turn_rad(distance, curvature_per_m)
        own = (CURVATURE_SHARE * abs(curvature_per_m) + self._floor_per_m) ** 2
        spread = math.sqrt(float(H @ self.covariance @ H) + own)
        lasting = math.sqrt(2.0 * CORRELATED_S / dt_s)
        sigma = abs(distance) * spread * lasting + 1e-4
        if abs(distance) > LEAST_M:
            self._learn(increment.yaw_rad - turn, distance * H, dt_s, rate_sigma_radps, own, lasting)
        return dataclasses.replace(increment, turn_rad=turn, sigma=np.append(increment.sigma[:3], sigma))

    def _learn(
        self, innovation_rad: float, H: Array, dt_s: float, rate_sigma: float, own: float, lasting: float
    ) -> None:
        P = self.covariance + np.diag((WANDER_SHARE * self._first) ** 2) * dt_s / CORRELATED_S
        noise = lasting**2 * ((rate_sigma * dt_s) ** 2 + own * float(H[1]) ** 2)
        variance = float(H @ P @ H) + noise
        gain = P @ H / variance
        self.mean = self.mean + gain * innovation_rad
        P = P - np.outer(gain, H @ P)
        self.covariance = 0.5 * (P + P.T)
