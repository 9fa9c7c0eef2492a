"""The numbers of a robot that its own fixes determine, and their priors."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import erfcx

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.robot import LENGTH_SIGMA_M, KnownNumber, SensorNumbers, antenna_spread_m

NUMBERS = (
    "turn_scale",
    "gyro_bias_radps",
    "wheel_scale",
    "antenna_x_m",
    "antenna_y_m",
    "gnss_delay_s",
    "wheel_delay_s",
    "course_lag_s",
    "slip_per_grade",
)
"""In the order of every vector of numbers:

- turn_scale: true turn over that of its source (gyro z, or the wheels over the track), less one.
- gyro_bias: mean reading of the source of yaw without any turn; while a drive is learned from, that at its
  first node, about which it wanders.
- wheel_scale: true distance over that of the wheels, less one; slip of the usual ground included.
- antenna: correction of the lever arm, body x and y.
- gnss_delay, wheel_delay: lateness of the stamps against those of the source of yaw. Wheels that slip while
  they accelerate are ahead of the robot, as if they were early.
- course_lag: time by which the course follows the heading: in a turn at rate w a robot drifts outwards by
  the angle course_lag w.
- slip_per_grade: additional slip over the sine of the slope, uphill positive."""
TURN_SCALE, GYRO_BIAS, WHEEL_SCALE, ANTENNA_X, ANTENNA_Y, GNSS_DELAY, WHEEL_DELAY, COURSE_LAG = range(8)
SLIP_PER_GRADE = 8

GYRO_SCALE_SIGMA, SKID_TURN_SIGMA, ROLL_TURN_SIGMA = 0.015, 0.35, 0.15
"""Prior of the turn scale: a gyro's scale factor (MEMS data sheets: 0.5 to 2 %, with a tilted mounting), that
of wheels that skid in a turn about its usual value (0.44 to 0.71 measured), and of wheels that roll (assumed:
what the file says of track, wheelbase and radii)."""
LEAST_BIAS_SIGMA_RADPS = 0.005
"""Least prior of the gyro's bias: data sheets give it at one temperature."""
WHEEL_SCALE_SIGMA = 0.05
"""Tyre pressure, wear, a nominal radius, and the mean slip of the ground (assumed)."""
GNSS_DELAY_SIGMA_S = 0.5
"""Receivers without a common clock report up to seconds late (assumed)."""
SKIDDING_WHEEL_SIGMA_S, ROLLING_WHEEL_SIGMA_S = 0.2, 0.05
"""Prior of the wheels' delay: a queue, and slip of wheels that accelerate (assumed; 0.1 to 0.4 s on skidding
robots of `unseen_robots` below seed 24)."""
SKIDDING_LAG_SIGMA_S, ROLLING_LAG_SIGMA_S = 0.15, 0.005
"""Course lag of wheels and tracks that skid in every turn (a Warthog's on asphalt, grass and gravel: 0.1 to
0.3 s, study `course_lag`), and of those that roll (assumed)."""
LEAST_GRADE_SIGMA = 0.1
"""The slip per grade that is expected is known to as much again, and no better than this (assumed; the
policy's grounds have 0.13 to 1.05)."""
NO_LAG_SIGMA_S = 1e-3
"""1 sigma with which a course lag that cannot be negative is held to 0 while a drive is learned from."""
IMITATED = np.array([0.003, 0.0, 0.0, 0.07, 0.07, 0.15, 0.0, 0.0, 0.0])
"""1 sigma of what a drive does to `NUMBERS` that no more driving averages out: a path that lags by slip looks
like late fixes, side-slip in turns like another antenna (set on robots of `unseen_robots` below seed 24)."""
COMMON_DELAY_S, TURN_SLIP_M = 0.1, 0.25
"""1 sigma of the two changes of `feigned_by_slip`: clean drives of the twin below seed 50 showed 0.1 to
0.5 s, and 0.03 to 0.2 m, more on mud. With more than 0.1 s an antenna 0.6 m off on asphalt is not seen."""
CHANGE_SIGMA, WHEEL_TURN_CHANGE = np.array([1e-3, 1e-3, 0.01, 0.0, 0.0, 0.02, 0.01, 0.05, 0.1]), 0.05
"""Changes from one run of a robot to the next: temperature, tyres and ground, receiver (assumed); and that of
the turn scale where there is no gyro."""


def feigned_by_slip(one_sided: float) -> Array:
    """Changes (9, 2) of `NUMBERS` that slip feigns, of 1 sigma each, on robots that skid in turns.

    Fixes and wheels that come later by as much as the course leads the heading leave the path as it is, to
    first order of the delays: what is left is smaller than slip. Wheels that slip in a turn by a length for
    each radian look, in turns to one side, like an antenna that is off to that side.

    Args:
        one_sided: turns to the left less those to the right over all turns, -1 to 1.
    """
    change = np.zeros((len(NUMBERS), 2))
    change[[GNSS_DELAY, WHEEL_DELAY, COURSE_LAG], 0] = np.array([1.0, 1.0, -1.0]) * COMMON_DELAY_S
    change[ANTENNA_Y, 1] = one_sided * TURN_SLIP_M
    return change


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Mean and covariance of `NUMBERS`, and how slip changes between stretches of ground.

    Attributes:
        mean: (9,).
        covariance: (9, 9).
        slip_spread: standard deviation of the distance ratio about `wheel_scale`.
        slip_time_s: correlation time of that ratio.
        misfit: variance of the fixes' residuals over that of their white noise; at least 1.
        clipped_lag_s: root mean square of a course lag that is 0 as it cannot be negative; 0 for any other.
    """

    mean: Array
    covariance: Array
    slip_spread: float
    slip_time_s: float
    misfit: float = 1.0
    clipped_lag_s: float = 0.0

    @functools.cached_property
    def sigma(self) -> Array:
        """1 sigma (9,), read-only."""
        sigma = np.sqrt(np.diag(self.covariance))
        sigma.flags.writeable = False
        return np.asarray(sigma)

    def outwards(self) -> Self:
        """With a course lag that is not negative: a robot that skids in a turn is carried outwards.

        Where the best one is negative, all numbers are as they are without any. What it may be all the same
        is a normal truncated at 0 (Johnson, Kotz, Balakrishnan 1994, sec. 10.1), here by its second moment.
        """
        lag_s, covariance = self.mean[COURSE_LAG], self.covariance
        if lag_s >= 0.0:
            return self
        off = -lag_s / self.sigma[COURSE_LAG]
        square = 1.0 + off**2 - off * math.sqrt(2.0 / math.pi) / erfcx(off / math.sqrt(2.0))
        clipped_s = max(self.clipped_lag_s, float(self.sigma[COURSE_LAG] * np.sqrt(max(square, 0.0))))
        gain = covariance[:, COURSE_LAG] / covariance[COURSE_LAG, COURSE_LAG]
        without = covariance - np.outer(gain, covariance[COURSE_LAG])
        without[COURSE_LAG, COURSE_LAG] = NO_LAG_SIGMA_S**2
        mean = self.mean - gain * lag_s
        return dataclasses.replace(self, mean=mean, covariance=without, clipped_lag_s=clipped_s)

    def given(self, rows: Sequence[int], held: Sequence[int], before: Self) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of the numbers `rows` if those `held` are as `before`."""
        covariance = self.covariance
        gain = covariance[np.ix_(rows, held)] @ np.linalg.pinv(covariance[np.ix_(held, held)])
        mean = self.mean[rows] - gain @ (self.mean - before.mean)[held]
        return mean, covariance[np.ix_(rows, rows)] - gain @ covariance[np.ix_(held, rows)]

    def with_covariance(self, covariance: Array, wide: Self) -> Self:
        """With another covariance (9, 9), scaled so that no number is known less well than in `wide`."""
        limit = np.minimum(np.diag(covariance), np.diag(wide.covariance))
        shrink = np.sqrt(limit / np.diag(covariance))
        return dataclasses.replace(self, covariance=covariance * np.outer(shrink, shrink))

    def stated_sigma(self, before: Self, misfit: float = 1.0) -> Array:
        """1 sigma (9,) with what slip imitates; at most that `before` the drive.

        That grows with the `misfit`: what slip leaves of the fixes' residuals is a measure of the rest.
        """
        sigma = np.hypot(self.sigma, math.sqrt(misfit) * IMITATED)
        sigma[COURSE_LAG] = max(sigma[COURSE_LAG], self.clipped_lag_s)
        return np.asarray(np.minimum(sigma, before.sigma))


def assumed(
    bias_sigma_radps: float,
    yaw_of_wheels: bool,
    slip_spread: float,
    slip_time_s: float,
    skids: bool = False,
    wheelbase_m: float = 0.0,
    slip_per_grade: float = 0.0,
) -> Knowledge:
    """What is known of a robot before it drives; `skids`: its wheels or tracks skid in every turn."""
    sigma = np.array(
        [
            (SKID_TURN_SIGMA if skids else ROLL_TURN_SIGMA) if yaw_of_wheels else GYRO_SCALE_SIGMA,
            max(bias_sigma_radps, LEAST_BIAS_SIGMA_RADPS),
            WHEEL_SCALE_SIGMA,
            antenna_spread_m(wheelbase_m),
            antenna_spread_m(wheelbase_m),
            GNSS_DELAY_SIGMA_S,
            SKIDDING_WHEEL_SIGMA_S if skids else ROLLING_WHEEL_SIGMA_S,
            SKIDDING_LAG_SIGMA_S if skids else ROLLING_LAG_SIGMA_S,
            max(abs(slip_per_grade), LEAST_GRADE_SIGMA),
        ]
    )
    mean = np.zeros(len(sigma))
    mean[SLIP_PER_GRADE] = slip_per_grade
    return Knowledge(mean, np.diag(sigma**2), slip_spread, slip_time_s)


def known_before(known: SensorNumbers, wide: Knowledge, yaw: str) -> Knowledge:
    """What is known of a robot that has some of its numbers; of the others, what is known `wide`.

    `yaw` is the source of the yaw rate, as of `SensorConfig`.
    """
    mean, sigma, change = wide.mean.copy(), wide.sigma.copy(), _change_sigma(yaw)
    for row, number in _rows(known, yaw).items():
        in_geometry = row in (ANTENNA_X, ANTENNA_Y) or number is known.yaw_factor  # which holds their values
        mean[row] = 0.0 if in_geometry else number.number
        if number.sigma is not None:
            sigma[row] = np.broadcast_to(number.sigma, 2)[1 if row == ANTENNA_Y else 0]
            if number is known.yaw_factor:
                sigma[row] /= number.number
            if number.known == "calibrated":
                sigma[row] = min(np.hypot(sigma[row], change[row]), wide.sigma[row])
        elif number.known in LENGTH_SIGMA_M:
            sigma[row] = LENGTH_SIGMA_M[number.known]
    return dataclasses.replace(wide, mean=mean, covariance=np.diag(sigma**2))


def antenna_sigma_m(known: SensorNumbers, wheelbase_m: float) -> tuple[float, float]:
    """1 sigma of the antenna's place, forward and to the left, before the robot drives."""
    wide = assumed(0.0, yaw_of_wheels=False, slip_spread=0.0, slip_time_s=1.0, wheelbase_m=wheelbase_m)
    sigma = known_before(known, wide, "gyro").sigma
    return float(sigma[ANTENNA_X]), float(sigma[ANTENNA_Y])


def _change_sigma(yaw: str) -> Array:
    change = CHANGE_SIGMA.copy()
    if yaw != "gyro":
        change[TURN_SCALE] = WHEEL_TURN_CHANGE
    return change


def _rows(known: SensorNumbers, yaw: str) -> dict[int, KnownNumber]:
    """The numbers that a robot has, by their row in `NUMBERS`."""
    rows = {
        TURN_SCALE: {"gyro": known.gyro_scale, "wheels": known.yaw_factor}.get(yaw),
        GYRO_BIAS: known.gyro_bias_radps if yaw == "gyro" else None,
        WHEEL_SCALE: known.wheel_scale,
        ANTENNA_X: known.antenna_m,
        ANTENNA_Y: known.antenna_m,
        GNSS_DELAY: known.gnss_delay_s,
        WHEEL_DELAY: known.wheel_delay_s,
        COURSE_LAG: known.course_lag_s,
        SLIP_PER_GRADE: known.slip_per_grade,
    }
    return {row: number for row, number in rows.items() if number is not None}


def for_the_next_run(known: Knowledge, wide: Knowledge, yaw: str) -> Knowledge:
    """What one run gave, as it is known of the next one; no number is known less well than in `wide`."""
    covariance = known.covariance + np.diag(_change_sigma(yaw) ** 2)
    covariance[COURSE_LAG, COURSE_LAG] += known.clipped_lag_s**2
    return dataclasses.replace(known.with_covariance(covariance, wide), clipped_lag_s=0.0)
