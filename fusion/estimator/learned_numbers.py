"""Self-calibration as the estimator uses it: which numbers it learns, and where they go."""

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
    GYRO_BIAS,
    NUMBERS,
    SLIP_PER_GRADE,
    TURN_SCALE,
    WHEEL_SCALE,
    Knowledge,
    assumed,
    known_before,
)
from terrafusion.fusion.calibration.online import SelfCalibration
from terrafusion.fusion.calibration.place_belief import PlaceBelief
from terrafusion.fusion.calibration.reduction import Noise
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.corrections import Corrections
from terrafusion.fusion.estimator.alignment import Start
from terrafusion.fusion.estimator.correction_rule import CORRECTED, CorrectionRule, wheels_roll
from terrafusion.fusion.estimator.fix_noise import WHITE_SHARE
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.estimator.imu_level import LEVEL
from terrafusion.fusion.estimator.imu_mounting import ImuMounting
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.kept import Kept
from terrafusion.fusion.graph.key_state import LINEAR, NAV, KeyState
from terrafusion.fusion.graph.slow_states import SLIP_STEADY
from terrafusion.fusion.inputs.streams import ImuSegment, ImuStream, mean_yaw_rate_radps
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
BIAS_WALK_RADPS = 1e-4
"""Random walk of the gyro's bias, rad/s/sqrt(s), as it warms up after power-on (assumed)."""
TURN_TIME_S = 10.0
"""Duration of a turn in one direction, over which a wrong scale adds up without fixes (assumed)."""
NEGLIGIBLE = 0.1
"""Share of the noise in use below which the doubt of the scale is left out."""
ANTENNA_STATES = [NAV.stop + LINEAR.index(name) for name in ("antenna_x_m", "antenna_y_m")]
"""Of `--calibrate`, in a keyframe."""


SKID_DETECTION_NS, STEPS_KEPT = 15_000_000_000, 8
"""A skid shows within this time (assumed); so many steps of learning reach further back."""


@dataclasses.dataclass(frozen=True)
class NumberAfterDrive:
    """A number after a drive, its 1 sigma before and after; `corrects`: a sensor is corrected by it."""

    state: str
    value: float
    sigma: float
    prior_sigma: float
    corrects: bool


class KnownBeforeSkid:
    """The last steps of learning, and what was known before the skid under way, in which wheels tell wrong
    numbers.

    Attributes:
        held: what was known before it; None while the robot does not skid.
    """

    def __init__(self) -> None:
        self.held: Knowledge | None = None
        self._steps = deque[tuple[int, Knowledge]](maxlen=STEPS_KEPT)

    def learned(self, t_ns: int, known: Knowledge) -> None:
        """A step of learning that ended at `t_ns`."""
        self._steps.append((t_ns, known))

    def at(self, t_ns: int, otherwise: Knowledge) -> Knowledge:
        """What was known before a skid that shows at `t_ns` began; `otherwise` if no step is as old."""
        until_ns = t_ns - SKID_DETECTION_NS
        return next((known for at_ns, known in reversed(self._steps) if at_ns <= until_ns), otherwise)

    def clear(self) -> None:
        """Learning begins anew."""
        self.held = None
        self._steps.clear()


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
        self._known, self._skids = prior, config.rig.drive in SKIDDING
        self._antenna_assumed = known.antenna_m is not None and known.antenna_m.known == "assumed"
        self._rule, self._before_skid = CorrectionRule(prior, self._skids), KnownBeforeSkid()
        self._place, self._moments = Kept[PlaceBelief](), Kept[Array]()
        if known != SensorNumbers():
            self._apply(prior, 0, known.wheel_scale is not None)

    def start_from(self, prior: Knowledge) -> None:
        """Begin with what earlier runs of the robot gave."""
        if self.calibration is not None:
            self.calibration.start_from(prior)
            self._known, self._rule = prior, CorrectionRule(prior, self._skids)
            self._apply(prior, 0)

    def with_known(self, point: KeyState, sigmas: Array, start: Start) -> tuple[KeyState, Array]:
        """The first state and its 1 sigmas (DIM,), with what is known: the gyro's bias of earlier
        runs where the robot did not stand to show it, and how well the antenna's place is known.
        """
        known, before = sigmas.copy(), self._rule.before
        known[ANTENNA_STATES] = before.sigma[[ANTENNA_X, ANTENNA_Y]]
        if start.gyro_bias_radps is not None or before.mean[GYRO_BIAS] == 0.0:
            return point, known
        gyro = np.array([0.0, 0.0, before.mean[GYRO_BIAS]])
        return dataclasses.replace(point, bias=gtsam.imuBias.ConstantBias(np.zeros(3), gyro)), known

    def fix(self, fix: GnssFix) -> None:
        """A fix as it came."""
        if self.calibration is not None:
            self.calibration.fix(fix.t_ns, fix.enu_m, fix.horizontal_sigma_m)
        self.mounting.level.fix(fix, self._gnss.fix_noise.scale)

    def keyframe(self, chain: Chain, mean: MeanMotion) -> None:
        """Take the motion up to the newest keyframe."""
        if self.calibration is not None:
            self._drive(self.calibration, chain, mean)
        self.mounting.keyframe(chain, mean)

    def _drive(self, learning: SelfCalibration, chain: Chain, mean: MeanMotion) -> None:
        if self._gnss.local:
            learning.restart()
            return
        skid = self._gnss.skid
        if skid.friction is not None and skid.friction.leads:
            self._forget(self._before_skid.held or self._untouched(chain, learning))
            return
        # A drift that moves too far makes a skid likely, late fixes and another antenna as well.
        self._handle_skid(chain, learning, skid.by_rejection)
        turn_rad = float(mean.gyro_radps[2]) * mean.dt_s / (1.0 + self._imu.turn_scale)  # as measured
        t_ns, pose = chain.nodes[-1].t_ns, chain.state(chain.last).pose
        place, yaw_rad = np.asarray(pose.translation()), pose.rotation().yaw()
        grade = float(pose.rotation().matrix()[2, 0])
        learning.drive(t_ns, mean.rolled_m, turn_rad, place, yaw_rad, mean.course_rad, grade)

    def advance(self, chain: Chain) -> None:
        """A slice of learning's work; new numbers correct the sensors from the newest keyframe on."""
        learning = self.calibration
        if learning is None or not learning.advance():
            return
        if self._before_skid.held is not None and not self._explained(learning):
            return
        self._known, t_ns, gnss = learning.known, chain.nodes[-1].t_ns, self._gnss
        self._before_skid.learned(t_ns, self._known)
        antenna_m, delay_s = gnss.antenna_m, gnss.delay_s
        self._apply(self._known, t_ns)
        speed_mps = float(np.linalg.norm(chain.state(chain.last).velocity))
        moved_m = math.hypot(*(gnss.antenna_m - antenna_m)[:2], speed_mps * (gnss.delay_s - delay_s))
        if moved_m > learning.usual_sigma_m:
            _doubt_place(chain, moved_m)

    def course_lag_s(self) -> tuple[float, float]:
        """Time by which the course follows the heading, and its 1 sigma on other grounds; see `numbers`."""
        learned_s = float(self._known.mean[COURSE_LAG]) if wheels_roll(self._known) else 0.0
        return learned_s, GROUND_LAG_SIGMA_S if self._skids else 0.0

    def table(self) -> tuple[NumberAfterDrive, ...]:
        """What is known of each number now, but for the gyro's bias, of which the chain knows more."""
        numbers = [] if self.calibration is None else self._of_fixes(self._rule.before)
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
        rule = self._rule
        place = self._place.of(
            (self._known,),
            lambda: PlaceBelief.of(self._known, rule.before, rule.clear_places, self._antenna_assumed),
        )
        lag_s, lag_sigma_s = self._known.mean[COURSE_LAG], self._known.sigma[COURSE_LAG]
        lag_s2 = (lag_s - self.course_lag_s()[0]) ** 2 + lag_sigma_s**2
        return np.concatenate([place.moments(used), np.full((*used.shape[:-1], 1), lag_s2)], axis=-1)

    def corrections(self) -> Corrections:
        """What the drive refuted of the robot's numbers."""
        numbers = frozenset(number.state for number in self.table() if number.corrects)
        mounting, places = self.mounting, self._gnss.antenna_places
        sigma_rad = mounting.known.sigma_rad if mounting.learns else None
        delay_s = None if self.calibration is None else self._rule.uncorrected_delay_s(self._known)
        return Corrections(numbers, mounting.corrects_since_ns, sigma_rad, places, delay_s)

    def _of_fixes(self, prior: Knowledge) -> list[NumberAfterDrive]:
        mean, sigma = self._known.mean.tolist(), self._known.stated_sigma(prior).tolist()
        corrects = dict(zip(CORRECTED, self._rule.clear.tolist(), strict=True))
        return [
            NumberAfterDrive(name, mean[i], sigma[i], float(prior.sigma[i]), corrects.get(i, False))
            for i, name in enumerate(NUMBERS)
            if i != GYRO_BIAS
        ]

    def _handle_skid(self, chain: Chain, learning: SelfCalibration, skids: bool) -> None:
        """Keep what was known before a skid, or before wrong numbers that look like one.

        Where other numbers explain it, learning goes on; after a skid it begins again.
        """
        before = self._before_skid
        if skids and before.held is None:
            before.held = self._untouched(chain, learning)
        elif not skids and before.held is not None:
            if not self._explained(learning):
                self._forget(before.held)
            before.held = None

    def _untouched(self, chain: Chain, learning: SelfCalibration) -> Knowledge:
        return self._before_skid.at(chain.nodes[-1].t_ns, learning.before)

    def _explained(self, learning: SelfCalibration) -> bool:
        return self._rule.explains_skid(learning.known, learning.turned_rad)

    def _forget(self, known: Knowledge) -> None:
        self._known = known
        self._before_skid.clear()
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
        turn_scale, x_m, y_m, delay_s = self._rule.corrections(known).tolist()
        self._imu.turn_scale = turn_scale
        self._gnss.correct(t_ns, np.array([x_m, y_m]), delay_s)
        if not slip:
            return
        self._weights.learn_grade_slip(float(known.mean[SLIP_PER_GRADE]))
        doubt = math.hypot(known.slip_spread, float(known.sigma[WHEEL_SCALE]))
        mean, time_s = -float(known.mean[WHEEL_SCALE]), known.slip_time_s / SLIP_STEADY
        self._weights.learn_slip(mean, max(doubt, LEAST_SLIP_SIGMA), time_s, t_ns)


def _doubt_place(chain: Chain, moved_m: float) -> None:
    """Let the next fixes move the newest place by what a new antenna or delay has shifted them."""
    doubt = np.zeros(chain.dim)
    doubt[3:5] = moved_m**2
    chain.restart(doubt)


def with_turn_doubt(
    noise: SensorNoise, doubt: float, segments: list[ImuSegment], imu: ImuSpec, unaided_s: float
) -> SensorNoise:
    """Noise of a keyframe's yaw rate with the `doubt` of its scale, 1 sigma, `unaided_s` after the last fix.

    In a steady turn at rate w an error s of the scale turns the heading by s w t; white noise of density
    sqrt(2 t) s w gives the same variance at every t.
    """
    grown = math.sqrt(min(2.0 * unaided_s, TURN_TIME_S))
    more = doubt * abs(mean_yaw_rate_radps(segments)) * grown / imu.gyro_noise_radps_sqrthz
    if more < NEGLIGIBLE * noise.gyro_yaw_inflation:
        return noise
    return dataclasses.replace(noise, gyro_yaw_inflation=math.hypot(noise.gyro_yaw_inflation, more))


def prior_of(config: EstimatorConfig) -> Knowledge:
    """What is known of the robot before it drives."""
    yaw, bias_sigma = config.inputs.yaw, config.rig.sensors.imu.gyro_bias_sigma_radps
    slip_time_s = SLIP_STEADY * config.policy.fixed.slip_time_s
    skids = config.rig.drive in SKIDDING
    steered_or_wheels = yaw in ("wheels", "steering")
    wide = assumed(
        bias_sigma,
        steered_or_wheels,
        SLIP_SPREAD,
        slip_time_s,
        skids,
        config.rig.wheelbase_m,
        config.policy.fixed.slip_per_grade,
    )
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
        BIAS_WALK_RADPS if inputs.yaw == "gyro" else 0.0,
        config.rig.drive in SKIDDING,
    )
    antenna_m = complex(*sensors.gnss.antenna_m[:2]) + config.rig.ahead_m
    return SelfCalibration(prior, noise, antenna_m)
