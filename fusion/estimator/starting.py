"""The start of an estimator: waits until heading is known, or until GNSS has been waited for long enough."""

import dataclasses

import numpy as np

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.aiding import AidingSensors
from terrafusion.fusion.estimator.alignment import WINDOW_NS, KnownStart, Start, level_start
from terrafusion.fusion.estimator.fix_noise import WHITE_SHARE
from terrafusion.fusion.estimator.gnss import GnssUpdater
from terrafusion.fusion.estimator.heading_from_motion import MotionDoubt, MotionStart, heading_from_motion
from terrafusion.fusion.estimator.learned_numbers import prior_of
from terrafusion.fusion.estimator.plausibility import plausible_fixes
from terrafusion.fusion.estimator.stationarity import drop_before_start
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.time_jumps import JUMP_NS

SILENT_NS, ROUGH_YAW_RAD = 3_000_000_000, 0.8
"""Without a fix for so long the start no longer waits for a better heading, where there is one that tells
forward from sideways (45 deg; assumed)."""
CLEAR_YAW_RAD, CLEARER_NS = 0.3, 10_000_000_000
"""While an unknown antenna or late fixes leave a heading less clear than this, which the first state allows
for, a start waits for so long: until the robot stops turning (assumed)."""
MANY_FIXES = 10
"""From so many fixes on the position is known, and any heading will do, with the sigma that it has
(assumed); with fewer, the next one is waited for as the first is. Such a path, and one whose heading an
antenna or a delay leaves open, is local, as it is without fixes, until they lay it onto the map: the graph
would make too much of the few fixes there are."""


class StartSearch:
    """Finds the first state.

    Attributes:
        known: position and heading given beforehand or by aiding sensors, None where they come from motion.
        level: attitude at the beginning of the samples, once known.
    """

    def __init__(self, config: EstimatorConfig, aids: AidingSensors, gnss: GnssUpdater) -> None:
        self.known: KnownStart | None = None
        self.level: Start | None = None
        self._rough: MotionStart | None = None
        self._unclear_ns: int | None = None
        self._newest_fix_came_ns = 0
        self._config, self._aids, self._gnss = config, aids, gnss
        self._antenna_m, self._ahead_m = np.array(config.rig.sensors.gnss.antenna_m), config.rig.ahead_m
        self._doubt = MotionDoubt(prior_of(config).covariance, 1.0 - WHITE_SHARE, gnss.fix_noise.drift.time_s)

    def find(self, imu: ImuStream, wheels: WheelStream, steering: SteeringStream, last: bool) -> Start | None:
        """The start, or None as long as there is none; `last`: no more samples will come."""
        if not imu.t_ns or not wheels.t_ns:
            imu.forget(imu.t_ns[-1] - SILENT_NS if imu.t_ns else 0)
            return None
        begin = max(imu.t_ns[0], wheels.t_ns[0])
        level_ns = begin + WINDOW_NS
        covered = wheels.covers(level_ns) or imu.covers(level_ns + WINDOW_NS)
        if not last and not (covered and imu.covers(level_ns)):
            return None
        if self.level is None:
            self.level = level_start(imu, wheels, begin)
        if self.known is None:
            self.known = self._aids.start(self.level, imu, self._gnss.waiting)
        if self.known is not None:
            return self.known.at(self.level)
        now_ns = imu.t_ns[-1]
        wait_s = self._config.start_without_gnss_s if self._config.inputs.gnss else 0.0
        # Fixes of another time, as of a receiver whose clock is wrong, are as none: they show no motion.
        if not any(begin <= fix.t_ns <= now_ns + JUMP_NS for fix in self._gnss.waiting):
            if not last and (now_ns - begin) * 1e-9 <= wait_s:
                return None
            self._gnss.local = True
            return self.level
        if self._gnss.have_new():
            self._newest_fix_came_ns = now_ns
            return self._by_motion(imu, wheels, steering, self.level)
        silent_ns = now_ns - self._newest_fix_came_ns
        if not last and silent_ns <= SILENT_NS:
            return None
        start = self._by_rough_heading(wheels, self.level)
        if start is None and not last and silent_ns * 1e-9 > wait_s:
            return self._without_heading(self.level)
        if start is None:
            self._drop_unusable(imu, wheels)
        return start

    def _by_motion(
        self, imu: ImuStream, wheels: WheelStream, steering: SteeringStream, level: Start
    ) -> Start | None:
        """The start by the fixes so far, once they show the heading clearly."""
        fitting = plausible_fixes(self._gnss.waiting, wheels)
        place = self._antenna_m, self._ahead_m, self._doubt
        found = heading_from_motion(imu, wheels, fitting, level, *place, steering)
        if found is not None and self._clear(found, imu.t_ns[-1]):
            self._gnss.refuse_waiting(fitting)
            return found.start
        self._rough = found
        self._drop_unusable(imu, wheels)
        return None

    def _drop_unusable(self, imu: ImuStream, wheels: WheelStream) -> None:
        if drop_before_start(imu, wheels, self._gnss.waiting):
            self.level = self._rough = None

    def _by_rough_heading(self, wheels: WheelStream, level: Start) -> Start | None:
        """The start by the heading that there is, where no more fixes come."""
        rough, fixes = self._rough, self._gnss.waiting
        if rough is None:
            return None
        tells_forward = rough.start.yaw_sigma_rad <= ROUGH_YAW_RAD
        if tells_forward and rough.fixes_decide():
            self._gnss.refuse_waiting(plausible_fixes(fixes, wheels))
            return rough.start
        if not tells_forward and len(fixes) < MANY_FIXES:
            return None
        return self._without_heading(level)

    def _without_heading(self, level: Start) -> Start:
        """A local start, at the place that the fixes gave where they gave one."""
        if self._rough is None:
            self._gnss.local = True
            return level
        start = self._rough.alone()
        self._gnss.place(start)
        self.known = dataclasses.replace(start, yaw_sigma_rad=level.yaw_sigma_rad)
        return self.known.at(level)

    def _clear(self, found: MotionStart, now_ns: int) -> bool:
        if found.random_rad > self._config.yaw_sigma_start_rad:
            return False
        self._unclear_ns = self._unclear_ns or now_ns
        return found.start.yaw_sigma_rad <= CLEAR_YAW_RAD or now_ns - self._unclear_ns > CLEARER_NS
