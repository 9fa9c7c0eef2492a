"""IMU preintegration between keyframes, with noise scaled by the weighting policy."""

from __future__ import annotations

import gtsam
import numpy as np

from terrafusion.datasets.frames import GRAVITY_MPS2
from terrafusion.datasets.sensors import ImuSpec
from terrafusion.fusion.inputs.streams import ImuSegment

INTEGRATION_SIGMA_M = 1e-4
"""Position error of the integration itself, m/sqrt(s): keeps the square root full rank."""


class Preintegrator:
    """Makes preintegrated measurements of `CombinedImuFactor` (Forster et al. 2017, IEEE T-RO 33(1)).

    The specific force at the IMU is carried to the body origin by its lever arm.
    """

    def __init__(self, spec: ImuSpec) -> None:
        self.spec = spec
        self._params: dict[tuple[float, float], gtsam.PreintegrationCombinedParams] = {}

    def integrate(
        self,
        segments: list[ImuSegment],
        bias: gtsam.imuBias.ConstantBias,
        gyro_inflation: float,
        accel_inflation: float,
    ) -> gtsam.PreintegratedCombinedMeasurements:
        """Preintegrate the segments about `bias`; inflations multiply the data sheet's noise."""
        measured = gtsam.PreintegratedCombinedMeasurements(
            self._scaled(gyro_inflation, accel_inflation), bias
        )
        for piece in segments:
            measured.integrateMeasurement(piece.accel_mps2, piece.gyro_radps, piece.dt_s)
        return measured

    def _scaled(self, gyro_inflation: float, accel_inflation: float) -> gtsam.PreintegrationCombinedParams:
        # Steps of 5 % keep the number of parameter sets small.
        key = (
            1.05 ** round(np.log(gyro_inflation) / np.log(1.05)),
            1.05 ** round(np.log(accel_inflation) / np.log(1.05)),
        )
        if key not in self._params:
            spec, eye = self.spec, np.eye(3)
            params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_MPS2)
            params.setGyroscopeCovariance(eye * (spec.gyro_noise_radps_sqrthz * key[0]) ** 2)
            params.setAccelerometerCovariance(eye * (spec.accel_noise_mps2_sqrthz * key[1]) ** 2)
            params.setBiasOmegaCovariance(eye * spec.gyro_bias_walk_radps2_sqrthz**2)
            params.setBiasAccCovariance(eye * spec.accel_bias_walk_mps3_sqrthz**2)
            params.setIntegrationCovariance(eye * INTEGRATION_SIGMA_M**2)
            params.setBodyPSensor(gtsam.Pose3(gtsam.Rot3(), np.array(spec.position_m)))
            self._params[key] = params
        return self._params[key]
