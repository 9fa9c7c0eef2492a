"""The wheel factor: displacement and turn between two keyframes by slipping wheels.

Residual (4,): three in the body frame of keyframe i, metres, and the turn, radians::

    r[:3] = R_i' (p_j - p_i) - (1 - slip) (1 + radius) (d + delay dv e_x) + surge_slip surge e_x -
        lateral e_y
    r[3]  = yaw(R_i' R_j) - (1 + yaw_scale) turn
    lateral = side_slip distance - icr_x yaw

`d` is the travelled distance turned by the gyro; `dv` the change of wheel speed, which shows a delay of
their clock; `surge` is a / g (|d| + v0 dt) of wheels that accelerate by a: they need the thrust, and so
the slip, of a grade a / g, which would otherwise look like a delay of surge_slip v / g. The first
component is odometry with slip, the second and third are the non-holonomic constraint (Dissanayake et al.
2001, IEEE T-RA 17(5)), corrected for the turning of skid-steered robots (instantaneous centres of
rotation: Martinez et al. 2005, IJRR 24(10); Pentzer, Brennan, Reichard 2014, J. Field Robotics 31(3)).
Slip is v = (1 - slip) omega R (Wong 2008, Theory of Ground Vehicles).
"""

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.graph.key_state import (
    ICR_X,
    MARKOV,
    NAV,
    RADIUS,
    SIDE_SLIP,
    SLIP,
    SURGE_SLIP,
    WHEEL_DELAY,
    YAW_SCALE,
    KeyState,
)

_S, _K, _I, _B, _R, _T, _A = (
    i - NAV.stop for i in (SLIP, YAW_SCALE, ICR_X, SIDE_SLIP, RADIUS, WHEEL_DELAY, SURGE_SLIP)
)

MOVED_M = 0.01
"""Distance per keyframe below which the slip of acceleration is ignored."""


@dataclass(frozen=True, eq=False)
class WheelIncrement:
    """Measurement of the wheels between two keyframes.

    Attributes:
        displacement_m: (3,) in the body frame of the first keyframe, slip not removed.
        sigma: (4,) 1 sigma along body x, y, z (m) and of the turn (rad; infinite where it is not
            measured).
        distance_m: mean travelled wheel distance, signed.
        turn_rad: right minus left distance over the track, signed.
        yaw_rad: turn by the gyro, bias removed.
        speed_change_mps: wheel speed at the end less that at the start.
        surge_m: a / g (|distance| + v0 dt) of wheels that accelerate by a; 0 unless calibrated.
        skid_m: distance along body x that the wheels rolled and the robot, by friction, did not move.
        course_lag_sigma_s: spread of the centre of rotation along body x per speed, between grounds.
    """

    displacement_m: Array
    sigma: Array
    distance_m: float
    turn_rad: float
    yaw_rad: float = 0.0
    speed_change_mps: float = 0.0
    surge_m: float = 0.0
    skid_m: float = 0.0
    course_lag_sigma_s: float = 0.0

    def without_turn(self) -> Self:
        """The increment without a measurement of the turn."""
        return dataclasses.replace(self, sigma=np.append(self.sigma[:3], np.inf))

    def doubted(self, variance_m2: float, times: float) -> Self:
        """The increment with distance and turn so uncertain that the variance `variance_m2` of the innovation
        along body x grows by the factor `times`; the non-holonomic constraint stays.
        """
        scale = float(np.sqrt(1.0 + (times - 1.0) * variance_m2 / self.sigma[0] ** 2))
        change = self.speed_change_mps if np.isfinite(scale) else 0.0
        sigma = self.sigma * np.array([scale, 1.0, 1.0, scale])
        return dataclasses.replace(self, sigma=sigma, speed_change_mps=change)

    def with_extra_variance(self, variance_m2: float) -> Self:
        """The increment with `variance_m2` added along body x and y each."""
        sigma = self.sigma.copy()
        sigma[:2] = np.sqrt(sigma[:2] ** 2 + variance_m2)
        return dataclasses.replace(self, sigma=sigma)


def slip_of(linear: Array, wheels: WheelIncrement) -> float:
    """Slip over the interval of `wheels`, those of acceleration and skid included."""
    asked_m = float(linear[_A]) * wheels.surge_m + (1.0 - float(linear[_S])) * wheels.skid_m
    return float(linear[_S]) + (asked_m / wheels.distance_m if abs(wheels.distance_m) > MOVED_M else 0.0)


def linearised(before: KeyState, now: KeyState, wheels: WheelIncrement) -> tuple[Array, Array, Array, Array]:
    """The residual (4,) of the module's docstring, unwhitened, and its derivatives by the poses of both
    keyframes (4, 6) and by the linear states of the second (4, 15).

    Pose tangents are GTSAM's: rotation first, both parts in the body frame.
    """
    R_i, p_i, R_j, p_j = before.rotation, before.pose.translation(), now.rotation, now.pose.translation()
    return linearised_steps(R_i.T @ (p_j - p_i), R_i.T @ R_j, now.linear, wheels)


def linearised_steps(
    moved: Array, T: Array, linear: Array, wheels: WheelIncrement
) -> tuple[Array, Array, Array, Array]:
    """The same by R_i' (p_j - p_i) (3,), R_i' R_j (3, 3) and the linear states (15,) of the second keyframe.

    For n increments at once all arrays have a last axis of that length, the numbers of `wheels` being (n,).
    """
    many = moved.shape[1:]
    # Of a single step floats: they are faster than the scalars of NumPy.
    place, turned, state = (moved, T, linear) if many else (moved.tolist(), T.tolist(), linear.tolist())
    (x, y, z), ((c, d, e), (s, g, h), (a, _, _)) = place, turned
    slip, radius = 1.0 - state[_S], 1.0 + state[_R]
    rolled = wheels.displacement_m.copy()
    rolled[0] += state[_T] * wheels.speed_change_mps
    out = np.empty((4, *many))
    out[:3] = moved - slip * radius * rolled
    out[0] += state[_A] * wheels.surge_m
    out[1] -= state[_B] * wheels.distance_m - state[_I] * wheels.yaw_rad
    out[3] = np.arctan2(s, c) - (1.0 + state[_K]) * wheels.turn_rad
    level = c * c + s * s
    H_i, H_j = np.zeros((4, 6, *many)), np.zeros((4, 6, *many))
    H_linear = np.zeros((4, MARKOV.stop - MARKOV.start, *many))
    H_i[0, 1], H_i[0, 2] = -z, y
    H_i[1, 0], H_i[1, 2] = z, -x
    H_i[2, 0], H_i[2, 1] = -y, x
    H_i[0, 3] = H_i[1, 4] = H_i[2, 5] = -1.0
    H_i[3, 0], H_i[3, 1], H_i[3, 2] = c * a / level, s * a / level, -1.0
    H_j[:3, 3:] = T
    H_j[3, 1], H_j[3, 2] = (s * e - c * h) / level, (c * g - s * d) / level
    H_linear[:3, _S], H_linear[:3, _R] = radius * rolled, -slip * rolled
    H_linear[0, _A] = wheels.surge_m
    H_linear[0, _T] = -slip * radius * wheels.speed_change_mps
    H_linear[1, _B], H_linear[1, _I] = -wheels.distance_m, wheels.yaw_rad
    H_linear[3, _K] = -wheels.turn_rad
    return out, H_i, H_j, H_linear
