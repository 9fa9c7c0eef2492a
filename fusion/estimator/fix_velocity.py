"""The velocity of a fix as a factor of the keyframe after it."""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.fix_prediction import PredictedFix
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import GNSS_DELAY, VELOCITY, cross
from terrafusion.fusion.graph.velocity_factor import GnssVelocity, lever_arm_velocity
from terrafusion.fusion.inputs.validation import GnssFix

UNKNOWN_CLIMB_MPS = 100.0
"""1 sigma of the upward velocity of a receiver that reports speed and course alone."""
OFF_MPS, OFF_SIGMA = 2.0, 6.0
"""A velocity farther from the estimate's, beyond so many sigmas, is none of the robot (assumed)."""


@dataclass(eq=False)
class FixVelocities:
    """Velocities of the fixes; `refused`: how many were too far from the estimate's."""

    refused: int = 0

    def factor(
        self, chain: Chain, used: PredictedFix, antenna_m: Array, inflation: float
    ) -> GnssVelocity | None:
        """The factor of a fix, None where it has no usable velocity.

        Args:
            antenna_m: lever arm (3,), body, without what the chain estimates of it.
            inflation: of the reported sigma.
        """
        fix, at, covariance = used.fix, used.motion, used.covariance
        measured_mps = self._usable(fix, at.velocity_mps, covariance)
        if measured_mps is None:
            return None
        measured = np.isfinite(measured_mps)
        sigma = np.where(measured, max(fix.sigma_v_mps * inflation, 1e-3), UNKNOWN_CLIMB_MPS)
        at_keyframe = np.where(measured, measured_mps, at.velocity_mps) - at.accel_mps2 * at.offset_s
        if chain.dim > GNSS_DELAY:
            doubt = float(np.linalg.norm(at.accel_mps2) * np.sqrt(covariance[GNSS_DELAY, GNSS_DELAY]))
            sigma, turned = np.hypot(sigma, doubt), lever_arm_velocity(at.rate_radps, at.offset_s)
            return GnssVelocity(at_keyframe, sigma, antenna_m, turned)
        return GnssVelocity(at_keyframe - at.R @ cross(at.rate_radps, at.antenna_m), sigma)

    def _usable(self, fix: GnssFix, predicted_mps: Array, covariance: Array) -> Array | None:
        """The velocity (3,) of a fix, NaN where not measured; None where there is none that a robot has."""
        velocity = fix.velocity_mps
        if velocity is None or not math.isfinite(float(velocity[0] + velocity[1]) + fix.sigma_v_mps):
            return None
        sigma_mps = math.sqrt(fix.sigma_v_mps**2 + float(covariance[VELOCITY, VELOCITY].trace()))
        off_mps = math.sqrt(sum([v * v for v in (velocity - predicted_mps).tolist() if v == v]))
        usable = off_mps <= OFF_MPS + OFF_SIGMA * sigma_mps
        self.refused += not usable
        return velocity if usable else None
