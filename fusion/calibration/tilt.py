"""The tilt of an IMU against the body, from its turns and from heights.

A robot that turns on the ground turns about the body's z axis: a tilted gyro shows a share of each turn on
its other axes, which are roll and pitch of the mounting, while the ground's own roll and pitch rates come
and go. Windows are compared in blocks, whose means, such as a bias, are left out; sigma follows the scatter
between blocks (Liang and Zeger 1986).

A robot that drives a distance gains height by its energy balance: the integral of speed times specific
force ahead, less v^2 / 2, is g times the climb. An IMU pitched by p, nose down, misses g p for every metre:
heights measure p, as soon as the distance is long against their own errors, which wander (a Kalman filter
of the datum, the wandering error, p, and the place of the IMU ahead of the body's origin).
"""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.calibration.mounting import Angle

WINDOW_S, BLOCK = 2.0, 5
LEAST_BLOCKS = 3.0
"""Blocks of equal turns before the gyro gives an angle."""
USELESS_SIGMA_RAD = 0.1
"""Turns that give less are left out."""
LEAST_SIGMA_RAD = math.radians(0.5)
"""Axes of a gyro against those of its accelerometer, load and tyres (assumed)."""
FIX_INTERVAL_S = 10.0
HEIGHT_TIME_S, HEIGHT_WALK_S = 60.0, 600.0
"""Correlation time of heights, and time in which they wander as far again (assumed)."""
WHITE_M = 0.1
"""Of the antenna that pitches with the body, and of a height that is rounded (assumed)."""
PATH_SIGMA = 0.05
"""Random walk of the climb by the energy balance, m per sqrt(m): speed and vibration (assumed)."""
UNKNOWN_M = 1e4
PLACE_M = 0.3
"""1 sigma of the place of the IMU ahead of the body's origin."""
WIDE_RAD = 0.3


class MountingTilt:
    """Learns roll and pitch, the angles by which readings are turned about x, then y, into body axes.

    An accelerometer's bias, 1 sigma `bias_mps2`, looks to heights as its tilt does.

    Attributes:
        turns: (roll, pitch) by the gyro, None until enough turns.
        driven_m: distance so far.
    """

    def __init__(self, bias_mps2: float) -> None:
        self._height_sigma_rad = math.hypot(bias_mps2 / GRAVITY_MPS2, LEAST_SIGMA_RAD)
        self._window, self._window_s = np.zeros(3), 0.0
        self._windows: list[Array] = []
        self._sum, self._outer = np.zeros(3), np.zeros((3, 3))
        self._energy, self._freedom = np.zeros(2), 0
        self.turns: tuple[Angle, Angle] | None = None
        self._climb_m = self._rolled_m = self._climb_by_lever = self._speed_mps = 0.0
        self._since_s = self._walked_m = self.driven_m = 0.0
        self._mean, self._P = np.zeros(4), np.diag([UNKNOWN_M, UNKNOWN_M, WIDE_RAD, PLACE_M]) ** 2
        self._gathered, self._count, self._squares = np.zeros(5), 0, 0.0

    def interrupt(self) -> None:
        """Motion is missing: a new window, and a new datum."""
        self._window, self._window_s, self._windows = np.zeros(3), 0.0, []
        self._P[0, 0] = UNKNOWN_M**2
        self._P[0, 1:] = self._P[1:, 0] = 0.0

    def angles(self, ahead_known: bool = True) -> tuple[Angle, Angle]:
        """Roll and pitch by turns, and by heights where it is known which force is that ahead.

        Sigma is wider where both disagree (Birge 1932).
        """
        unknown = Angle(0.0, WIDE_RAD)
        by_heights = self.heights if ahead_known else unknown
        roll, pitch = self.turns or (unknown, unknown)
        both = pitch.combined(by_heights)
        apart = abs(pitch.rad - by_heights.rad) / math.hypot(pitch.sigma_rad, by_heights.sigma_rad)
        return roll, Angle(both.rad, both.sigma_rad * max(apart, 1.0))

    @property
    def heights(self) -> Angle:
        """Pitch by heights."""
        scale = max(1.0, self._squares / max(self._count, 1))
        return Angle(
            float(self._mean[2]), math.hypot(math.sqrt(scale * self._P[2, 2]), self._height_sigma_rad)
        )

    def add(self, dt_s: float, speed_mps: float, gyro_radps: Array, force_mps2: Array) -> bool:
        """Motion over `dt_s`; True when the angles of the turns changed."""
        moved_m = speed_mps * dt_s
        self._climb_m += moved_m * float(force_mps2[0]) / GRAVITY_MPS2
        self._climb_by_lever += moved_m * float(gyro_radps[2]) ** 2 / GRAVITY_MPS2
        self._rolled_m += moved_m
        self._walked_m += abs(moved_m)
        self.driven_m += abs(moved_m)
        self._speed_mps = speed_mps
        self._since_s += dt_s
        self._window += gyro_radps * dt_s
        self._window_s += dt_s
        if self._window_s < WINDOW_S:
            return False
        self._windows.append(self._window)
        self._window, self._window_s = np.zeros(3), 0.0
        if len(self._windows) < BLOCK:
            return False
        turns = np.array(self._windows)
        turns -= turns.mean(axis=0)
        self._windows = []
        block = turns.T @ turns[:, 2]
        self._sum += block
        self._outer += np.outer(block, block)
        self._energy += (turns[:, :2] ** 2).sum(axis=0)
        self._freedom += BLOCK - 1
        return self._fit()

    def _fit(self) -> bool:
        square = float(self._sum[2])
        blocks = square**2 / max(float(self._outer[2, 2]), 1e-12)
        if blocks < LEAST_BLOCKS:
            return False
        ratio = self._sum[:2] / square
        off = np.hstack([np.eye(2), -ratio[:, None]])
        between = np.diag(off @ self._outer @ off.T) / square**2 * blocks / (blocks - 1.0)
        white = np.maximum(self._energy - ratio**2 * square, 0.0) / self._freedom / square
        sigma = np.sqrt(np.maximum(between, white) + LEAST_SIGMA_RAD**2).tolist()
        known = max(sigma) < USELESS_SIGMA_RAD
        self.turns = (Angle(float(ratio[1]), sigma[1]), Angle(-float(ratio[0]), sigma[0])) if known else None
        return known

    def height(self, up_m: float, sigma_m: float) -> bool:
        """A height of a fix at the end of the motion; True when the angle changed."""
        climb_m = self._climb_m - 0.5 * self._speed_mps**2 / GRAVITY_MPS2
        self._gathered += [1.0, up_m - climb_m, self._rolled_m, self._climb_by_lever, sigma_m]
        if self._since_s < FIX_INTERVAL_S or not self._walked_m:
            return False
        _, measured, rolled, climb_by_lever, sigma_m = (self._gathered / self._gathered[0]).tolist()
        dt, walked, self._since_s, self._walked_m = self._since_s, self._walked_m, 0.0, 0.0
        self._gathered[:] = 0.0
        kept = math.exp(-dt / HEIGHT_TIME_S) if self._count else 0.0
        F = np.array([1.0, kept, 1.0, 1.0])
        self._mean *= F
        self._P *= np.outer(F, F)
        self._P[0, 0] += 2.0 * sigma_m**2 * dt / HEIGHT_WALK_S + PATH_SIGMA**2 * walked
        self._P[1, 1] += sigma_m**2 * (1.0 - kept**2)
        H = np.array([1.0, 1.0, rolled, climb_by_lever])
        left = measured - float(H @ self._mean)
        PH = self._P @ H
        S = float(H @ PH) + (0.2 * sigma_m) ** 2 + WHITE_M**2
        self._count += 1
        self._squares += left**2 / S
        gain = PH / S
        self._mean += gain * left
        self._P -= np.outer(gain, PH)
        return True
