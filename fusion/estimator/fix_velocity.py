"""The velocity of a fix as a factor of the keyframe after it."""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.estimator.dead_reckoning import FixPair
from terrafusion.fusion.estimator.fix_prediction import PredictedFix
from terrafusion.fusion.estimator.velocity_test import VelocityTest
from terrafusion.fusion.graph import slow_states
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import (
    BIAS,
    DRIFT,
    GNSS_DELAY,
    NAV,
    SLIP,
    VELOCITY,
    among_linear,
    cross,
)
from terrafusion.fusion.graph.velocity_factor import GnssVelocity, lever_arm_velocity
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise

UNKNOWN_CLIMB_MPS = 100.0
"""1 sigma of the upward velocity of a receiver that reports speed and course alone."""
OFF_MPS, OFF_SIGMA = 2.0, 6.0
"""A velocity farther from the estimate's, beyond so many sigmas, is none of the robot (assumed)."""

DOUBTFUL_LEVEL_RAD, DOUBTFUL_YAW_RAD, DOUBTFUL_MPS = 0.05, 0.2, 1.0
"""1 sigma of attitude and velocity after wrong velocities were used (assumed)."""


@dataclass(eq=False)
class FixVelocities:
    """Velocities of the fixes; `refused`: how many were too far from the estimate's.

    `test_of_path`: whether they are the rate of the positions.
    """

    refused: int = 0
    test_of_path: VelocityTest = field(default_factory=VelocityTest)
    _wrong_since: tuple[int, float] | None = None

    def test(self, pair: FixPair, fix: GnssFix, scale: float) -> None:
        """Test the velocity of a fix, its sigma times `scale`."""
        since_ns = self.test_of_path.add(pair, fix, scale)
        if since_ns is not None:
            self._wrong_since = since_ns, scale * pair.sigma_m

    def undo_wrong(self, chain: Chain, noise: SensorNoise, bias_sigma: Array) -> bool:
        """Undo what velocities have done that turned out to be wrong; True when there were any.

        Live, they have bent more than the window holds: its newest keyframe moves as its wheels say, with the
        slip that its ground has by `noise`, and all else but its place is in doubt.
        """
        if self._wrong_since is None:
            return False
        (since_ns, sigma_m), self._wrong_since = self._wrong_since, None
        chain.drop_velocities(since_ns)
        chain.smooth(len(chain.nodes))
        state, wheels = chain.state(chain.last), chain.nodes[-1].wheels
        linear, sigma = slow_states.prior(noise, float(state.rotation[2, 0]), 0.0)
        linear[among_linear(DRIFT)] = state.of(DRIFT)
        velocity = np.zeros(3)
        if wheels is not None and len(chain.nodes) > 1:
            dt_s = (chain.nodes[-1].t_ns - chain.nodes[-2].t_ns) * 1e-9
            velocity = state.rotation @ wheels.displacement_m / dt_s
        doubt = np.zeros(chain.dim)
        doubt[:2], doubt[2], doubt[3:6] = DOUBTFUL_LEVEL_RAD**2, DOUBTFUL_YAW_RAD**2, sigma_m**2
        doubt[VELOCITY], doubt[BIAS] = DOUBTFUL_MPS**2, bias_sigma**2
        doubt[NAV.stop :] = sigma[: chain.dim - NAV.stop] ** 2
        doubt[DRIFT] = 0.0
        anew = [*range(VELOCITY.start, VELOCITY.stop), SLIP, *range(DRIFT.stop, chain.dim)]
        chain.restart(doubt, anew=anew, at=dataclasses.replace(state, velocity=velocity, linear=linear))
        return True

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
        if self.test_of_path.refuted_along is not None:
            self.test_of_path.left_out += 1
            return None
        sigma_mps = math.sqrt(fix.sigma_v_mps**2 + float(covariance[VELOCITY, VELOCITY].trace()))
        off_mps = math.sqrt(sum([v * v for v in (velocity - predicted_mps).tolist() if v == v]))
        usable = off_mps <= OFF_MPS + OFF_SIGMA * sigma_mps
        self.refused += not usable
        return velocity if usable else None
