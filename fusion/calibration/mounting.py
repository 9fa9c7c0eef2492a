"""The angle at which an IMU is mounted about its vertical axis, from its accelerations and the wheels'.

Over a second the body gains the speed that the wheels gain, ahead, and speed times turn to its left; an IMU
away from the body's origin gains more as the body turns. A turned IMU measures the same vector rotated::

    y = e^(-i angle) (change of speed + i speed turn + place (i change of rate - time rate^2)) + bias + g up

with complex numbers for vectors (ahead + i left), which is linear in e^(-i angle) and in its product with the
place. On slopes the vertical's share `up` in the IMU's plane turns with the robot and follows the gyro,
d up / dt = i (rate about x + i rate about y - rate about z up), whatever the angle: what it gains in a block
of some twenty seconds is taken off; its start and the biases of gyro and force are fitted in each block.

Slip makes errors that last for a block: sigma follows the scatter between blocks (Liang and Zeger 1986,
sandwich estimator), and is wider by as much as the angles from speed and from turns alone disagree beyond
their own sigma (Birge 1932).
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.calibration.motion import Complex

WINDOW_S, BLOCK = 1.0, 20
"""Time over which speeds are compared, longer than most vibration, and windows with one bias."""
LEAST_FREEDOM = 17
"""Windows, less the constants of their blocks, before there is an angle."""
LEAST_ALONG, LARGEST_SIGMA = 0.5, 0.35
"""The change of speed and the turns are fitted alone, too: each must be known this well and point the way of
both. A hill on which a robot always slows down turns the vector round, but only one of them (assumed)."""
ANY_ANGLE_RAD = math.pi / math.sqrt(3.0)
"""1 sigma of an angle of which nothing is known."""
LEAST_SIGMA_RAD = math.radians(1.0)
"""Wheels that slip with acceleration turn the vector by as much (assumed)."""
SQUARE_SHARE, SQUARE_SIGMA_RAD = 0.8, math.radians(2.0)
"""Share of IMUs whose axes are those of the body or turned by right angles, and 1 sigma of these; others are
turned by any angle (assumed)."""
STILL_CLEAR = 0.5
"""A correction ends at this share of the limits at which it begins (assumed)."""
PLACE_M = 0.5
"""1 sigma of the place of the IMU, each axis: it is somewhere on a robot (assumed)."""
LEVEL_START = 0j, 1.0 + 0j, 0j
"""At the start of a block: `up` less its start, and its derivatives by that start and by the gyro's bias."""
JOINT = np.array([[1.0, 0.0], [1j, 0.0], [0.0, 1.0]])
"""Columns of speed and turn become that of the vector that both make; that of the place stays."""


@dataclass(frozen=True)
class Angle:
    """Mounting angle about z, counter-clockwise seen from above, and its 1 sigma."""

    rad: float
    sigma_rad: float

    @classmethod
    def of_file(cls, known: KnownNumber | None, unknown_rad: float, least_rad: float) -> Angle:
        """An angle of a vehicle file: its sigma is at least `least_rad`, without one `unknown_rad`."""
        if known is None:
            return cls(0.0, unknown_rad)
        sigma_rad = known.sigma if isinstance(known.sigma, float) else unknown_rad
        return cls(known.number, max(sigma_rad, least_rad))

    def combined(self, other: Angle) -> Angle:
        """The mean of both by their weights, the short way round."""
        share = self.sigma_rad**2 / (self.sigma_rad**2 + other.sigma_rad**2)
        rad = self.rad + share * math.remainder(other.rad - self.rad, math.tau)
        return Angle(math.remainder(rad, math.tau), other.sigma_rad * math.sqrt(share))

    def corrected(
        self, found: Angle, corrects: bool, clear_sigma: float, least_rad: float
    ) -> tuple[Angle, bool]:
        """`found` and True where it clearly differs, else this angle, its sigma with the difference.

        Clear is a difference of `clear_sigma` and `least_rad`; `STILL_CLEAR` of both once it `corrects`.
        """
        off = abs(math.remainder(found.rad - self.rad, math.tau))
        limit = max(clear_sigma * found.sigma_rad, least_rad)
        if off > (STILL_CLEAR * limit if corrects else limit):
            return found, True
        return Angle(self.rad, min(math.hypot(off, found.sigma_rad), self.sigma_rad)), False

    def as_mounted(self) -> Angle:
        """Mean and 1 sigma given that most IMUs are mounted at right angles, where nothing else is known.

        The prior is a mixture of the four right angles and of any angle; the far ones are left out.
        """
        off = math.remainder(self.rad, 0.5 * math.pi)
        found, square = self.sigma_rad**2, SQUARE_SIGMA_RAD**2
        likely = math.exp(-0.5 * off**2 / (found + square)) / math.sqrt(math.tau * (found + square))
        near, anywhere = 0.25 * SQUARE_SHARE * likely, (1.0 - SQUARE_SHARE) / math.tau
        p, step = near / (near + anywhere), -off * found / (found + square)
        variance = p * found * square / (found + square) + (1.0 - p) * found + p * (1.0 - p) * step**2
        return Angle(math.remainder(self.rad + p * step, math.tau), math.sqrt(variance))


class MountingAngle:
    """Compares accelerations of IMU and wheels; `angle` is None until both kinds of motion agree on one."""

    def __init__(self) -> None:
        self.angle: Angle | None = None
        self._moves: list[tuple[float, float, float, complex, complex, complex]] = []
        self._windows: list[tuple[float, float, complex, complex, complex, complex]] = []
        self._up = LEVEL_START
        self._square, self._product = np.zeros((3, 3), dtype=complex), np.zeros(3, dtype=complex)
        self._between = np.zeros((6, 6), dtype=complex)
        self._energy, self._freedom = 0.0, 0

    def interrupt(self) -> None:
        """Wheels or IMU are missing, or the wheels do not roll: begin a new window."""
        self._moves, self._windows = [], []
        self._up = LEVEL_START

    def add(self, dt_s: float, rolled_m: float, gyro_radps: Array, force_mps2: Array) -> bool:
        """Wheels, mean rates (3,) and specific force (3,) over `dt_s`; True when the angle changed."""
        turn_rad, tilt_rad = float(gyro_radps[2]) * dt_s, complex(*gyro_radps[:2]) * dt_s
        middle = _tilted(self._up, 0.5 * dt_s, 0.5 * turn_rad, 0.5 * tilt_rad)
        self._up = _tilted(middle, 0.5 * dt_s, 0.5 * turn_rad, 0.5 * tilt_rad)
        up, by_start, by_bias = middle
        gained_mps = (complex(*force_mps2[:2]) - GRAVITY_MPS2 * up) * dt_s
        self._moves.append((dt_s, rolled_m / dt_s, turn_rad, gained_mps, by_start * dt_s, by_bias * dt_s))
        if sum([move[0] for move in self._moves]) < WINDOW_S + dt_s:
            return False
        moves = np.array(self._moves).T
        dt, speed_mps, turn = moves[:3]
        weight = np.ones(len(self._moves))
        weight[[0, -1]] = 0.5  # speeds are means of their interval: they hold at its middle
        ahead = float((speed_mps[-1] - speed_mps[0]).real)
        left = float((weight * speed_mps * turn).sum().real)
        rate = (turn / dt).real
        velocity_by_lever = complex(-float((weight * turn.real * rate).sum()), rate[-1] - rate[0])
        measured, by_start, by_bias = (moves[3:] @ weight).tolist()
        self._windows.append((ahead, left, velocity_by_lever, measured, by_start, by_bias))
        self._moves = self._moves[-1:]
        if len(self._windows) < BLOCK:
            return False
        self._add_block(np.array(self._windows))
        self.interrupt()
        return True

    def _add_block(self, windows: Complex) -> None:
        constant = np.column_stack([np.ones(len(windows)), windows[:, 4:]])
        fitted, _, rank, _ = np.linalg.lstsq(constant, windows[:, :4], rcond=1e-3)
        about = windows[:, :4] - constant @ fitted
        moved, measured = about[:, :3], about[:, 3]
        square, product = moved.conj().T @ moved, moved.conj().T @ measured
        self._square += square
        self._product += product
        joint = np.concatenate([JOINT.conj().T @ product, (JOINT.conj().T @ square @ JOINT).ravel()])
        self._between += np.outer(joint, joint.conj())
        self._energy += float((np.abs(measured) ** 2).sum())
        self._freedom += len(windows) - int(rank)
        self.angle = self._fitted()

    def _fitted(self) -> Angle | None:
        if self._freedom < LEAST_FREEDOM or np.linalg.cond(self._square[:2, :2]) > 1e6:
            return None
        square, product = JOINT.conj().T @ self._square @ JOINT, JOINT.conj().T @ self._product
        rotation = product[0] / square[0, 0]
        noise = max(self._energy - float((rotation.conj() * product[0]).real), 0.0) / self._freedom
        for _ in range(2):  # the place's prior counts by the noise, which is less once the place is known
            prior = np.diag([0.0, 0.5 * noise / PLACE_M**2 + 1e-12])
            found = np.linalg.solve(square + prior, product)
            noise = max(self._energy - float((found.conj() @ product).real), 0.0) / self._freedom
        alone, sigma = self._alone(prior[1, 1], noise)
        unit = found[0] / max(abs(found[0]), 1e-9)
        if ((alone / unit).real < LEAST_ALONG).any() or (sigma > LARGEST_SIGMA).any():
            return None
        inverse = np.linalg.inv(square + prior)
        apart_rad = abs(cmath.phase(alone[0] * alone[1].conjugate()))
        apart_sigma = apart_rad * abs(found[0]) / math.hypot(*sigma.tolist(), 1e-9)
        variance = 0.5 * noise * float(inverse[0, 0].real) * max(apart_sigma, 1.0) ** 2
        of_block = inverse @ np.hstack([np.eye(2), -np.kron(np.eye(2), found[None])])
        between = 0.5 * float((of_block @ self._between @ of_block.conj().T)[0, 0].real)
        spread = math.sqrt(max(variance, between)) / abs(found[0])
        return Angle(-cmath.phase(found[0]), math.hypot(spread, LEAST_SIGMA_RAD))

    def _alone(self, place_prior: float, noise: float) -> tuple[Complex, Array]:
        """What the changes of speed and the turns say alone, each a vector like e^(-i angle), and 1 sigma."""
        inverse = np.linalg.inv(self._square + np.diag([0.0, 0.0, place_prior]))
        alone = (inverse @ self._product)[:2] * np.array([1.0, -1j])
        return alone, np.sqrt(0.5 * noise * np.diag(inverse)[:2].real)


def _tilted(
    up: tuple[complex, complex, complex], dt_s: float, turn_rad: float, tilt_rad: complex
) -> tuple[complex, complex, complex]:
    """The vertical's share as in `LEVEL_START` after `dt_s` in which the IMU turns and tilts."""
    back, half = cmath.exp(-1j * turn_rad), cmath.exp(-0.5j * turn_rad)
    now, by_start, by_bias = up
    return now * back + 1j * tilt_rad * half, by_start * back, by_bias * back + 1j * dt_s * half
