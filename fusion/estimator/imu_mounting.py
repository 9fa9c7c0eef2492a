"""An IMU turned about its vertical axis: learned while the wheels roll, corrected where it is clear.

`imu_level` learns its tilt.
"""

import math
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.mounting import ANY_ANGLE_RAD, LEAST_SIGMA_RAD, Angle, MountingAngle
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.imu_level import ImuLevel
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.estimator.skid import SkidDetector
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import BIAS, VELOCITY
from terrafusion.fusion.inputs.streams import ImuStream, turned

CLEAR_SIGMA, LEAST_RAD = 5.0, math.radians(5.0)
"""A correction begins at so many sigma from what was known and no less than an angle that the noise of the
accelerations hides (assumed)."""

DOUBTFUL_TILT_RAD, DOUBTFUL_MPS = 0.1, 0.3
"""1 sigma of tilt and speed after driving with turned accelerations (assumed)."""


class ImuMounting:
    """Learns the angle of the IMU about z, and turns its samples.

    Attributes:
        learns: an estimator of six axes, with self-calibration.
        before: what was known before the drive; known: now, as it is used.
        corrects_since_ns: since when samples are turned by what the drive showed; None where they are not.
    """

    def __init__(self, config: EstimatorConfig, imu: ImuStream, skid: SkidDetector) -> None:
        self.learns = config.self_calibrate and not config.calibrate and config.inputs.imu == "six_axis"
        self._imu, self._skid, self._seen = imu, skid, MountingAngle()
        self._bias_sigma = config.rig.sensors.imu.bias_sigma
        self.corrects_since_ns: int | None = None
        self.level = ImuLevel(config, imu)
        self.start_from(Angle.of_file(config.rig.known.imu_yaw_rad, ANY_ANGLE_RAD, LEAST_SIGMA_RAD))

    @property
    def corrects(self) -> bool:
        """Whether samples are turned by what the drive showed."""
        return self.corrects_since_ns is not None

    def start_from(self, before: Angle) -> None:
        """Begin with what is known of the robot."""
        self.before = self.known = before
        self._imu.mounting_rad = before.rad

    def start_as(self, other: Self) -> None:
        """Begin with all angles as another one has them by now."""
        self.start_from(other.known)
        self.level.start_from(other.level.known)

    def keyframe(self, chain: Chain, mean: MeanMotion) -> None:
        """Take the motion up to the newest keyframe."""
        if not self.learns:
            return
        if mean.rolled_m is None:
            self._seen.interrupt()
            self.level.interrupt()
            return
        self.level.keyframe(chain, mean, self.known.sigma_rad)
        bias = chain.state(chain.last).bias
        was_rad, force, gyro = self._imu.mounting_rad, mean.accel_mps2, mean.gyro_radps - bias.gyroscope()
        if was_rad:
            force, gyro = turned(force, -was_rad), turned(gyro, -was_rad)
        if not self._seen.add(mean.dt_s, mean.rolled_m, gyro, force) or self._seen.angle is None:
            return
        seen = self._seen.angle
        found = seen.as_mounted() if self.before.sigma_rad == ANY_ANGLE_RAD else self.before.combined(seen)
        self.known, clear = self.before.corrected(found, self.corrects, CLEAR_SIGMA, LEAST_RAD)
        self.corrects_since_ns = (self.corrects_since_ns or chain.nodes[-1].t_ns) if clear else None
        self._imu.mounting_rad = self.known.rad
        if abs(math.remainder(self._imu.mounting_rad - was_rad, math.tau)) < LEAST_RAD:
            return
        self.level.restart()
        self._skid.restart()
        chain.restart(self._doubt(chain.dim, bias.vector()))

    def _doubt(self, dim: int, bias: Array) -> Array:
        """Variances (dim,) of what turned accelerations have bent."""
        doubt = np.zeros(dim)
        doubt[:2] = DOUBTFUL_TILT_RAD**2
        doubt[VELOCITY] = DOUBTFUL_MPS**2
        doubt[BIAS] = self._bias_sigma**2 + bias**2
        return doubt
