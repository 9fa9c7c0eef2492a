"""IMU preintegration between keyframes, with noise scaled by the weighting policy."""

import dataclasses
import math

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import ImuSpec
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.noise.policy import SensorNoise

INTEGRATION_SIGMA_M = 1e-4
"""Position error of the integration itself, m/sqrt(s): keeps the square root full rank."""
STEP = math.log(1.05)
HELD_INFLATION = 5.0
"""Noise inflation of a keyframe's IMU with a replaced sample (assumed)."""


class Preintegrator:
    """Makes preintegrated measurements of `CombinedImuFactor` (Forster et al. 2017, IEEE T-RO 33(1)).

    The specific force at the IMU is transferred to the body origin by its lever arm.
    """

    def __init__(self, spec: ImuSpec) -> None:
        self.spec = spec
        self._params: dict[tuple[int, ...], gtsam.PreintegrationCombinedParams] = {}

    def integrate(
        self, segments: list[ImuSegment], bias: gtsam.imuBias.ConstantBias, noise: SensorNoise
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Preintegrate the segments about `bias`."""
        measured = gtsam.PreintegratedCombinedMeasurements(self.params(segments, noise), bias)
        for segment in segments:
            measured.integrateMeasurement(segment.accel_mps2, segment.gyro_radps, segment.dt_s)
        return measured

    def params(self, segments: list[ImuSegment], noise: SensorNoise) -> gtsam.PreintegrationCombinedParams:
        """Noise of the segments: the data sheet's times the inflations of `noise`.

        With a replaced spike the sensor's noise is inflated by `HELD_INFLATION`.
        """
        held = any(p.gyro_held for p in segments), any(p.accel_held for p in segments)
        noise = inflated_for_replaced_samples(noise, *held) if any(held) else noise
        # Steps of 5 % keep the number of parameter sets small.
        inflations = *noise.gyro_axes(), noise.accel_inflation
        key = tuple(round(math.log(inflation) / STEP) for inflation in inflations)
        if key not in self._params:
            spec = self.spec
            *about, accel = (math.exp(STEP * steps) for steps in key)
            self._params[key] = combined_params(
                spec.gyro_noise_radps_sqrthz * np.array(about),
                spec.accel_noise_mps2_sqrthz * accel,
                spec.gyro_bias_walk_radps2_sqrthz,
                spec.accel_bias_walk_mps3_sqrthz,
                spec.position_m,
            )
        return self._params[key]


def combined_params(
    gyro: Array | float,
    accel: Array | float,
    gyro_walk: Array | float,
    accel_walk: Array | float,
    position_m: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> gtsam.PreintegrationCombinedParams:
    """Parameters by noise densities and random walks, each of all axes or (3,), and the IMU's place (3,)."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_MPS2)
    params.setGyroscopeCovariance(_diagonal(gyro))
    params.setAccelerometerCovariance(_diagonal(accel))
    params.setBiasOmegaCovariance(_diagonal(gyro_walk))
    params.setBiasAccCovariance(_diagonal(accel_walk))
    params.setIntegrationCovariance(_diagonal(INTEGRATION_SIGMA_M))
    # A snapshot knows factors with a lever arm only, if of zero length.
    params.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(), np.array(position_m)))
    return params


def _diagonal(sigma: Array | float) -> Array:
    return np.asarray(np.eye(3) * sigma**2)


def inflated_for_replaced_samples(noise: SensorNoise, gyro: bool, accel: bool) -> SensorNoise:
    """The noise, `HELD_INFLATION` times larger for sensors of which a spike was replaced."""
    names = ("gyro_inflation", "gyro_yaw_inflation") * gyro + ("accel_inflation",) * accel
    return dataclasses.replace(noise, **{name: HELD_INFLATION * getattr(noise, name) for name in names})
