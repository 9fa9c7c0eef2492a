"""IMU preintegration between keyframes, with noise scaled by the weighting policy."""

from __future__ import annotations

import dataclasses
import math

import gtsam
import numpy as np

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
        self,
        segments: list[ImuSegment],
        bias: gtsam.imuBias.ConstantBias,
        noise: SensorNoise,
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Preintegrate the segments about `bias`; the inflations of `noise` multiply the data sheet's noise.

        With a replaced spike the sensor's noise is inflated by `HELD_INFLATION`.
        """
        noise = _less_sure(noise, any(p.gyro_held for p in segments), any(p.accel_held for p in segments))
        measured = gtsam.PreintegratedCombinedMeasurements(self._scaled(noise), bias)
        for segment in segments:
            measured.integrateMeasurement(segment.accel_mps2, segment.gyro_radps, segment.dt_s)
        return measured

    def _scaled(self, noise: SensorNoise) -> gtsam.PreintegrationCombinedParams:
        # Steps of 5 % keep the number of parameter sets small.
        inflations = *noise.gyro_axes(), noise.accel_inflation
        key = tuple(round(math.log(inflation) / STEP) for inflation in inflations)
        if key not in self._params:
            spec, eye = self.spec, np.eye(3)
            *about, accel = (math.exp(STEP * steps) for steps in key)
            gyro = spec.gyro_noise_radps_sqrthz * np.array(about)
            params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_MPS2)
            params.setGyroscopeCovariance(np.diag(gyro**2))
            params.setAccelerometerCovariance(eye * (spec.accel_noise_mps2_sqrthz * accel) ** 2)
            params.setBiasOmegaCovariance(eye * spec.gyro_bias_walk_radps2_sqrthz**2)
            params.setBiasAccCovariance(eye * spec.accel_bias_walk_mps3_sqrthz**2)
            params.setIntegrationCovariance(eye * INTEGRATION_SIGMA_M**2)
            params.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(), np.array(spec.position_m)))
            self._params[key] = params
        return self._params[key]


def _less_sure(noise: SensorNoise, gyro: bool, accel: bool) -> SensorNoise:
    names = ("gyro_inflation", "gyro_yaw_inflation") * gyro + ("accel_inflation",) * accel
    return dataclasses.replace(noise, **{name: HELD_INFLATION * getattr(noise, name) for name in names})
