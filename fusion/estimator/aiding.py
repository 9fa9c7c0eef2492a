"""Aiding sensors of an estimator, barometer and magnetometer; without samples they do nothing."""

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.estimator.alignment import LEVEL_SIGMA_STILL_RAD, WINDOW_NS, KnownStart, Start
from terrafusion.fusion.estimator.barometer import BarometerAiding
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.estimator.magnetometer import MagnetometerAiding
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.inputs.streams import ImuStream
from terrafusion.fusion.inputs.validation import GnssFix


class AidingSensors:
    """Barometer and magnetometer.

    Args:
        rig: the robot; its sensor specifications may lack either.
        declination_rad: magnetic north, east of true north; None where it is not known.
        report: called with every tested measurement.
    """

    def __init__(self, rig: Rig, declination_rad: float | None, report: Callable[[Innovation], None]) -> None:
        self.height = BarometerAiding(rig.sensors.barometer, report)
        self._accel_tilt_rad = rig.sensors.imu.accel_bias_sigma_mps2 / GRAVITY_MPS2
        tilt = float(np.hypot(LEVEL_SIGMA_STILL_RAD, self._accel_tilt_rad))
        self.heading = MagnetometerAiding(rig.sensors.magnetometer, declination_rad, report, tilt)
        self._antenna_m = np.array(rig.sensors.gnss.antenna_m)

    def update(self, chain: Chain, newest_ns: int, before: Array, after: Array, gnss: GnssUpdater) -> bool:
        """Use the samples up to the newest keyframe; True where factors were added to it.

        `before` and `after` (n, n) are its covariance without and with its fixes; the newest IMU sample is
        at `newest_ns`.
        """
        t_ns = chain.nodes[-1].t_ns
        if gnss.local:
            self.heading.forget_declination()
        aligned = gnss.alignment is not None
        height = self.height.active and self.height.update(chain, t_ns, newest_ns, before, after, aligned)
        turned = gnss.turned + aligned
        heading = self.heading.active and self.heading.update(chain, t_ns, newest_ns, before, after, turned)
        return height or heading

    def start(self, level: Start, imu: ImuStream, fixes: Sequence[GnssFix]) -> KnownStart | None:
        """Position and heading of a robot at rest, once there are a fix and a field."""
        self.forget(imu.t_ns[0])
        early = [f for f in fixes if level.t_ns <= f.t_ns <= level.t_ns + WINDOW_NS]
        if not early or not self.heading.ready:
            return None
        tilt = float(np.hypot(level.level_sigma_rad, self._accel_tilt_rad))
        heading = self.heading.stationary_heading(level, tilt)
        if heading is None:
            return None
        yaw, sigma = heading
        R = gtsam.Rot3.RzRyRx(level.roll_rad, level.pitch_rad, yaw).matrix()
        best = min(early, key=lambda fix: float(fix.sigma_m[0]))
        position = np.nan_to_num(best.enu_m) - R @ self._antenna_m
        return KnownStart(position, yaw, float(np.nanmax(best.sigma_m)) + 0.05, sigma)

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a time."""
        self.height.forget(before_ns)
        self.heading.forget(before_ns)

    def notes(self) -> tuple[str, ...]:
        """What was made of the samples, in sentences."""
        height = self.height.note()
        return (*([height] if height else []), *self.heading.notes())
