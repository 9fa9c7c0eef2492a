"""What IMU and wheels measured from one keyframe to the next."""

from dataclasses import dataclass

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.learned_numbers import LearnedNumbers
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.estimator.steering import steered_turn
from terrafusion.fusion.estimator.wheel_jitter import WheelJitter
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factors import mean_rates, wheel_increment
from terrafusion.fusion.graph.imu_gap import readings_in_gap
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.planar import with_centripetal_force, with_wheel_acceleration
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.streams import LONGEST_PAUSE_NS, ImuSegment, ImuStream, WheelStream, is_gap
from terrafusion.fusion.noise.policy import SensorNoise


@dataclass(frozen=True, eq=False)
class KeyframeMotion:
    """Motion up to a keyframe as its link takes it.

    Attributes:
        segments: of the IMU, by friction where it leads; `wheels` likewise.
        noise: of the sensors, with the doubt of the gyro's scale.
        rolled_m: mean distance of the wheels, also without the IMU.
        in_gap: the IMU is missing; turn_rad: the turn then, where the wheels show it.
    """

    mean: MeanMotion
    segments: list[ImuSegment]
    noise: SensorNoise
    rolled_m: float | None
    wheels: WheelIncrement | None
    in_gap: bool
    turn_rad: float | None

    @property
    def in_pause(self) -> bool:
        """Whether no sample came for long."""
        return self.mean.dt_s > LONGEST_PAUSE_NS * 1e-9


class MotionInput:
    """Makes the motion up to a keyframe of the samples of IMU, wheels and steering."""

    def __init__(
        self,
        config: EstimatorConfig,
        streams: tuple[ImuStream, WheelStream, SteeringStream],
        skid: SkidDetector,
        learned: LearnedNumbers,
    ) -> None:
        self._config, self._skid, self._learned = config, skid, learned
        self._imu, self._wheels, self._steering = streams
        self._turn, self._jitter = steered_turn(config.rig, config.inputs), WheelJitter()

    def up_to(self, t_ns: int, chain: Chain, noise: SensorNoise) -> KeyframeMotion:
        """From the newest keyframe of the chain to `t_ns`, on the ground of `noise`."""
        inputs, friction = self._config.inputs, self._skid.friction
        before_ns, before = chain.nodes[-1].t_ns, chain.state(chain.last)
        dt_s = (t_ns - before_ns) * 1e-9
        segments = self._imu.segments(before_ns, t_ns)
        if inputs.planar:
            segments = with_centripetal_force(segments, before)
        in_gap = is_gap(self._imu.largest_gap_s(before_ns, t_ns), self._imu.t_ns)
        turn_rad = self._turn_of_wheels(t_ns, before_ns, before) if in_gap else None
        if turn_rad is not None:
            segments = [readings_in_gap(before, turn_rad, dt_s)]
            turn_rad = turn_rad if inputs.sides and self._turn is None else None
        rolled = wheels = self._increment(t_ns, segments, chain, noise, in_gap)
        noise = self._learned.with_doubt(noise, t_ns, segments)
        if inputs.planar and wheels is not None:
            segments = with_wheel_acceleration(segments, before.rolling * wheels.speed_change_mps / dt_s)
        if friction is not None:
            known = before, chain.covariance, self._skid.rate_m2ps
            segments, wheels = friction.step(t_ns, dt_s, segments, wheels, *known)
        rolled_m = None if rolled is None else rolled.distance_m
        course_rad = self._steering.course_rad(before_ns, t_ns)
        mean = MeanMotion(dt_s, None if in_gap else rolled_m, course_rad, *mean_rates(segments))
        return KeyframeMotion(mean, segments, noise, rolled_m, wheels, in_gap, turn_rad)

    def _turn_of_wheels(self, t_ns: int, before_ns: int, before: KeyState) -> float | None:
        """Turn by steering angles or by the sides, 0 of a robot with neither; None if wheels are silent."""
        travelled = self._wheels.travelled(before_ns, t_ns)
        if travelled is None:
            return None
        left_m, right_m = travelled
        if self._turn is not None:
            curvature_per_m = self._steering.curvature_per_m(before_ns, t_ns)
            return self._turn.turn_rad(0.5 * (left_m + right_m), curvature_per_m or 0.0)
        across_m = right_m - left_m if self._config.inputs.sides else 0.0
        return before.turning * across_m / self._config.rig.track_m

    def _increment(
        self, t_ns: int, segments: list[ImuSegment], chain: Chain, noise: SensorNoise, in_gap: bool
    ) -> WheelIncrement | None:
        before_ns, before = chain.nodes[-1].t_ns, chain.state(chain.last)
        travelled = self._wheels.travelled(before_ns, t_ns)
        if travelled is None:
            return None
        rig, inputs, calibrate = self._config.rig, self._config.inputs, self._config.calibrate
        bias_z, change_mps = before.bias.gyroscope()[2], self._wheels.speed_change_mps(before_ns, t_ns)
        increment = wheel_increment(
            travelled, segments, float(bias_z), rig.track_m, rig.quantum_m, noise, change_mps, calibrate,
            self._learned.course_lag_s(),
        )  # fmt: skip
        increment = self._jitter.applied(increment, self._wheels.count_m())
        increment = self._skid.with_extra_variance(increment, before, (t_ns - before_ns) * 1e-9)
        if self._turn is not None:
            known = None if in_gap else chain.covariance
            return self._turn.between(before_ns, t_ns, increment, self._steering, known)
        return increment if inputs.sides and inputs.yaw == "gyro" else increment.without_turn()
