"""Self-calibration as the estimator uses it: which numbers it learns, and where they go."""

from __future__ import annotations

import dataclasses
import math
from collections import deque

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.robot import SKIDDING, SensorNumbers
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    COURSE_LAG,
    GNSS_DELAY,
    GYRO_BIAS,
    IMITATED,
    NUMBERS,
    TURN_SCALE,
    WHEEL_SCALE,
    Knowledge,
    assumed,
    known_before,
)
from terrafusion.fusion.calibration.online import SelfCalibration
from terrafusion.fusion.calibration.place_belief import (
    PLACE,
    REFUTED_SIGMA,
    TIMELY_SIGMA_S,
    PlaceBelief,
    unrefuted,
)
from terrafusion.fusion.calibration.reduction import Noise
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.corrections import Corrections
from terrafusion.fusion.estimator.alignment import Start
from terrafusion.fusion.estimator.gnss import WHITE_SHARE, GnssUpdater
from terrafusion.fusion.estimator.imu_level import LEVEL
from terrafusion.fusion.estimator.imu_mounting import ImuMounting
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.kept import Kept
from terrafusion.fusion.graph.key_state import LINEAR, NAV, KeyState
from terrafusion.fusion.graph.slow_states import SLIP_STEADY
from terrafusion.fusion.inputs.streams import ImuSegment, ImuStream
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.weighting.adaptive import TerrainNoise

GROUND_LAG_SIGMA_S = 0.1
"""Spread of the course lag between grounds (assumed; a Warthog's is 0.0 s on sand, 0.1 to 0.3 s on asphalt,
grass and gravel: study `course_lag`)."""
SLIP_SPREAD = 0.05
"""Spread of slip between stretches of some tens of metres before any is driven (assumed)."""
LEAST_SLIP_SIGMA = 0.02
"""Least sigma of learned slip: the next ground may be another one (assumed)."""
GYRO_DENSITY_RADPS, WHEEL_TURN_SHARE = 3e-3, 0.1
"""Noise of the turn over seconds, beyond what a bias explains (assumed)."""
TURN_TIME_S = 10.0
"""Duration of a turn in one direction, over which a wrong scale adds up without fixes (assumed)."""


ANTENNA_STATES = [NAV.stop + LINEAR.index(name) for name in ("antenna_x_m", "antenna_y_m")]
"""Of `--calibrate`, in a keyframe."""
CORRECTED = [TURN_SCALE, ANTENNA_X, ANTENNA_Y, GNSS_DELAY]
"""Numbers that correct a sensor; the others only describe its noise or belong to another state."""
LEAST_CORRECTION = np.array([0.008, 0.15, 0.15, 0.1])
"""Corrections below these (turn share, m, m, s) are left to the noise: side-slip and a wandering centre of
rotation look alike (assumed)."""
SLIP_IMITATES = np.array([0.0, 0.0, *IMITATED[[ANTENNA_Y, GNSS_DELAY]]])
"""What wheels that skid make of a drive, for residuals with the variance of their noise and as much again; a
correction is twice that. The place ahead is seen in every turn."""
MOST_SPREAD = 0.1
"""Spread of slip beyond which the wheels do not roll, and a skid looks like a delay (assumed)."""
SKID_DETECTION_NS, STEPS_KEPT = 15_000_000_000, 8
"""A skid shows within this time (assumed); so many steps of learning reach further back."""
LEAST_LATE_S, LEAST_LATE_TURNING_S, TURNING_RAD, MOST_MISFIT = 0.3, 0.15, 3.0, 10.0
"""Fixes later than the first (wheels that spin look less late), or than the second where the robot turned by
so much, another antenna or another gyro can look like a skid; they explain it if the fixes then lie within
about three of their sigma: a skid leaves a hundred and more (assumed)."""
UNMODELLED_SIGMA = np.array([0.0, 0.03, 0.03, TIMELY_SIGMA_S])
"""1 sigma of what slip adds to these numbers on any ground (turn share, m, m, s; assumed)."""
CLEAR_SIGMA, STILL_CLEAR = np.array([5.0, 5.0, 5.0, 4.0]), 0.5
"""A correction begins where a number differs by so many sigma from what was known, and ends at half of them:
the sigmas hold for rolling wheels and a receiver with white noise and drift, and are too small for others."""


@dataclasses.dataclass(frozen=True)
class NumberAfterDrive:
    """A number after a drive, its 1 sigma before and after; `corrects`: a sensor is corrected by it."""

    state: str
    value: float
    sigma: float
    prior_sigma: float
    corrects: bool


class LearnedNumbers:
    """The numbers that an estimator learns, and the sensors that they correct.

    Attributes:
        calibration: None where it is switched off, or there is nothing to learn from.
        mounting: the angle of the IMU.
    """

    def __init__(
        self, config: EstimatorConfig, imu: ImuStream, gnss: GnssUpdater, weights: TerrainNoise
    ) -> None:
        known, prior = config.rig.known, prior_of(config)
        self.calibration = _calibration(config, prior)
        self._imu, self._gnss, self._weights = imu, gnss, weights
        self.mounting = ImuMounting(config, imu, gnss.skid)
        self._spec = config.rig.sensors.imu
        self._bias_radps = float(prior.mean[GYRO_BIAS])
        self._before, self._clear = prior, np.zeros(len(CORRECTED), dtype=bool)
        self._known, self._skids = prior, config.rig.drive in SKIDDING
        self._place, self._moments = Kept[PlaceBelief](), Kept[Array]()
        self._before_skid: Knowledge | None = None
        self._past = deque[tuple[int, Knowledge]](maxlen=STEPS_KEPT)
        if known != SensorNumbers():
            self._apply(prior, 0, known.wheel_scale is not None)

    def start_from(self, prior: Knowledge) -> None:
        """Begin with what earlier runs of the robot gave."""
        if self.calibration is not None:
            self.calibration.start_from(prior)
            self._before = self._known = prior
            self._bias_radps = float(prior.mean[GYRO_BIAS])
            self._apply(prior, 0)

    def with_known(self, point: KeyState, sigmas: Array, start: Start) -> tuple[KeyState, Array]:
        """The first state and its 1 sigmas (DIM,), with what is known: the gyro's bias of earlier
        runs where the robot did not stand to show it, and how well the antenna's place is known.
        """
        known = sigmas.copy()
        known[ANTENNA_STATES] = self._before.sigma[[ANTENNA_X, ANTENNA_Y]]
        if start.gyro_bias_radps is not None or self._bias_radps == 0.0:
            return point, known
        gyro = np.array([0.0, 0.0, self._bias_radps])
        return dataclasses.replace(point, bias=gtsam.imuBias.ConstantBias(np.zeros(3), gyro)), known

    def fix(self, fix: GnssFix) -> None:
        """A fix as it came."""
        if self.calibration is not None:
            self.calibration.fix(fix.t_ns, fix.enu_m, fix.horizontal_sigma_m)
        self.mounting.level.fix(fix, self._gnss.scale)

    def keyframe(
        self,
        chain: Chain,
        dt_s: float,
        rolled_m: float | None,
        course_rad: float,
        gyro_radps: Array,
        accel_mps2: Array,
    ) -> None:
        """Take the motion of `dt_s` up to the newest keyframe.

        Args:
            rolled_m: mean distance of the wheels; None where samples of wheels or IMU are missing.
            course_rad: of the wheels, as steered, from the body's x axis.
            gyro_radps, accel_mps2: (3,) mean readings, corrected.
        """
        if self.calibration is not None:
            turn_rad = float(gyro_radps[2]) * dt_s
            self._drive(self.calibration, chain, rolled_m, turn_rad, course_rad)
        self.mounting.keyframe(chain, dt_s, rolled_m, gyro_radps, accel_mps2)

    def _drive(
        self,
        learning: SelfCalibration,
        chain: Chain,
        rolled_m: float | None,
        turn_rad: float,
        course_rad: float,
    ) -> None:
        if self._gnss.local:
            learning.restart()
            return
        skid = self._gnss.skid
        if skid.friction is not None and skid.friction.leads:
            self._forget(self._before_skid or self._untouched(chain, learning))
            return
        self._handle_skid(chain, learning, skid.rate_m2ps > 0.0)
        pose, measured = chain.state(chain.last).pose, turn_rad / (1.0 + self._imu.turn_scale)
        t_ns, place = chain.nodes[-1].t_ns, np.asarray(pose.translation())
        learning.drive(t_ns, rolled_m, measured, place, pose.rotation().yaw(), course_rad)

    def advance(self, chain: Chain) -> None:
        """A slice of learning's work; correct the sensors from the newest keyframe on when it gives new
        numbers.
        """
        learning = self.calibration
        if learning is None or not learning.advance():
            return
        if self._before_skid is not None and not self._explained(learning):
            return
        self._known, t_ns, gnss = learning.known, chain.nodes[-1].t_ns, self._gnss
        self._past.append((t_ns, self._known))
        antenna_m, delay_s = gnss.antenna_m, gnss.delay_s
        self._apply(self._known, t_ns)
        speed_mps = float(np.linalg.norm(chain.state(chain.last).velocity))
        moved_m = math.hypot(*(gnss.antenna_m - antenna_m)[:2], speed_mps * (gnss.delay_s - delay_s))
        if moved_m > learning.usual_sigma_m:
            _doubt_place(chain, moved_m)

    def course_lag_s(self) -> tuple[float, float]:
        """Time by which the course follows the heading, and its 1 sigma on other grounds; see `numbers`."""
        rolls = self._known.slip_spread < MOST_SPREAD
        learned_s = float(self._known.mean[COURSE_LAG]) if rolls else 0.0
        return learned_s, GROUND_LAG_SIGMA_S if self._skids else 0.0

    def table(self) -> tuple[NumberAfterDrive, ...]:
        """What is known of each number now, but for the gyro's bias, of which the chain knows more."""
        numbers = [] if self.calibration is None else self._of_fixes(self.calibration.prior)
        if self.mounting.learns:
            angle, before = self.mounting.known, self.mounting.before
            sigmas = angle.sigma_rad, before.sigma_rad
            numbers.append(NumberAfterDrive("imu_yaw_rad", angle.rad, *sigmas, self.mounting.corrects))
            level = self.mounting.level
            for name, now, was, corrects in zip(
                LEVEL, level.known, level.before, level.corrects, strict=True
            ):
                numbers.append(NumberAfterDrive(name, now.rad, now.sigma_rad, was.sigma_rad, corrects))
        return tuple(numbers)

    def place_moments(self) -> Array:
        """Second moments (4,) of the errors of antenna x, y, delay and course lag in use, m2 and s2.

        Of the lag, those on the grounds that were driven; its spread between grounds is in the graph.
        """
        gnss = self._gnss

        def moments() -> Array:
            x_m, y_m, _ = (gnss.antenna_m - gnss.nominal_antenna_m).tolist()
            return self._moments_about(np.array([x_m, y_m, gnss.delay_s]))

        return self._moments.of((self._known, gnss.antenna_m, gnss.delay_s), moments)

    def past_place_moments(self, t_ns: TimesNs) -> Array:
        """The same (N, 4) of those that were in use at the times (N,), by what is known now."""
        lever_m, late_s = self._gnss.antenna_places.used(t_ns)
        return self._moments_about(np.column_stack([(lever_m - self._gnss.nominal_antenna_m)[:, :2], late_s]))

    def _moments_about(self, used: Array) -> Array:
        """Moments (..., 4) about corrections (..., 3) of antenna and delay."""
        if self.calibration is None:
            return np.zeros((*used.shape[:-1], 4))
        corrected = self._clear[[CORRECTED.index(number) for number in PLACE]]
        place = self._place.of((self._known,), lambda: PlaceBelief.of(self._known, self._before, corrected))
        lag_s, lag_sigma_s = self._known.mean[COURSE_LAG], self._known.sigma[COURSE_LAG]
        lag_s2 = (lag_s - self.course_lag_s()[0]) ** 2 + lag_sigma_s**2
        return np.concatenate([place.moments(used), np.full((*used.shape[:-1], 1), lag_s2)], axis=-1)

    def corrections(self) -> Corrections:
        """What the drive refuted of the robot's numbers."""
        numbers = frozenset(number.state for number in self.table() if number.corrects)
        mounting, places = self.mounting, self._gnss.antenna_places
        sigma_rad = mounting.known.sigma_rad if mounting.learns else None
        since_ns, delay_s = mounting.corrects_since_ns, self._uncorrected_delay_s()
        return Corrections(numbers, since_ns, sigma_rad, places, delay_s)

    def _uncorrected_delay_s(self) -> tuple[float, float] | None:
        if self.calibration is None or self._clear[CORRECTED.index(GNSS_DELAY)]:
            return None
        known, at = self._known, CORRECTED.index(GNSS_DELAY)
        delay_s = known.mean[GNSS_DELAY] - self._before.mean[GNSS_DELAY]
        slip_s = math.sqrt(known.misfit - 1.0) * SLIP_IMITATES[at] if self._skids else 0.0
        return float(delay_s), math.hypot(float(known.sigma[GNSS_DELAY]), slip_s)

    def _of_fixes(self, prior: Knowledge) -> list[NumberAfterDrive]:
        mean, sigma = self._known.mean.tolist(), self._known.stated_sigma(prior).tolist()
        corrects = dict(zip(CORRECTED, self._clear.tolist(), strict=True))
        return [
            NumberAfterDrive(name, mean[i], sigma[i], float(prior.sigma[i]), corrects.get(i, False))
            for i, name in enumerate(NUMBERS)
            if i != GYRO_BIAS
        ]

    def _handle_skid(self, chain: Chain, learning: SelfCalibration, skids: bool) -> None:
        """Keep what was known before a skid, or before wrong numbers that look like one.

        Where other numbers explain it, learning goes on; after a skid it begins again.
        """
        if skids and self._before_skid is None:
            self._before_skid = self._untouched(chain, learning)
        elif not skids and self._before_skid is not None:
            if not self._explained(learning):
                self._forget(self._before_skid)
            self._before_skid = None

    def _untouched(self, chain: Chain, learning: SelfCalibration) -> Knowledge:
        """What was known before a skid that shows now began."""
        until_ns = chain.nodes[-1].t_ns - SKID_DETECTION_NS
        return next((known for t_ns, known in reversed(self._past) if t_ns <= until_ns), learning.before)

    def _explained(self, learning: SelfCalibration) -> bool:
        """Whether other numbers of a robot with rolling wheels explain a drive that looks like a skid."""
        known = learning.known
        if known.misfit > MOST_MISFIT or known.slip_spread > MOST_SPREAD:
            return False
        least = np.maximum(REFUTED_SIGMA * known.sigma[CORRECTED], LEAST_CORRECTION)
        turning = learning.turned_rad > TURNING_RAD
        least[CORRECTED.index(GNSS_DELAY)] = LEAST_LATE_TURNING_S if turning else LEAST_LATE_S
        return bool((np.abs(known.mean - self._before.mean)[CORRECTED] > least).any())

    def _forget(self, known: Knowledge) -> None:
        self._before_skid, self._known = None, known
        self._past.clear()
        if self.calibration is not None:
            self.calibration.restart(known)

    def heading_turned(self) -> None:
        """The heading was wrong, and what was learned with it may be, too."""
        if self.calibration is not None:
            self._forget(self.calibration.before)

    def with_doubt(self, noise: SensorNoise, t_ns: int, segments: list[ImuSegment]) -> SensorNoise:
        """Noise of the yaw rate, up to a keyframe at `t_ns`, with the doubt of its scale: its sigma, and what
        the scale seems wrong by but not clearly enough to be corrected.
        """
        if self.calibration is None:
            return noise
        last_ns = self._gnss.last_used_ns
        unaided_s = math.inf if last_ns is None else max(t_ns - last_ns, 0) * 1e-9
        off = float(self._known.mean[TURN_SCALE]) - self._imu.turn_scale
        doubt = math.hypot(float(self._known.sigma[TURN_SCALE]), off)
        return with_turn_doubt(noise, doubt, segments, self._spec, unaided_s)

    def _apply(self, known: Knowledge, t_ns: int, slip: bool = True) -> None:
        turn_scale, x_m, y_m, delay_s = self._corrections(known).tolist()
        self._imu.turn_scale = turn_scale
        self._gnss.correct(t_ns, np.array([x_m, y_m]), delay_s)
        if not slip:
            return
        doubt = math.hypot(known.slip_spread, float(known.sigma[WHEEL_SCALE]))
        mean, time_s = -float(known.mean[WHEEL_SCALE]), known.slip_time_s / SLIP_STEADY
        self._weights.learn_slip(mean, max(doubt, LEAST_SLIP_SIGMA), time_s, t_ns)

    def _corrections(self, known: Knowledge) -> Array:
        """The numbers (4,) of `CORRECTED`: as known before, but where the drive clearly shows others.

        At one speed an antenna further ahead and fixes that come earlier look alike: what is shown
        is conditional on those numbers being as before that the drive does not refute.
        """
        off, sigma = known.mean - self._before.mean, known.sigma
        corrected, size = self._before.mean[CORRECTED], np.abs(off[CORRECTED])
        limit = np.where(self._clear, STILL_CLEAR, 1.0) * CLEAR_SIGMA
        limit = limit * np.hypot(sigma[CORRECTED], UNMODELLED_SIGMA)
        rolling = known.slip_spread < MOST_SPREAD
        least = LEAST_CORRECTION
        if self._skids:
            least = np.maximum(least, 2.0 * math.sqrt(known.misfit - 1.0) * SLIP_IMITATES)
        self._clear = clear = (size > limit) & (size > least) & rolling
        shown = [i for i, is_clear in zip(CORRECTED, clear.tolist(), strict=True) if is_clear]
        corrected[clear], _ = known.given(shown, unrefuted(known, self._before, shown), self._before)
        return corrected


def _doubt_place(chain: Chain, moved_m: float) -> None:
    """Let the next fixes move the newest place by what a new antenna or delay has shifted them."""
    doubt = np.zeros(chain.dim)
    doubt[3:5] = moved_m**2
    chain.restart(doubt)


def prior_of(config: EstimatorConfig) -> Knowledge:
    """What is known of the robot before it drives."""
    yaw, bias_sigma = config.inputs.yaw, config.rig.sensors.imu.gyro_bias_sigma_radps
    slip_time_s = SLIP_STEADY * config.policy.fixed.slip_time_s
    skids = config.rig.drive in SKIDDING
    wide = assumed(bias_sigma, yaw in ("wheels", "steering"), SLIP_SPREAD, slip_time_s, skids)
    return known_before(config.rig.known, wide, yaw)


def _calibration(config: EstimatorConfig, prior: Knowledge) -> SelfCalibration | None:
    inputs, sensors = config.inputs, config.rig.sensors
    if not config.self_calibrate or config.calibrate or not inputs.gnss or inputs.yaw == "none":
        return None
    wheels = inputs.yaw in ("wheels", "steering")
    noise = Noise(
        GYRO_DENSITY_RADPS,
        WHEEL_TURN_SHARE if wheels else 0.0,
        1.0 - WHITE_SHARE,
        max(sensors.gnss.correlation_time_s, 1.0),
        config.rig.drive in SKIDDING,
    )
    antenna_m = complex(*sensors.gnss.antenna_m[:2]) + config.rig.ahead_m
    return SelfCalibration(prior, noise, antenna_m)


def with_turn_doubt(
    noise: SensorNoise, doubt: float, segments: list[ImuSegment], imu: ImuSpec, unaided_s: float
) -> SensorNoise:
    """Noise of a keyframe's yaw rate with the `doubt` of its scale, 1 sigma, `unaided_s` after the last fix.

    In a steady turn at rate w an error s of the scale turns the heading by s w t; white noise of density
    sqrt(2 t) s w gives the same variance at every t.
    """
    total = sum([s.dt_s for s in segments])
    turn = sum([float(s.gyro_radps[2]) * s.dt_s for s in segments])
    rate = abs(turn) / total if total > 0.0 else 0.0
    grown = math.sqrt(min(2.0 * unaided_s, TURN_TIME_S))
    more = doubt * rate * grown / imu.gyro_noise_radps_sqrthz
    if more < 0.1 * noise.gyro_yaw_inflation:
        return noise
    return dataclasses.replace(noise, gyro_yaw_inflation=math.hypot(noise.gyro_yaw_inflation, more))
