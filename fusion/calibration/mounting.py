"""The angle at which an IMU is mounted about its vertical axis, from its accelerations and the wheels'.

Over a second the body gains the speed that the wheels gain, ahead, and speed times turn to its left. A turned
IMU measures the same vector rotated::

    y = e^(-i angle) (change of speed + i speed turn) + constant

with complex numbers for vectors (ahead + i left), which is linear in e^(-i angle). The constant, gravity on a
slope and bias, is taken out of each block of some ten seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import Complex

WINDOW_S, BLOCK = 1.0, 10
"""Time over which speeds are compared, longer than most vibration, and windows with one constant."""
LEAST_FREEDOM = 18
"""Windows, less one a block, before there is an angle."""
LEAST_ALONG, LARGEST_SIGMA = 0.5, 0.35
"""The change of speed and the turns are fitted alone, too: each must be known this well and point the way of
both. A hill on which a robot always slows down turns the vector round, but only one of them (assumed)."""
ANY_ANGLE_RAD = math.pi / math.sqrt(3.0)
"""1 sigma of an angle of which nothing is known."""
LEAST_SIGMA_RAD = math.radians(1.0)
"""Wheels that slip with acceleration and an IMU off the centre turn the vector by as much (assumed)."""


@dataclass(frozen=True)
class Angle:
    """Mounting angle about z, counter-clockwise seen from above, and its 1 sigma."""

    rad: float
    sigma_rad: float

    def combined(self, other: Angle) -> Angle:
        """The mean of both by their weights, the short way round."""
        share = self.sigma_rad**2 / (self.sigma_rad**2 + other.sigma_rad**2)
        rad = self.rad + share * math.remainder(other.rad - self.rad, math.tau)
        return Angle(math.remainder(rad, math.tau), other.sigma_rad * math.sqrt(share))


class MountingAngle:
    """Compares accelerations of IMU and wheels; `angle` is None until both kinds of motion agree on one."""

    def __init__(self) -> None:
        self.angle: Angle | None = None
        self._moves: list[tuple[float, float, float, complex]] = []
        self._windows: list[tuple[float, float, complex]] = []
        self._square, self._product = np.zeros((2, 2)), np.zeros(2, dtype=complex)
        self._energy, self._freedom = 0.0, 0

    def interrupt(self) -> None:
        """Wheels or IMU are missing, or the wheels do not roll: begin a new window."""
        self._moves, self._windows = [], []

    def add(self, dt_s: float, rolled_m: float, turn_rad: float, force_mps2: Array) -> bool:
        """Motion over `dt_s` by wheels and gyro, and the mean specific force (3,) as measured; True when
        the angle changed.
        """
        self._moves.append((dt_s, rolled_m / dt_s, turn_rad, complex(*force_mps2[:2]) * dt_s))
        if sum(dt for dt, *_ in self._moves) < WINDOW_S + dt_s:
            return False
        _, speed_mps, turn, gained_mps = np.array(self._moves).T
        weight = np.ones(len(self._moves))
        weight[[0, -1]] = 0.5  # speeds are means of their interval: they hold at its middle
        ahead = float((speed_mps[-1] - speed_mps[0]).real)
        left = float((weight * speed_mps * turn).sum().real)
        self._windows.append((ahead, left, complex((weight * gained_mps).sum())))
        self._moves = self._moves[-1:]
        if len(self._windows) < BLOCK:
            return False
        self._add_block(np.array(self._windows))
        self._windows = []
        return True

    def _add_block(self, windows: Complex) -> None:
        about = windows - windows.mean(axis=0)
        moved, measured = about[:, :2].real, about[:, 2]
        self._square += moved.T @ moved
        self._product += moved.T @ measured
        self._energy += float((np.abs(measured) ** 2).sum())
        self._freedom += len(windows) - 1
        self.angle = self._fitted()

    def _fitted(self) -> Angle | None:
        if self._freedom < LEAST_FREEDOM or np.linalg.cond(self._square) > 1e6:
            return None
        moved = float(np.trace(self._square))
        rotation = complex(self._product[0] - 1j * self._product[1]) / moved
        left_over = max(self._energy - abs(rotation) ** 2 * moved, 0.0)
        inverse = np.linalg.inv(self._square)
        alone = inverse @ self._product * np.array([1.0, -1j])
        sigma = np.sqrt(0.5 * left_over / self._freedom * np.diag(inverse))
        unit = rotation / max(abs(rotation), 1e-9)
        if ((alone / unit).real < LEAST_ALONG).any() or (sigma > LARGEST_SIGMA).any():
            return None
        spread = math.sqrt(0.5 * left_over / self._freedom / moved) / abs(rotation)
        return Angle(-math.atan2(rotation.imag, rotation.real), math.hypot(spread, LEAST_SIGMA_RAD))
