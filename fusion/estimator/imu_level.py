"""A tilted IMU: roll and pitch of its mounting, learned from turns and heights, corrected where clear."""

import cmath
import dataclasses
import math

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.fusion.calibration.mounting import Angle
from terrafusion.fusion.calibration.tilt import LEAST_SIGMA_RAD, MountingTilt
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.key_state import BIAS, VELOCITY
from terrafusion.fusion.inputs.streams import ImuStream
from terrafusion.fusion.inputs.validation import GnssFix

LEVEL = ("imu_roll_rad", "imu_pitch_rad")
"""The two angles by their names in the vehicle file."""
ASSUMED_SIGMA_RAD = 0.1
"""1 sigma of the tilt of an IMU of which nothing is known (assumed)."""
CLEAR_SIGMA, LEAST_RAD = 4.0, math.radians(1.5)
"""A correction begins at so many sigma from what was known and no less than this angle (assumed)."""
LEAST_STEP_RAD = math.radians(0.5)
"""What is in use changes by no less."""
AHEAD_KNOWN_RAD = 0.2
"""Heights count where the angle about z is known so well (assumed)."""
DOUBTFUL_RAD, DOUBTFUL_CLIMB_MPS = 0.02, 0.1
"""1 sigma of the body's tilt and of its climb after a correction (assumed)."""
UP_OVER_LEVEL = 1.5
"""Least sigma of a height over that of its place (assumed: geometry of satellites)."""


class ImuLevel:
    """Learns roll and pitch of the IMU, and levels its samples.

    Attributes:
        before: roll and pitch as known before the drive; known: now, as they are used.
        corrects: which of both are corrected by what the drive showed.
    """

    def __init__(self, config: EstimatorConfig, imu: ImuStream) -> None:
        spec = config.rig.sensors.imu
        self._imu, self._new = imu, False
        self._bias_sigma = spec.bias_sigma
        self._accel_sigma_mps2 = spec.accel_bias_sigma_mps2
        self.restart()
        self._six_axis = config.inputs.imu == "six_axis"
        known = config.rig.known
        roll, pitch = (
            Angle.of_file(angle, ASSUMED_SIGMA_RAD, LEAST_SIGMA_RAD)
            for angle in (known.imu_roll_rad, known.imu_pitch_rad)
        )
        self.start_from((roll, pitch))

    def start_from(self, before: tuple[Angle, Angle]) -> None:
        """Begin with what is known of the robot."""
        self.before = self.known = before
        self.corrects, self._held = [False, False], False
        self._level()

    def _level(self) -> None:
        self._imu.level = _rotation(self.known) if self._six_axis and any(self._angles()) else None

    def hold(self, known: tuple[Angle, Angle], corrects: list[bool]) -> None:
        """Use what an earlier pass over the same samples gave, and learn no more of them."""
        self.known, self.corrects, self._held = known, corrects, True
        self._level()

    def note(self) -> str | None:
        """That samples are levelled, in a sentence."""
        if not any(self.corrects):
            return None
        parts = [
            f"{name} {math.degrees(angle.rad):.1f} deg" if corrected or angle.rad else f"{name} not clear"
            for name, angle, corrected in zip(("roll", "pitch"), self.known, self.corrects, strict=True)
        ]
        return (
            f"the IMU is tilted, {' and '.join(parts)}: its samples were levelled; "
            "`terrafusion calibrate LOG --sensors` writes it to a vehicle file"
        )

    def restart(self) -> None:
        """The axes were others than thought: begin to learn anew."""
        self._seen = MountingTilt(self._accel_sigma_mps2)

    def interrupt(self) -> None:
        """Motion is missing."""
        self._seen.interrupt()

    def fix(self, fix: GnssFix, scale: float) -> None:
        """A fix as it came; its sigma counts `scale` times."""
        sigma_m = max(float(fix.sigma_m[2]), UP_OVER_LEVEL * fix.horizontal_sigma_m) * scale
        if math.isfinite(float(fix.enu_m[2]) + sigma_m):
            self._new |= self._seen.height(float(fix.enu_m[2]), sigma_m)

    def keyframe(self, chain: Chain, mean: MeanMotion, yaw_sigma_rad: float) -> None:
        """Take the motion up to the newest keyframe; `yaw_sigma_rad` is of the IMU's angle about z."""
        if self._held or mean.rolled_m is None:
            return
        speed_mps = mean.rolled_m * chain.state(chain.last).rolling / mean.dt_s
        gyro_radps, accel_mps2 = mean.gyro_radps, mean.accel_mps2
        back = self._back(self._imu.mounting_rad)
        if back is not None:
            gyro_radps, accel_mps2 = back @ gyro_radps, back @ accel_mps2
        self._new |= self._seen.add(mean.dt_s, speed_mps, gyro_radps, accel_mps2)
        if not self._new:
            return
        self._new, yaw = False, self._imu.mounting_rad
        was, used = complex(*self._angles()), []
        for i, (before, off) in enumerate(zip(self.before, self._found(yaw, yaw_sigma_rad), strict=True)):
            found = before.combined(Angle(before.rad + off.rad, off.sigma_rad))
            angle, self.corrects[i] = before.corrected(found, self.corrects[i], CLEAR_SIGMA, LEAST_RAD)
            used.append(angle)
        self.known = used[0], used[1]
        step_rad = abs(complex(*self._angles()) - was)
        if step_rad >= LEAST_STEP_RAD:
            self._turn(chain, yaw, step_rad)

    def _back(self, yaw_rad: float) -> Array | None:
        """Rotation (3, 3) of readings levelled by what is known now to those levelled by what was
        known before the drive; None where it is the same."""
        if all(now.rad == before.rad for now, before in zip(self.known, self.before, strict=True)):
            return None
        first, now = (_rotation(angles) for angles in (self.before, self.known))
        about = gtsam.Rot3.Rz(yaw_rad).matrix()
        return np.asarray(about @ first @ now.T @ about.T)

    def _angles(self) -> tuple[float, float]:
        roll, pitch = self.known
        return roll.rad, pitch.rad

    def _found(self, yaw_rad: float, yaw_sigma_rad: float) -> tuple[Angle, Angle]:
        """Roll and pitch beyond those known before, by the axes in which the file has them."""
        roll, pitch = self._seen.angles(yaw_sigma_rad < AHEAD_KNOWN_RAD)
        off = complex(roll.rad, pitch.rad) * cmath.exp(-1j * yaw_rad)
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        sigma = (
            math.hypot(c * roll.sigma_rad, s * pitch.sigma_rad),
            math.hypot(s * roll.sigma_rad, c * pitch.sigma_rad),
        )
        return Angle(off.real, sigma[0]), Angle(off.imag, sigma[1])

    def _turn(self, chain: Chain, yaw_rad: float, step_rad: float) -> None:
        """Level the samples anew, and turn the newest state with them.

        Its attitude becomes what the accelerometer says without a bias ahead or to the side, as heights may
        have made one of the tilt; heading, place and velocity stay. The height is in doubt by `step_rad` of
        the distance driven.
        """
        was, about = self._imu.level, gtsam.Rot3.Rz(yaw_rad).matrix()
        self._level()
        turned = about @ _rotation(self.known) @ (np.eye(3) if was is None else was.T) @ about.T
        state = chain.state(chain.last)
        up = state.rotation[2]
        force = turned @ (GRAVITY_MPS2 * up + state.bias.accelerometer())
        now = force / np.linalg.norm(force)
        attitude = state.pose.rotation().compose(gtsam.Rot3.Expmap(-np.cross(up, now)))
        bias = turned @ state.bias.accelerometer()
        point = dataclasses.replace(
            state,
            pose=gtsam.Pose3(attitude, state.pose.translation()),
            bias=gtsam.imuBias.ConstantBias(now * (bias @ now), turned @ state.bias.gyroscope()),
        )
        doubt = np.zeros(chain.dim)
        doubt[:2], doubt[VELOCITY.stop - 1] = DOUBTFUL_RAD**2, DOUBTFUL_CLIMB_MPS**2
        doubt[5], doubt[BIAS] = (step_rad * self._seen.driven_m) ** 2, self._bias_sigma**2
        chain.restart(doubt, at=point)


def _rotation(level: tuple[Angle, Angle]) -> Array:
    """Rotation (3, 3) of the readings of an IMU tilted by roll and pitch into body axes, but for yaw."""
    roll, pitch = level
    return np.asarray(gtsam.Rot3.RzRyRx(roll.rad, pitch.rad, 0.0).matrix())
