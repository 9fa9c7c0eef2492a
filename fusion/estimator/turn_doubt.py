"""The doubt of the gyro's scale as noise of the turn."""

from __future__ import annotations

import dataclasses
import math

from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.noise.policy import SensorNoise

TURN_TIME_S = 10.0
"""Duration of a turn in one direction, over which a wrong scale adds up without fixes (assumed)."""
NEGLIGIBLE = 0.1
"""Share of the noise in use below which the doubt is left out."""


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
    if more < NEGLIGIBLE * noise.gyro_yaw_inflation:
        return noise
    return dataclasses.replace(noise, gyro_yaw_inflation=math.hypot(noise.gyro_yaw_inflation, more))
