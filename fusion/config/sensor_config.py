"""Sensor configuration: the channels of a log, and the graph that follows from them.

A log with all six IMU axes, fast enough to be integrated, gets the full graph. Otherwise the robot is taken
to drive on level ground (the planar graph, `graph/planar.py`): yaw from the gyro's z axis, else from the
difference of the wheels, else from GNSS alone. Notes tell which.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.channels import Gnss, Imu
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import SKIDDING
from terrafusion.datasets.core.sensors import ImuSpec, Rig
from terrafusion.fusion.graph.planar import PlanarPreintegrator, planar_spec
from terrafusion.fusion.graph.preintegration import Preintegrator

IMU_KINDS = ("six_axis", "gyro_z", "none")
SKID_YAW_RATIO = 0.6
"""True over geometric yaw rate of robots that skid in a turn: measured 0.44 to 0.71
(`docs/explanation/planar.md`). Wheels that roll turn the robot by the geometry."""
COMPLETE_SHARE = 0.5
"""Least share of IMU samples with all six axes for which the log counts as a six-axis one."""


LEAST_ACCEL_HZ = 18.0
"""Slower accelerations are not integrated: a sample of a vibrating robot is no mean over its interval."""


@dataclass(frozen=True)
class SensorConfig:
    """The sensors of an estimator; declared, never guessed from single samples.

    Attributes:
        imu: "six_axis", "gyro_z" (other axes may be NaN, the accelerometer too) or "none".
        sides: left and right wheels are distinguished; else body speed alone.
        gnss: fixes will come. Without them the graph starts at once, in a local frame.
        steered: steering angles will come, of a robot that has steered wheels.
        steering_wheel: they are those of a steering wheel.

    Raises:
        ConfigError: an unknown kind of IMU.
        DataError: no source of heading.
    """

    imu: str = "six_axis"
    sides: bool = True
    gnss: bool = True
    steered: bool = False
    steering_wheel: bool = False

    def __post_init__(self) -> None:
        if self.imu not in IMU_KINDS:
            raise ConfigError(f"unknown kind of IMU '{self.imu}'", remedy=f"give {', '.join(IMU_KINDS)}")
        if self.yaw == "none" and not self.gnss:
            raise DataError(
                "nothing tells the heading: no gyro z, body speed instead of two wheels, and no GNSS",
                channel="imu, wheels and gnss",
                remedy="add gyro_z_radps, the speeds of both sides, or fixes",
            )

    @property
    def planar(self) -> bool:
        """Whether the planar graph is used."""
        return self.imu != "six_axis"

    @property
    def yaw(self) -> str:
        """Source of the yaw rate: "gyro", "steering", "wheels" or "none"."""
        if self.imu != "none":
            return "gyro"
        if self.steered:
            return "steering"
        return "wheels" if self.sides else "none"

    def rig(self, rig: Rig) -> Rig:
        """The robot as the graph sees it: the effective track where yaw is the wheels'."""
        if not self.planar:
            return rig
        imu = planar_spec(rig.sensors.imu, self.yaw)
        track = rig.track_m / yaw_factor(rig) if self.yaw == "wheels" else rig.track_m
        return dataclasses.replace(rig, track_m=track, sensors=dataclasses.replace(rig.sensors, imu=imu))

    def preintegrator(self, spec: ImuSpec, skids: bool = True) -> Preintegrator:
        """Maker of the link between keyframes of a robot that skids in turns, or not."""
        return PlanarPreintegrator(spec, self.yaw, skids) if self.planar else Preintegrator(spec)

    def notes(self, recording: Recording, rig: Rig) -> tuple[str, ...]:
        """What was assumed of a log of the robot `rig`, in sentences."""
        notes = []
        if self.planar:
            notes.append(
                f"{_missing(recording.imu)}: a planar graph is used; roll and pitch are not estimated "
                "(taken as level), height only from GNSS"
            )
        if self.yaw == "wheels":
            source = f"assumed for {rig.drive}" if rig.known.yaw_factor is None else "by the vehicle file"
            notes.append(
                f"yaw is taken from the wheels: {yaw_factor(rig):g} of what their difference over the track "
                f"says ({source})"
            )
        elif self.yaw == "steering":
            notes.append("yaw is taken from the steering angles and the wheelbase; their zero is estimated")
        elif self.yaw == "none":
            notes.append("the log has body speed only and no gyro: the heading comes from GNSS alone")
        if not self.sides and not self.steered and self.yaw == "gyro":
            notes.append("the log has body speed only: the wheels tell nothing of yaw")
        return tuple(notes)


def yaw_factor(rig: Rig) -> float:
    """True over geometric yaw rate of the wheels."""
    known = rig.known.yaw_factor
    if known is not None:
        return known.number
    return SKID_YAW_RATIO if rig.drive in SKIDDING else 1.0


def sensor_config_of(recording: Recording, gnss: Gnss | None) -> SensorConfig:
    """Sensors of `recording`, with the fixes `gnss` for the estimator.

    Raises:
        DataError: no source of heading.
    """
    wheels = recording.wheels
    fixes = gnss is not None and bool(((gnss.fix > 0) & np.isfinite(gnss.enu_m[:, :2].sum(axis=1))).any())
    steering = recording.steering
    steered = steering is not None and bool(np.isfinite(steering.angle_rad).all(axis=1).any())
    of_wheel = steered and steering is not None and steering.names == ("steering_wheel",)
    sides = wheels is None or wheels.has_sides()
    return SensorConfig(imu_kind(recording.imu), sides, fixes, steered, of_wheel)


Sensors = SensorConfig | Recording | None
"""A declaration of sensors; see `sensors_of`."""


def sensors_of(declared: Sensors) -> SensorConfig:
    """Sensors as declared, or those of a log; None: a six-axis IMU, both sides of the wheels, and fixes.

    Raises:
        ConfigError: it is neither.
        DataError: no source of heading.
    """
    if isinstance(declared, Recording):
        return sensor_config_of(declared, declared.gnss)
    if declared is not None and not isinstance(declared, SensorConfig):
        raise ConfigError(
            f"sensors are declared by a {type(declared).__name__}", remedy="give a SensorConfig or a log"
        )
    return declared or SensorConfig()


def complete_samples(imu: Imu, kind: str) -> np.ndarray:
    """Which samples (N,) of the IMU have all values that its kind needs."""
    if kind == "six_axis":
        return np.asarray(np.isfinite(imu.gyro_radps.sum(axis=1) + imu.accel_mps2.sum(axis=1)))
    return np.asarray(np.isfinite(imu.gyro_radps[:, 2]))


def imu_kind(imu: Imu | None) -> str:
    """Which of `IMU_KINDS` the IMU of a log is; a slow one has no accelerations that could be used."""
    if imu is None or not complete_samples(imu, "gyro_z").any():
        return "none"
    return "six_axis" if _has_six_axes(imu) and not _is_slow(imu) else "gyro_z"


def _has_six_axes(imu: Imu) -> bool:
    six, z = int(complete_samples(imu, "six_axis").sum()), int(complete_samples(imu, "gyro_z").sum())
    return six >= COMPLETE_SHARE * z


def _is_slow(imu: Imu) -> bool:
    """Whether there are too few samples with six axes to integrate their accelerations."""
    t_ns = imu.t_ns[complete_samples(imu, "six_axis")]
    return len(t_ns) > 1 and float(np.median(np.diff(t_ns))) > 1e9 / LEAST_ACCEL_HZ


def _missing(imu: Imu | None) -> str:
    if imu is None or not len(imu):
        return "the log has no IMU"
    names = [
        f"gyro {axis}"
        for axis, absent in zip("xyz", np.all(np.isnan(imu.gyro_radps), axis=0).tolist(), strict=True)
        if absent
    ]
    absent_accel = np.asarray(np.all(np.isnan(imu.accel_mps2), axis=0))
    if absent_accel.all():
        names.append("accelerometer")
    else:
        names += [
            f"accelerometer {axis}"
            for axis, absent in zip("xyz", absent_accel.tolist(), strict=True)
            if absent
        ]
    if _has_six_axes(imu) and _is_slow(imu):
        return f"the accelerometer has fewer than {LEAST_ACCEL_HZ:g} samples a second, too few to integrate"
    if names:
        return f"the log has no {', no '.join(names)}"
    return "few rows of the IMU hold all six axes"
