"""How the IMU of a robot is turned against its body: its tilt, and which axis is forward, from one drive."""

import math
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.checks import CheckContext
from terrafusion.datasets.checks.imu import heading
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.config.sensor_config import imu_kind
from terrafusion.fusion.init.draft import Draft, DraftLine

SLOPE_RAD = math.radians(5.0)
"""1 sigma of the slope of the ground (assumed): it tilts a robot as a mount does, but turns with heading."""
LEAST_SIGMA_RAD = math.radians(0.5)
"""Of a tilt that is found: bias of the accelerometer, load and tyres (assumed)."""
SEEN_SIGMAS, LEAST_TILT_RAD = 3.0, math.radians(2.0)
"""A tilt is corrected from so many sigma on, and no less than this."""
FORWARD_SIGMA_RAD = 0.4
"""1 sigma of the IMU's angle about z where acceleration shows that it is not turned by a quarter
(assumed)."""
MOST_ALONG = 0.4
"""Headings cover the circle where their mean direction is no longer than this; 1 is a straight drive."""


@dataclass(frozen=True)
class Tilt:
    """Angles, rad, by which body axes are turned into those of the IMU, about x, then y.

    `along` is the length of the mean heading vector: that share of the slope stays in the angles.
    """

    roll_rad: float
    pitch_rad: float
    sigma_rad: float
    along: float

    def size_rad(self) -> float:
        """Angle between the vertical axes of body and IMU."""
        return math.acos(math.cos(self.roll_rad) * math.cos(self.pitch_rad))


def measure_tilt(recording: Recording, rig: Rig) -> Tilt | None:
    """The mean specific force of a drive, without that of its turns; None without six axes or wheels.

    Changes of speed cancel over a drive that ends as slow as it began, and slopes over all headings.
    """
    imu, wheels, radius_m = recording.imu, recording.wheels, CheckContext(recording, rig).wheel_radius_m()
    if imu is None or wheels is None or len(imu) < 2 or not len(wheels) or imu_kind(imu) != "six_axis":
        return None
    assert radius_m is not None  # the rig has one
    t = imu.t_ns * 1e-9
    step = np.diff(t, prepend=t[0])
    step[step > 1.0] = 0.0  # a gap says nothing
    speed = wheels.side_speeds_mps(radius_m).mean(axis=1)
    rate = imu.gyro_radps[:, 2]
    force = imu.accel_mps2.copy()
    force[:, 1] -= rate * np.interp(t, wheels.t_ns * 1e-9, speed)
    known = np.isfinite(force).all(axis=1) & np.isfinite(rate)
    if not step[known].sum() > 0.0:
        return None
    x, y, z = np.average(force[known], axis=0, weights=step[known])
    heading = np.cumsum(np.where(known, rate, 0.0) * step)
    along = float(abs(np.average(np.exp(1j * heading[known]), weights=step[known])))
    sigma = math.hypot(LEAST_SIGMA_RAD, SLOPE_RAD * along)
    return Tilt(math.atan2(y, z), math.atan2(-x, math.hypot(y, z)), sigma, along)


def tilt_lines(tilt: Tilt | None, log: str) -> tuple[Draft, tuple[str, ...]]:
    """Lines of the file for a tilted IMU, or a note that says how to find out."""
    if tilt is None or tilt.size_rad() < max(SEEN_SIGMAS * LEAST_SIGMA_RAD, LEAST_TILT_RAD):
        return {}, ()
    degrees = math.degrees(tilt.size_rad())
    if tilt.along > MOST_ALONG or tilt.size_rad() < SEEN_SIGMAS * tilt.sigma_rad:
        remedy = "drive once round on level ground, and run this again on that log"
        return {}, (f"imu: on average {degrees:.1f} deg from level: a slope, or a tilted mount; {remedy}",)
    comment = f"rad; tilt of the IMU, {degrees:.1f} deg in all, by gravity over all headings"
    return {
        name: DraftLine(KnownNumber(round(value, 4), "calibrated", round(tilt.sigma_rad, 4), (log,)), comment)
        for name, value in (("imu_roll_rad", tilt.roll_rad), ("imu_pitch_rad", tilt.pitch_rad))
    }, ()


def forward_line(recording: Recording, rig: Rig) -> Draft:
    """A line of the file where acceleration follows the wheels along x: the IMU is not turned by a quarter.

    No more is taken from it, as the lever arm of the IMU bends that direction.
    """
    found = heading(CheckContext(recording, rig))
    if found is None or found.angle is None or abs(found.angle) + found.spread > 0.25 * math.pi:
        return {}
    number = KnownNumber(0.0, "calibrated", FORWARD_SIGMA_RAD, (recording.name,))
    return {"imu_yaw_rad": DraftLine(number, "rad; about z; acceleration follows the wheels along x")}
