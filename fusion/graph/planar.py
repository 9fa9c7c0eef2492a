"""The planar link between two keyframes of a log without a six-axis IMU.

It is the preintegrated factor of the full graph, fed with the readings of a robot on level ground: yaw
rate from the gyro's z axis or from the wheels, no roll or pitch rate, the specific force of a steady turn
(rate times speed, perpendicular to the velocity), gravity upwards. Its noise: the yaw rate has that of its
source, speed is a random walk (white acceleration; Bar-Shalom, Li and Kirubarajan 2001, sec. 6.2.2),
roll and pitch are held level by an attitude factor. They and the accelerometer's bias are not estimated.
Height follows GNSS, or stays at its start.
"""

import dataclasses
import math

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.graph.key_state import KeyState
from terrafusion.fusion.graph.preintegration import Preintegrator, combined_params
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.streams import ImuSegment, WheelStream, mean_yaw_rate_radps
from terrafusion.fusion.noise.policy import SensorNoise

ACCEL_DENSITY_MPS2 = 2.0
"""White acceleration, m/s2/sqrt(Hz) (assumed): speed changes by 0.6 m/s (1 sigma) per keyframe of 0.1 s,
twice what a skid-steer robot brakes. The wheels, not this, determine the speed."""
WHEEL_ACCEL_DENSITY_MPS2 = 0.5
"""White error of the acceleration that the wheels show, m/s2/sqrt(Hz) (assumed): 0.16 m/s per keyframe of
0.1 s. Without it a speed too high at one keyframe and too low at the next fits the distances as well."""
TILT_SIGMA_RAD = 0.1
"""Roll and pitch of ground taken for level, 1 sigma (assumed)."""
TILT_DENSITY_RADPS = 0.1
"""Change of the ground's tilt, rad/s/sqrt(Hz) (assumed): 0.03 rad (1 sigma) per keyframe."""
SKID_TURN_SHARE, ROLL_TURN_SHARE = 0.4, 0.1
"""Relative error of the yaw rate of wheels that skid in a turn, and that roll (1 sigma, assumed)."""
TURN_TIME_S = 10.0
"""Correlation time of that error, s (assumed): a long turn."""
WHEEL_YAW_DENSITY_RADPS = 0.02
"""Yaw noise of the wheels on a straight, rad/s/sqrt(Hz) (assumed)."""
STEERED_TURN_SHARE, STEERED_YAW_DENSITY_RADPS = 0.1, 0.005
"""The same of steered wheels (assumed)."""
STEERED_BIAS_SIGMA_RADPS, STEERED_BIAS_WALK = 0.05, 1e-3
"""Yaw rate of a robot that steers straight ahead, 1 sigma (0.02 rad off at a wheelbase in 0.4 s), and its
walk, rad/s/sqrt(s), by changes of speed (assumed)."""
BIASED = ("gyro", "steering")
"""Sources of yaw whose bias is estimated."""
UNKNOWN_YAW_DENSITY_RADPS = 0.5
"""Yaw noise without any yaw source, rad/s/sqrt(Hz) (assumed): half a rad/s for a second."""

_LEVEL = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
_TILT_NOISE = gtsam.noiseModel.Isotropic.Sigma(2, TILT_SIGMA_RAD)
_BIAS_WALK = 1e-6


def level_factor(k: int) -> gtsam.NonlinearFactor:
    """Body z of keyframe k points up, but for the tilt of the ground."""
    return gtsam.AttitudeFactorPose3(X(k), _LEVEL, _TILT_NOISE, _LEVEL)


def with_centripetal_force(segments: list[ImuSegment], before: KeyState) -> list[ImuSegment]:
    """The segments with the specific force of a level robot in a steady turn, sliding or not.

    It is perpendicular to the velocity: a force along it would speed up a robot that slides sideways.
    """
    ahead, left = before.velocity @ before.rotation[:, :2]
    bias = float(before.bias.gyroscope()[2])
    out = []
    for segment in segments:
        rate = float(segment.gyro_radps[2]) - bias
        force = np.array([-rate * left, rate * ahead, GRAVITY_MPS2])
        out.append(dataclasses.replace(segment, accel_mps2=force))
    return out


def with_wheel_acceleration(segments: list[ImuSegment], accel_mps2: float) -> list[ImuSegment]:
    """The segments with a forward acceleration by the wheels, slip removed, and its noise."""
    density = WHEEL_ACCEL_DENSITY_MPS2
    return [
        dataclasses.replace(
            segment,
            accel_mps2=segment.accel_mps2 + np.array([accel_mps2, 0.0, 0.0]),
            accel_density_mps2=(density, density),
        )
        for segment in segments
    ]


def yaw_of_wheels(wheels: WheelStream, track_m: float, steering: SteeringStream | None = None) -> Array:
    """Angular rate (3,) between the wheels' last two samples, rad/s; x and y are NaN.

    It is their difference over the track or, with `steering`, their mean ahead times the path's curvature.
    """
    rate = 0.0
    if len(wheels.t_ns) > 1 and wheels.t_ns[-1] > wheels.t_ns[-2]:
        dt = (wheels.t_ns[-1] - wheels.t_ns[-2]) * 1e-9
        left, right = wheels.left_m[-1] - wheels.left_m[-2], wheels.right_m[-1] - wheels.right_m[-2]
        if steering is None:
            rate = (right - left) / track_m / dt
        else:
            ahead = 0.5 * (left + right) * math.cos(steering.course_rad(*wheels.t_ns[-2:]))
            rate = ahead * (steering.curvature_per_m(*wheels.t_ns[-2:]) or 0.0) / dt
    return np.array([np.nan, np.nan, rate])


class PlanarPreintegrator(Preintegrator):
    """Makes the planar link, in place of `Preintegrator`.

    Args:
        spec: noise of the gyro, where yaw is the gyro's.
        yaw: source of the yaw rate: "gyro", "steering", "wheels" or "none".
        skids: whether the wheels skid in a turn.
    """

    def __init__(self, spec: ImuSpec, yaw: str, skids: bool = True) -> None:
        super().__init__(spec)
        self.yaw, self._turn_share = yaw, SKID_TURN_SHARE if skids else ROLL_TURN_SHARE

    def params(self, segments: list[ImuSegment], noise: SensorNoise) -> gtsam.PreintegrationCombinedParams:
        """Noise of the segments; of `noise` only the inflation about yaw acts."""
        yaw = self.yaw_density(mean_yaw_rate_radps(segments), noise.gyro_yaw_inflation)
        forward = segments[0].accel_density_mps2 if segments else None
        walk = self.spec.gyro_bias_walk_radps2_sqrthz if self.yaw in BIASED else _BIAS_WALK
        return combined_params(
            np.array([TILT_DENSITY_RADPS, TILT_DENSITY_RADPS, yaw]),
            np.array([*(forward or (ACCEL_DENSITY_MPS2, ACCEL_DENSITY_MPS2)), ACCEL_DENSITY_MPS2]),
            np.array([_BIAS_WALK, _BIAS_WALK, walk]),
            _BIAS_WALK,
        )

    def yaw_density(self, rate_radps: float, inflation: float) -> float:
        """Noise density of the yaw rate, rad/s/sqrt(Hz), while turning at `rate_radps`."""
        if self.yaw == "gyro":
            return self.spec.gyro_noise_radps_sqrthz * inflation
        if self.yaw == "none":
            return UNKNOWN_YAW_DENSITY_RADPS
        steered = self.yaw == "steering"
        share, floor = (
            (STEERED_TURN_SHARE, STEERED_YAW_DENSITY_RADPS)
            if steered
            else (self._turn_share, WHEEL_YAW_DENSITY_RADPS)
        )
        return float(np.hypot(share * rate_radps * np.sqrt(TURN_TIME_S), floor))


def planar_spec(spec: ImuSpec, yaw: str) -> ImuSpec:
    """The IMU's specification for the planar graph: no unobservable biases, no lever arm."""
    seen = yaw in BIASED
    if yaw == "steering":  # its zero is off: at a steady speed a rate that is off
        spec = dataclasses.replace(
            spec,
            gyro_bias_sigma_radps=STEERED_BIAS_SIGMA_RADPS,
            gyro_bias_walk_radps2_sqrthz=STEERED_BIAS_WALK,
        )
    return dataclasses.replace(
        spec,
        accel_bias_sigma_mps2=0.0,
        gyro_bias_sigma_radps=spec.gyro_bias_sigma_radps if seen else 0.0,
        position_m=(0.0, 0.0, 0.0),
    )
