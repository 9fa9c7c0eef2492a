"""Sensor specifications: mounting positions, axes and noise.

Positions are in the body frame (`base_link`: x forward, y left, z up), metres.
Noise densities follow the Allan-variance convention (IEEE Std 952-1997): the
standard deviation of a rate averaged over tau is density / sqrt(tau).
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.quantity import Position, Sourced
from terrafusion.datasets.core.robot import DRIVES as DRIVES
from terrafusion.datasets.core.robot import SensorNumbers

AXES = {
    "+x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip

STEERED_DRIVES = DRIVES[3:]

ASSUMED_VELOCITY_SIGMA_MPS = 0.5
"""1 sigma of a velocity whose receiver reports none: data sheets promise .05 m/s in the open (assumed)."""
ASSUMED_SIGMA_M = {Fix.NONE: 3.0, Fix.SINGLE: 3.0, Fix.DGPS: 1.0, Fix.FLOAT: 0.5, Fix.FIXED: 0.02}
"""Sigma of each horizontal axis by class of fix, where neither log nor vehicle gives it; up has twice that.
Orders of magnitude of receivers' data sheets (RTK fixed 1 cm + 1 ppm, SBAS about 1 m), not measurements."""
COARSER = 3.0
"""A receiver whose data sheet has so many times the sigma of a class made no such fix (assumed)."""
CLASS_SIGMA_M = np.array([ASSUMED_SIGMA_M[fix] for fix in Fix])
"""The same by the number of the class."""


def axes_matrix(axes: tuple[str, ...]) -> Array:
    """Rotation matrix (3, 3) of sensor axes that lie along body x, y, z: v_body = matrix @ v_sensor.

    Raises:
        ValueError: the axes are not three of `AXES` that make a right-handed frame.
    """
    R = (
        np.array([AXES[axis] for axis in axes])
        if len(axes) == 3 and set(axes) <= set(AXES)
        else np.zeros((3, 3))
    )
    if np.linalg.det(R) < 0.5:
        raise ValueError(
            f"axes {list(axes)} are not a rotation; give three of {', '.join(AXES)} that make a "
            "right-handed frame"
        )
    return R


@dataclass(frozen=True)
class ImuSpec:
    """Inertial measurement unit: mounting and noise.

    `axes` lists the sensor axes that point along body x, y and z; a husky whose
    body x is minus the sensor's z reads `["-z", "-x", "+y"]`. It applies only
    to messages with this `frame_id`.
    """

    rate_hz: Annotated[float, Sourced("Hz", 1.0, 5000.0)]
    gyro_noise_radps_sqrthz: Annotated[float, Sourced("rad/s/sqrt(Hz)", 1e-7, 1.0)]
    gyro_bias_walk_radps2_sqrthz: Annotated[float, Sourced("rad/s2/sqrt(Hz)", 1e-9, 0.1)]
    gyro_bias_sigma_radps: Annotated[float, Sourced("rad/s", 0.0, 1.0)]
    accel_noise_mps2_sqrthz: Annotated[float, Sourced("m/s2/sqrt(Hz)", 1e-6, 10.0)]
    accel_bias_walk_mps3_sqrthz: Annotated[float, Sourced("m/s3/sqrt(Hz)", 1e-8, 1.0)]
    accel_bias_sigma_mps2: Annotated[float, Sourced("m/s2", 0.0, 5.0)]
    position_m: Position
    axes: tuple[str, ...] = ("+x", "+y", "+z")
    frame_id: str = "imu_link"

    def __post_init__(self) -> None:
        axes_matrix(self.axes)

    def base_from_sensor(self) -> Array:
        """Rotation matrix (3, 3): vector in the body frame = matrix @ vector in the sensor frame."""
        return axes_matrix(self.axes)

    @property
    def bias_sigma(self) -> Array:
        """1 sigma (6,) of the biases of the accelerometer, m/s2, then of the gyro, rad/s."""
        return np.repeat([self.accel_bias_sigma_mps2, self.gyro_bias_sigma_radps], 3)


@dataclass(frozen=True)
class WheelSpec:
    """Wheel encoders as the log has them: rate and resolution at the wheel."""

    rate_hz: Annotated[float, Sourced("Hz", 0.5, 5000.0)]
    quantum_rad: Annotated[float, Sourced("rad", 0.0, 1.0)]
    speed_sigma_mps: Annotated[float, Sourced("m/s", 0.0, 1.0)]


@dataclass(frozen=True)
class GnssSpec:
    """GNSS receiver: antenna position and accuracy (1 sigma)."""

    rate_hz: Annotated[float, Sourced("Hz", 0.05, 100.0)]
    sigma_horizontal_m: Annotated[float, Sourced("m", 1e-3, 100.0)]
    sigma_vertical_m: Annotated[float, Sourced("m", 1e-3, 200.0)]
    sigma_velocity_mps: Annotated[float, Sourced("m/s", 1e-3, 10.0)]
    correlation_time_s: Annotated[float, Sourced("s", 0.0, 3600.0)]
    antenna_m: Position


@dataclass(frozen=True)
class BarometerSpec:
    """Barometer: white noise of a sample (1 sigma), and the random walk of weather and wind."""

    rate_hz: Annotated[float, Sourced("Hz", 0.05, 500.0)]
    noise_pa: Annotated[float, Sourced("Pa", 0.0, 1000.0)]
    walk_paps_sqrthz: Annotated[float, Sourced("Pa/s/sqrt(Hz)", 0.0, 100.0)]
    position_m: Position


@dataclass(frozen=True)
class MagnetometerSpec:
    """Magnetometer in body axes: white noise per sample and axis, residual hard iron per axis (1 sigma)."""

    rate_hz: Annotated[float, Sourced("Hz", 0.05, 1000.0)]
    noise_t: Annotated[float, Sourced("T", 0.0, 1e-4)]
    hard_iron_sigma_t: Annotated[float, Sourced("T", 0.0, 1e-3)]


@dataclass(frozen=True)
class SteeringSpec:
    """Steered wheels: their limits, and how well the angle in a log is known.

    Angles are those of the bicycle model, one an axle; `four_wheel_steer` turns the rear wheels against
    the front ones. `ratio` is the angle of the steering wheel over that of the front wheels, None where it
    is not known; it matters for logs of a steering wheel only. The curvature that the angles show has the
    relative 1 sigma `scale_sigma` and their zero `offset_sigma_rad`.
    """

    max_angle_rad: Annotated[float, Sourced("rad", 0.02, 1.4)] = 0.6
    max_rate_radps: Annotated[float, Sourced("rad/s", 0.01, 50.0)] = 1.5
    ratio: Annotated[float, Sourced("", 0.05, 100.0)] | None = None
    scale_sigma: Annotated[float, Sourced("", 0.0, 1.0)] = 0.05
    offset_sigma_rad: Annotated[float, Sourced("rad", 0.0, 0.5)] = 0.02
    noise_rad: Annotated[float, Sourced("rad", 0.0, 0.5)] = 0.002


@dataclass(frozen=True)
class SensorSuite:
    """All sensors of a robot; barometer and magnetometer only where it has them."""

    imu: ImuSpec
    wheels: WheelSpec
    gnss: GnssSpec
    barometer: BarometerSpec | None = None
    magnetometer: MagnetometerSpec | None = None


@dataclass(frozen=True)
class Rig:
    """The geometry that readers and estimators need to interpret a recording.

    `track_m` is the track of the log's wheel odometry: a body twist (v, yaw rate) has the side speeds
    v -+ yaw rate * track / 2. `drive` is one of `DRIVES`; `steering` is None where no wheel is steered, else
    its curvature is (tan front - tan rear) / `wheelbase_m`. `known` is what is known of its sensors beside
    their data sheets.
    """

    wheel_radius_m: float
    track_m: float
    sensors: SensorSuite
    topics: dict[str, str] = field(default_factory=dict)
    drive: str = "skid_steer"
    wheelbase_m: float = 0.5
    steering: SteeringSpec | None = None
    known: SensorNumbers = field(default_factory=SensorNumbers)

    @property
    def quantum_m(self) -> float:
        """Travel of a wheel for one count of its encoder, m."""
        return self.sensors.wheels.quantum_rad * self.wheel_radius_m

    @property
    def ahead_m(self) -> float:
        """How far the body's origin, midway between the axles, lies ahead of the point that follows the
        wheels: the middle of the rear axle where the front wheels alone steer, else the origin itself.
        """
        return 0.5 * self.wheelbase_m if self.drive == "ackermann" else 0.0


UP_FACTOR = 2.0
NO_SIGMA = "fixes have no sigma"
"""What a note says of fixes whose sigma was assumed."""


def with_assumed_sigma(
    rig: Rig | None, sigma: Array, fix: NDArray[np.uint8], every: NDArray[np.uint8] | None = None
) -> tuple[Array, list[str]]:
    """Sigmas (N, 3), unknown and non-positive ones filled (`assumed_sigma`); a note where any was."""
    unknown = ~(sigma > 0.0)
    if not unknown[:, :2].any():
        sigma = np.where(unknown, np.nan, sigma)
        return sigma, []
    filled = int(unknown[:, :2].any(axis=1).sum())
    assumed, origin = assumed_sigma(rig, fix, every)
    return np.where(unknown, assumed, sigma), [f"gnss: {filled} {NO_SIGMA}; taken from {origin}"]


def assumed_sigma(
    rig: Rig | None, fix: NDArray[np.uint8], every: NDArray[np.uint8] | None = None
) -> tuple[Array, str]:
    """Sigmas (N, 3) of fixes that report none, and where they are from.

    The vehicle's sigma is that of the best class of fix in the log; a poorer one has at least the sigma
    `ASSUMED_SIGMA_M` of its class. A receiver far coarser than the best class did not make these fixes: then
    all have the sigma of their class.

    Args:
        fix: (N,) classes.
        every: classes of all fixes of the log, where `fix` are some of them.
    """
    spec, flat = rig.sensors.gnss if rig else None, CLASS_SIGMA_M[fix]
    best = CLASS_SIGMA_M[fix if every is None else every].min()
    if spec is None or spec.sigma_horizontal_m > COARSER * best:
        return _by_class(flat), f"their class (assumed, flat): {_classes(fix)}"
    poorer = flat > best
    own = np.array([spec.sigma_horizontal_m] * 2 + [spec.sigma_vertical_m])
    origin = f"the vehicle's receiver, {spec.sigma_horizontal_m:g} m flat"
    if poorer.any():
        origin += f", and by class: {_classes(fix[poorer])}"
    return np.where(poorer[:, None], np.maximum(_by_class(flat), own), own), origin


def _by_class(flat: Array) -> Array:
    return np.stack([flat, flat, UP_FACTOR * flat], axis=1)


def _classes(fix: NDArray[np.uint8]) -> str:
    return ", ".join(f"{Fix(k).name.lower()} {ASSUMED_SIGMA_M[Fix(k)]:g} m" for k in np.unique(fix))
