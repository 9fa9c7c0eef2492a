"""Self-calibration as the estimator uses it: which numbers it learns, and where they go."""

from __future__ import annotations

import dataclasses
import math

from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.calibration.fit import Noise
from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    ANTENNA_Y,
    GNSS_DELAY,
    TURN_SCALE,
    WHEEL_SCALE,
    Knowledge,
    assumed,
)
from terrafusion.fusion.calibration.online import SelfCalibration
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.gnss import WHITE_SHARE, GnssUpdater
from terrafusion.fusion.inputs.streams import ImuSegment, ImuStream
from terrafusion.fusion.noise.policy import SensorNoise
from terrafusion.fusion.weighting.adaptive import TerrainNoise

SLIP_SPREAD = 0.05
"""Spread of slip between stretches of some tens of metres before any is driven (assumed)."""
LEAST_SLIP_SIGMA = 0.02
"""Least sigma of learned slip: the next ground may be another one (assumed)."""
GYRO_DENSITY_RADPS, WHEEL_TURN_SHARE = 3e-3, 0.1
"""Noise of the turn over seconds, beyond what a bias explains (assumed)."""
TURN_TIME_S = 10.0
"""Duration of a turn in one direction, over which a wrong scale adds up (assumed)."""


def self_calibration(config: EstimatorConfig) -> SelfCalibration | None:
    """The self-calibration of an estimator; None where it is switched off or there is nothing to learn from."""
    inputs, sensors = config.inputs, config.rig.sensors
    if not config.self_calibrate or config.calibrate or not inputs.gnss or inputs.yaw == "nobody":
        return None
    wheels = inputs.yaw == "wheels"
    noise = Noise(
        GYRO_DENSITY_RADPS,
        WHEEL_TURN_SHARE if wheels else 0.0,
        1.0 - WHITE_SHARE,
        max(sensors.gnss.correlation_time_s, 1.0),
    )
    prior = assumed(sensors.imu.gyro_bias_sigma_radps, wheels, SLIP_SPREAD)
    return SelfCalibration(prior, noise, complex(*sensors.gnss.antenna_m[:2]))


def apply(known: Knowledge, imu: ImuStream, gnss: GnssUpdater, weights: TerrainNoise, t_ns: int) -> None:
    """Hand the numbers to the sensors that they correct."""
    imu.turn_scale = float(known.mean[TURN_SCALE])
    gnss.correct(known.mean[[ANTENNA_X, ANTENNA_Y]], float(known.mean[GNSS_DELAY]))
    doubt = math.hypot(known.slip_spread, float(known.sigma[WHEEL_SCALE]))
    weights.learn_slip(-float(known.mean[WHEEL_SCALE]), max(doubt, LEAST_SLIP_SIGMA), t_ns)


def with_turn_doubt(
    noise: SensorNoise, known: Knowledge, segments: list[ImuSegment], imu: ImuSpec
) -> SensorNoise:
    """Noise of a keyframe's yaw rate with the uncertainty of its scale."""
    total = sum(s.dt_s for s in segments)
    rate = abs(sum(float(s.gyro_radps[2]) * s.dt_s for s in segments)) / total if total > 0.0 else 0.0
    more = float(known.sigma[TURN_SCALE]) * rate * math.sqrt(TURN_TIME_S) / imu.gyro_noise_radps_sqrthz
    if more < 0.1 * noise.gyro_yaw_inflation:
        return noise
    return dataclasses.replace(noise, gyro_yaw_inflation=math.hypot(noise.gyro_yaw_inflation, more))
