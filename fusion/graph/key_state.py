"""The state of one keyframe and its tangent space."""

import functools
import math
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafusion.datasets.core.arrays import Array

LINEAR = (
    "slip",
    "gnss_drift_e_m",
    "gnss_drift_n_m",
    "yaw_scale",
    "icr_x_m",
    "side_slip",
    "radius_scale",
    "antenna_x_m",
    "antenna_y_m",
    "imu_roll_rad",
    "imu_pitch_rad",
    "imu_yaw_rad",
    "wheel_delay_s",
    "gnss_delay_s",
    "surge_slip",
)
"""States that live in a vector space, in the order of the tangent:

- slip: 1 - v / (omega R), one for the robot; wanders about the ground's mean.
- gnss_drift: slow error of the receiver's positions, east and north.
- yaw_scale: true over wheel yaw rate, less one; negative where skid steering widens the effective track.
- icr_x: centre of rotation ahead of the body origin; v_lateral = -icr_x yaw_rate.
- side_slip: lateral over forward speed, by slope and ruts.
- radius_scale: true over nominal wheel radius, less one.
- antenna: correction of the vehicle file's lever arm.
- imu: small rotation from the IMU's axes to the body's, beyond the vehicle file's.
- wheel_delay, gnss_delay: lateness of a sensor's stamps against the IMU's.
- surge_slip: additional slip per gravity of wheel acceleration."""
ON_DEMAND = LINEAR[LINEAR.index("radius_scale") :]
"""The states that only a calibration estimates."""
CALIBRATION = ON_DEMAND[: ON_DEMAND.index("surge_slip")]
"""Those of them that are constant."""

DIM = 15 + len(LINEAR)
"""Length of the whole tangent; without calibration it ends before `ON_DEMAND`."""
POSE, VELOCITY, BIAS = slice(0, 6), slice(6, 9), slice(9, 15)
NAV, MARKOV = slice(0, 15), slice(15, DIM)
"""The states that GTSAM holds, and the linear ones."""
SLIP, DRIFT, YAW_SCALE, ICR_X, SIDE_SLIP, RADIUS = 15, slice(16, 18), 18, 19, 20, 21
ANTENNA, IMU_ROTATION, WHEEL_DELAY, GNSS_DELAY, SURGE_SLIP = slice(22, 24), slice(24, 27), 27, 28, 29


@dataclass(frozen=True, eq=False)
class KeyState:
    """State of a keyframe: `pose` Pose3, `velocity` (3,), `bias` ConstantBias, `linear` (15,) as `LINEAR`."""

    pose: gtsam.Pose3
    velocity: Array
    bias: gtsam.imuBias.ConstantBias
    linear: Array

    def of(self, place: int | slice) -> Array:
        """Linear states by their place in the tangent, such as `DRIFT`."""
        return self.linear[among_linear(place) if isinstance(place, slice) else place - NAV.stop]

    @functools.cached_property
    def rotation(self) -> Array:
        """Rotation (3, 3) body to world."""
        return np.asarray(self.pose.rotation().matrix())

    def place_of(self, body_m: Array) -> Array:
        """Place (3,) in the world of a point of the body, m."""
        return np.asarray(self.pose.translation() + self.rotation @ body_m)

    @property
    def slip(self) -> float:
        """Longitudinal slip."""
        return float(self.linear[0])

    @property
    def forward_mps(self) -> float:
        """Speed along body x, m/s."""
        return float(self.rotation[:, 0] @ self.velocity)

    @property
    def rolling(self) -> float:
        """Distance over wheel distance, longitudinally: by slip and radius."""
        return float((1.0 - self.linear[0]) * (1.0 + self.linear[RADIUS - NAV.stop]))

    @property
    def turning(self) -> float:
        """Angle turned over that of the wheels."""
        return float(1.0 + self.linear[YAW_SCALE - NAV.stop])

    def retract(self, delta: Array) -> "KeyState":
        """The state moved by a tangent vector (DIM,) or (DIM - len(ON_DEMAND),)."""
        linear = self.linear.copy()
        linear[: len(delta) - NAV.stop] += delta[NAV.stop :]
        bias = gtsam.imuBias.ConstantBias(
            self.bias.accelerometer() + delta[9:12], self.bias.gyroscope() + delta[12:15]
        )
        return KeyState(self.pose.retract(delta[POSE]), self.velocity + delta[VELOCITY], bias, linear)

    def local(self, other: "KeyState") -> Array:
        """The vector (DIM,) from this state to `other`, to first order that of `retract`.

        The place is linear, in the body axes of this state: fixes know the sum of place and drift, whatever
        the heading. In the logarithm of a pose they would seem to show a heading that is far from known.
        """
        return np.concatenate(
            [
                gtsam.Rot3.Logmap(self.pose.rotation().between(other.pose.rotation())),
                self.rotation.T @ (other.pose.translation() - self.pose.translation()),
                other.velocity - self.velocity,
                other.bias.vector() - self.bias.vector(),
                other.linear - self.linear,
            ]
        )

    def rate(self, gyro_radps: Array) -> Array:
        """Angular rate (3,) of the body from a gyro reading: bias and mounting corrected."""
        return self._turned(gyro_radps - self.bias.gyroscope(), gyro_radps)

    def specific_force(self, accel_mps2: Array) -> Array:
        """Specific force (3,) of the body from an accelerometer reading, likewise."""
        return self._turned(accel_mps2 - self.bias.accelerometer(), accel_mps2)

    def reading(self, rate_radps: Array) -> Array:
        """The gyro reading (3,) of an angular rate; the inverse of `rate` to first order."""
        reading = rate_radps + self.bias.gyroscope()
        return np.asarray(reading - self._mounting(reading))

    def _mounting(self, reading: Array) -> Array:
        return self._turned(np.zeros(3), reading)

    def _turned(self, true: Array, reading: Array) -> Array:
        """`true` and what the rotation of the IMU adds to it, where there is one."""
        turn = self.of(IMU_ROTATION)
        return true + cross(turn, reading) if any(turn.tolist()) else true

    def bias_seen(self, gyro_radps: Array, accel_mps2: Array) -> gtsam.imuBias.ConstantBias:
        """The bias equivalent to bias and mounting: a small rotation d adds d x measured to a reading."""
        return gtsam.imuBias.ConstantBias(
            self.bias.accelerometer() - self._mounting(accel_mps2),
            self.bias.gyroscope() - self._mounting(gyro_radps),
        )


def among_linear(place: slice) -> slice:
    """A place of the tangent, such as `DRIFT`, among the linear states."""
    return slice(place.start - NAV.stop, place.stop - NAV.stop)


def linear_sigma(P: Array) -> Array:
    """1 sigma (..., 15) of the linear states from covariances (..., dim, dim); NaN where not estimated."""
    out = np.full((*P.shape[:-2], len(LINEAR)), np.nan)
    estimated = P.diagonal(axis1=-2, axis2=-1)[..., NAV.stop :]
    np.sqrt(estimated, out=out[..., : estimated.shape[-1]])
    return out


def cross(a: Array, b: Array) -> Array:
    """a x b of two vectors (3,), in a tenth of `np.cross`'s time."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def skew(v: Array) -> Array:
    """The matrix (3, 3) with skew(v) @ u = v x u."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def yaw_of(R: Array) -> float:
    """Heading of the body's x axis, rad: 0 east, left positive."""
    return math.atan2(R[1, 0], R[0, 0])


def quaternion_of(pose: gtsam.Pose3) -> Array:
    """Orientation (4,) x, y, z, w."""
    return np.asarray(pose.rotation().toQuaternion().coeffs())  # type: ignore[attr-defined,unused-ignore]
