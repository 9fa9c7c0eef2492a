"""Heading and position of the start: dead reckoning laid on the fixes."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import MotionSegment, dead_reckoned
from terrafusion.fusion.calibration.numbers import ANTENNA_X, ANTENNA_Y, GNSS_DELAY, GYRO_BIAS, NUMBERS
from terrafusion.fusion.estimator.alignment import KnownStart, Start
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.validation import GnssFix

Complex = NDArray[np.complex128]

LEAST_RATIO = 0.3
"""Driven over dead-reckoned distance below which the robot is stuck and shows no heading."""
UNKNOWN_YAW_RAD = np.pi / np.sqrt(3.0)
"""1 sigma of a heading of which nothing is known: uniform over the circle."""
SLIP_SIGMA = 0.05
"""Relative error of wheel speed against GNSS velocity (assumed)."""
HALF_S = 0.1
"""Half of the time over which a speed is taken."""
DELAYS = (-1.0, 1.0, 2.0)
"""Delays of the fixes that are tried, in sigmas."""
LEAST_APART_S = 1e-3
"""Fixes are at least so far apart in time: of two with the same stamp the correlation has no inverse."""


@dataclass(frozen=True, eq=False)
class MotionDoubt:
    """What else than white noise of the fixes turns the path that they show.

    Attributes:
        numbers: (9, 9) covariance of `NUMBERS` about those that sensors are corrected by.
        drift_share: share of a fix's variance that drifts, with `drift_time_s` as correlation time.
    """

    numbers: Array
    drift_share: float
    drift_time_s: float


@dataclass(frozen=True, eq=False)
class MotionStart:
    """What fixes and dead reckoning show of the start.

    Attributes:
        start: place and heading; the sigma of the place leaves it to the fixes, which the graph uses again.
        random_rad: the part of the heading's sigma that more fixes reduce.
        place_sigma_m: of the place alone, for a graph that does not use these fixes.
    """

    start: Start
    random_rad: float
    place_sigma_m: float

    def fixes_decide(self) -> bool:
        """Whether the noise of the fixes is most of the heading's variance."""
        return 2.0 * self.random_rad**2 >= self.start.yaw_sigma_rad**2

    def alone(self) -> KnownStart:
        """The start for a graph that does not use these fixes."""
        start = self.start
        return KnownStart(start.position_m, start.yaw_rad, self.place_sigma_m, start.yaw_sigma_rad)


EXACT = MotionDoubt(np.zeros((len(NUMBERS), len(NUMBERS))), 0.0, 1.0)
"""Everything but the fixes' white noise is known."""


def heading_from_motion(
    imu: ImuStream,
    wheels: WheelStream,
    fixes: list[GnssFix],
    level: Start,
    antenna_m: Array,
    ahead_m: float = 0.0,
    doubt: MotionDoubt = EXACT,
    steering: SteeringStream | None = None,
) -> MotionStart | None:
    """Turn and shift dead reckoning onto the fixes, and its speed onto their velocities, by least squares.

    Positions and velocities show the same turn, so their sums add up (see `planar_alignment`).

    Args:
        antenna_m: lever arm (3,), body, m.
        ahead_m: of the `Rig`.
        steering: its angles; None for wheels that all roll ahead.

    Returns:
        the start. Where the fixes hardly move though the wheels do, the heading is unknown. None with fewer
        than three fixes, or while neither has moved.
    """
    times = wheels.t_ns[bisect.bisect_left(wheels.t_ns, level.t_ns) :]
    inside = [f for f in fixes if times and level.t_ns <= f.t_ns <= min(times[-1], imu.t_ns[-1])]
    if len(inside) < 3 or len(times) < 3:
        return None
    t_fix = np.array([f.t_ns - level.t_ns for f in inside], dtype=float) * 1e-9
    lever = complex(ahead_m + antenna_m[0], antenna_m[1])
    path = _antenna_path(imu, wheels, level, lever, steering)
    z, z_dot = path.at(t_fix), (path.at(t_fix + HALF_S) - path.at(t_fix - HALF_S)) / (2.0 * HALF_S)
    g = np.array([f.enu_m[0] + 1j * f.enu_m[1] for f in inside])
    sigma_m = np.array([np.sqrt(f.sigma_m[0] * f.sigma_m[1]) for f in inside])
    mean_of, mean_variance, pull = _weights(z, t_fix, sigma_m, doubt)
    turn, information = complex(pull @ g), float((pull @ z).real)
    # Where the receiver's noise is all white after all, these weights are not the best ones.
    variance = max(information, float((np.abs(pull * sigma_m) ** 2).sum()))
    for fix, v in zip(inside, z_dot.tolist(), strict=True):
        if fix.velocity_mps is not None and np.isfinite(fix.velocity_mps[:2].sum() + fix.sigma_v_mps):
            w = 1.0 / (max(fix.sigma_v_mps, 1e-3) ** 2 + (SLIP_SIGMA * abs(v)) ** 2)
            turn += w * np.conj(v) * complex(fix.velocity_mps[0], fix.velocity_mps[1])
            information += w * abs(v) ** 2
            variance += w * abs(v) ** 2
    if information <= 0.0:
        return None
    yaw = float(np.angle(turn))
    origin = complex(mean_of @ (g - np.exp(1j * yaw) * z))
    off = _excess(g - origin - np.exp(1j * yaw) * z, z - mean_of @ z, sigma_m)
    body = origin + ahead_m * np.exp(1j * yaw)
    heights = np.array([f.enu_m[2] for f in inside])
    height = float(np.nanmean(heights)) - antenna_m[2] if np.isfinite(heights).any() else 0.0
    stuck, shown = abs(turn) < LEAST_RATIO * information, max(abs(turn), LEAST_RATIO * information)
    # Fixes that move further than the wheels do not show the heading better.
    random = UNKNOWN_YAW_RAD if stuck else off * variance**0.5 / min(shown, information)
    sigma_rad = _yaw_sigma(path, pull, t_fix, shown, random, doubt.numbers)
    mean_m = off * np.sqrt(max(mean_variance, float(((mean_of * sigma_m) ** 2).sum())))
    start = dataclasses.replace(
        level,
        position_m=np.array([body.real, body.imag, height]),
        position_sigma_m=float(5.0 * off * sigma_m.min()) + 0.05,
        yaw_rad=yaw,
        yaw_sigma_rad=sigma_rad,
    )
    return MotionStart(start, random, float(np.hypot(mean_m, sigma_rad * abs(mean_of @ z))))


def _yaw_sigma(
    path: AntennaPath, pull: Complex, t_s: Array, shown: float, random_rad: float, numbers: Array
) -> float:
    """1 sigma of the heading, rad: `random_rad`, and what delay and numbers (9, 9) turn the path by."""
    by_numbers = (pull @ path.by_numbers(t_s)).imag / shown
    by_delay = _turned_by_delay(path, pull, t_s, float(np.sqrt(numbers[GNSS_DELAY, GNSS_DELAY])))
    sigma_rad = float(np.sqrt(random_rad**2 + by_delay**2 + by_numbers @ numbers @ by_numbers))
    return min(sigma_rad, UNKNOWN_YAW_RAD)


def _weights(z: Complex, t_s: Array, sigma_m: Array, doubt: MotionDoubt) -> tuple[Array, float, Complex]:
    """Weights of fixes (F,) for their mean, its variance, and weights for the turn of the path z (F,) onto
    them, times its information.

    Generalised least squares: a share of a fix's variance is white, the rest a Gauss-Markov process (Aitken
    1935, Proc. R. Soc. Edinburgh 55, 42).
    """
    one = (_decorrelated((1.0 / sigma_m).astype(complex), t_s, doubt) / sigma_m).real
    mean_of: Array = one / one.sum()
    pull = _decorrelated((z - mean_of @ z) / sigma_m, t_s, doubt).conj() / sigma_m
    return mean_of, float(1.0 / one.sum()), pull


def _decorrelated(x: Complex, t_s: Array, doubt: MotionDoubt) -> Complex:
    """Inverse correlation matrix of the fixes' errors times x (F,).

    A Gauss-Markov process has a tridiagonal inverse Q, and (w I + s Q^-1)^-1 = (I - (I + w Q / s)^-1) / w.
    """
    share, white = doubt.drift_share, 1.0 - doubt.drift_share
    if share == 0.0:
        return x
    kept = np.exp(-np.maximum(np.diff(t_s), LEAST_APART_S) / doubt.drift_time_s)
    new = 1.0 - kept**2
    Q = np.zeros((2, len(x)))
    Q[0, 1:] = -kept / new
    Q[1] = np.concatenate([[1.0], 1.0 / new]) + np.concatenate([kept**2 / new, [0.0]])
    system = white / share * Q
    system[1] += 1.0
    return np.asarray((x - solveh_banded(system, x)) / white)


def _excess(left_m: Complex, from_mean: Complex, sigma_m: Array) -> float:
    """Root mean square of what the fixes leave over their sigma and slip, at least 1.

    Sigmas are scaled by it where fixes disagree (Birge ratio; Birge 1932, Phys. Rev. 40, 207).
    """
    squares = np.abs(left_m) ** 2 / (2.0 * (sigma_m**2 + (SLIP_SIGMA * np.abs(from_mean)) ** 2))
    return max(1.0, float(np.sqrt(squares.sum() / (len(left_m) - 2))))


def _turned_by_delay(path: AntennaPath, pull: Complex, t_s: Array, sigma_s: float) -> float:
    """1 sigma of the turn that fixes show if their delay is `sigma_s`: the most that any of `DELAYS` turns
    them by a sigma, since a robot that turns on the spot shows another heading a second later.
    """
    shown = [complex(pull @ path.at(t_s - k * sigma_s)) for k in (0.0, *DELAYS)]
    turns = np.angle(np.array(shown[1:]) * np.conj(shown[0]))
    return float(np.max(np.abs(turns) / np.abs(DELAYS)))


@dataclass(frozen=True, eq=False)
class AntennaPath:
    """Dead-reckoned path of the antenna, yaw 0 at the start.

    Attributes:
        t_s: (N,) from the start.
        place: (N,) m.
        by: (N, 9) derivatives by `NUMBERS`, but for the delay of the fixes.
    """

    t_s: Array
    place: Complex
    by: Complex

    def at(self, t_s: Array) -> Complex:
        """Places at times (F,)."""
        return np.asarray(np.interp(t_s, self.t_s, self.place))

    def by_numbers(self, t_s: Array) -> Complex:
        """Derivatives (F, 8) at times (F,)."""
        return np.stack([np.interp(t_s, self.t_s, column) for column in self.by.T], axis=1)


def _antenna_path(
    imu: ImuStream, wheels: WheelStream, level: Start, lever: complex, steering: SteeringStream | None
) -> AntennaPath:
    """The path since the start.

    The ground is taken for a plane: the path in it is projected by the attitude of the start.
    """
    t_imu, gyro, _ = imu.window(level.t_ns, imu.t_ns[-1] + 1)
    measured = np.concatenate([[0.0], np.cumsum(gyro[1:, 2] * np.diff(t_imu))])
    begin = bisect.bisect_left(wheels.t_ns, level.t_ns)
    t_ns = wheels.t_ns[begin:]
    t_s = np.array([t - level.t_ns for t in t_ns], dtype=float) * 1e-9
    distance = 0.5 * (np.array(wheels.left_m[begin:]) + np.array(wheels.right_m[begin:]))
    turns = np.diff(np.interp(t_s, t_imu, measured))
    ahead, course = np.diff(distance), None
    if steering is not None and steering.t_ns:
        course = np.array([steering.course_rad(a, b) for a, b in itertools.pairwise(t_ns)])
        ahead = ahead * np.cos(course)
    drive = MotionSegment(t_s, ahead, turns, course_rad=course)
    numbers = np.zeros(len(NUMBERS))
    numbers[GYRO_BIAS] = level.gyro_bias_radps[2] if level.gyro_bias_radps is not None else 0.0
    path = dead_reckoned(drive, numbers)
    heading = np.exp(1j * path.yaw_rad)
    by = path.z_by + (1j * lever * heading)[:, None] * path.yaw_by
    by[:, ANTENNA_X], by[:, ANTENNA_Y] = heading, 1j * heading
    if level.gyro_bias_radps is not None:
        by[:, GYRO_BIAS] = 0.0
    return AntennaPath(t_s, _flattened(path.z, level) + lever * heading, by)


def _flattened(path: Complex, level: Start) -> Complex:
    """Horizontal part of a path in the plane the robot stands on, axes as at the start."""
    roll, pitch = level.roll_rad, level.pitch_rad
    across = np.cos(roll) * path.imag
    return np.asarray(np.cos(pitch) * path.real + np.sin(pitch) * np.sin(roll) * path.imag + 1j * across)
