"""Vehicle parameters: what the twin drives and what the estimator knows of a robot.

A vehicle is a YAML file in `twin/params/vehicles` (or the user's own): every
number stands as `{value, source}` under a key that carries its unit. A file may
also give only what differs from another one (`vehicle_file`).
Body frame: x forward, y left, z up; its origin lies in the ground plane,
midway between the four contact points.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from terrafusion.datasets.core.config import refuse, structure
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.quantity import Sourced, Word
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.robot import SensorNumbers
from terrafusion.datasets.core.sensors import DRIVES, STEERED_DRIVES, Rig, SensorSuite, SteeringSpec
from terrafusion.datasets.core.tables import text_html
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.sensor_realism import SensorRealism
from terrafusion.twin.model.vehicle_file import read_vehicle

GEOMETRY = {"wheel_radius_m": "wheel.radius_m", "track_m": "body.track_m", "wheelbase_m": "body.wheelbase_m"}
"""Odometry geometry a log may report, and the number of the body that it replaces, unless `measured`."""


@dataclass(frozen=True)
class Body:
    """Rigid body on four wheels; the centre of gravity is given from the body origin."""

    mass_kg: Annotated[float, Sourced("kg", 0.1, 50000.0)]
    payload_max_kg: Annotated[float, Sourced("kg", 0.0, 50000.0)]
    yaw_inertia_kgm2: Annotated[float, Sourced("kg m2", 1e-5, 1e6)]
    wheelbase_m: Annotated[float, Sourced("m", 0.03, 5.0)]
    track_m: Annotated[float, Sourced("m", 0.05, 5.0)]
    cg_forward_m: Annotated[float, Sourced("m", -1.0, 1.0)]
    cg_left_m: Annotated[float, Sourced("m", -1.0, 1.0)]
    cg_height_m: Annotated[float, Sourced("m", 0.0, 3.0)]


@dataclass(frozen=True)
class Wheel:
    """One of the four equal wheels; `inertia_kgm2` includes the reflected rotor.

    Grousers stand out by `grouser_height_m`, `grouser_count` around the rim; 0 is a smooth wheel.
    """

    radius_m: Annotated[float, Sourced("m", 0.02, 2.0)]
    width_m: Annotated[float, Sourced("m", 0.005, 2.0)]
    inertia_kgm2: Annotated[float, Sourced("kg m2", 1e-7, 1e5)]
    grouser_height_m: Annotated[float, Sourced("m", 0.0, 0.3)] = 0.0
    grouser_count: Annotated[float, Sourced("", 0.0, 200.0)] = 0.0


@dataclass(frozen=True)
class DriveTrain:
    """How the robot turns (`type`), one motor and gearbox a wheel, its speed loop, and the command limits.

    Torque-speed line: stall torque at rest falling to zero at the no-load
    speed; the current limit caps it at `torque_limit_nm` (motor shaft). The
    no-load current is what friction in motor, gears and belts takes at any load.
    """

    gear_ratio: Annotated[float, Sourced("", 1.0, 1000.0)]
    gear_efficiency: Annotated[float, Sourced("", 0.1, 1.0)]
    no_load_speed_radps: Annotated[float, Sourced("rad/s", 1.0, 10000.0)]
    stall_torque_nm: Annotated[float, Sourced("N m", 1e-5, 1e5)]
    torque_limit_nm: Annotated[float, Sourced("N m", 1e-5, 1e5)]
    supply_v: Annotated[float, Sourced("V", 1.0, 1000.0)]
    speed_loop_p_nms: Annotated[float, Sourced("N m s/rad at the wheel", 1e-5, 1e6)]
    speed_loop_i_nm: Annotated[float, Sourced("N m/rad at the wheel", 0.0, 5e6)]
    lag_s: Annotated[float, Sourced("s", 0.001, 1.0)]
    dead_time_s: Annotated[float, Sourced("s", 0.0, 2.0)]
    max_speed_mps: Annotated[float, Sourced("m/s", 0.05, 50.0)]
    max_accel_mps2: Annotated[float, Sourced("m/s2", 0.05, 50.0)]
    max_yaw_accel_radps2: Annotated[float, Sourced("rad/s2", 0.05, 50.0)]
    no_load_current_a: Annotated[float, Sourced("A", 0.0, 100.0)] = 0.0
    type: Annotated[str, Word(DRIVES)] = "skid_steer"


@dataclass(frozen=True)
class Battery:
    """What feeds all motors: open-circuit voltage, linear from full to empty, behind a resistance.

    `charge` is the share of `capacity_wh` it holds at the start of a run.
    """

    full_v: Annotated[float, Sourced("V", 1.0, 1000.0)]
    empty_v: Annotated[float, Sourced("V", 1.0, 1000.0)]
    resistance_ohm: Annotated[float, Sourced("ohm", 0.0, 10.0)]
    capacity_wh: Annotated[float, Sourced("W h", 1.0, 1e6)]
    charge: Annotated[float, Sourced("", 0.0, 1.0)]

    def __post_init__(self) -> None:
        if self.empty_v > self.full_v:
            raise ValueError(f"empty_v {self.empty_v:g} is above full_v {self.full_v:g}")


@dataclass(frozen=True)
class Odometry:
    """Geometry the robot's own wheel odometry assumes (it need not be the true one)."""

    wheel_radius_m: Annotated[float, Sourced("m", 0.02, 2.0)]
    track_m: Annotated[float, Sourced("m", 0.05, 5.0)]


@dataclass(frozen=True, repr=False)
class VehicleParams:
    """A four-wheel robot: body, drive, steering where it has any, odometry and sensors.

    Without a battery the motors are fed with `drive.supply_v`, whatever they draw. `effects` are optional
    effects by key (docs/reference/effects.md) that this robot, or what it drives on, is known to have, as
    `terrafusion gap` finds them: the twin has them in every run. `measured` are numbers, by dotted name,
    that were found for the body of this very robot: the geometry that a log assumes does not replace them.
    `robot` is what is known of its sensors, as `terrafusion calibrate --sensors` finds it.
    """

    name: str
    description: str
    body: Body
    wheel: Wheel
    drive: DriveTrain
    odometry: Odometry
    sensors: SensorSuite
    realism: SensorRealism
    battery: Battery | None = None
    topics: dict[str, str] = field(default_factory=dict)
    effects: dict[str, Annotated[float, Sourced("")]] = field(default_factory=dict)
    measured: tuple[str, ...] = ()
    steering: SteeringSpec | None = None
    robot: SensorNumbers = field(default_factory=SensorNumbers)

    @classmethod
    def load(cls, name_or_path: str | Path) -> "VehicleParams":
        """A vehicle by its name in the library, or from a YAML file; see `load_vehicle`."""
        return load_vehicle(name_or_path)

    def __repr__(self) -> str:
        body, odometry, gnss = self.body, self.odometry, self.sensors.gnss
        lines = [
            f"Vehicle '{self.name}': {self.description}",
            f"  body: {body.mass_kg:g} kg, track {body.track_m:g} m, wheelbase {body.wheelbase_m:g} m",
            f"  odometry: wheel radius {odometry.wheel_radius_m:g} m, track {odometry.track_m:g} m",
            f"  drive: {self.drive.type}",
            f"  sensors: antenna at {gnss.antenna_m} m, IMU at {self.sensors.imu.position_m} m",
        ]
        if self.effects:
            lines.append(f"  effects: {', '.join(sorted(self.effects))}")
        if self.measured:
            lines.append(f"  measured on this robot: {', '.join(self.measured)}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return text_html(repr(self))

    def rig(self) -> Rig:
        """What a reader or an estimator needs: odometry geometry, sensors and topic names."""
        return Rig(
            wheel_radius_m=self.odometry.wheel_radius_m,
            track_m=self.odometry.track_m,
            sensors=self.sensors,
            topics=dict(self.topics),
            drive=self.drive.type,
            wheelbase_m=self.body.wheelbase_m,
            steering=self.steered(),
            known=self.robot,
        )

    def steered(self) -> SteeringSpec | None:
        """Its steering, with assumed limits where the file gives none; None where no wheel is steered."""
        return (self.steering or SteeringSpec()) if self.drive.type in STEERED_DRIVES else None


def vehicle_names() -> tuple[str, ...]:
    """Names of the vehicles that come with the library."""
    return known_names("vehicles")


def load_vehicle(name_or_path: str | Path) -> VehicleParams:
    """A vehicle by its name in the library, or from a YAML file.

    Raises:
        ConfigError: unknown name (the known ones are listed), or a file that
            does not keep to the parameters' names, units and ranges.
    """
    raw, file = read_vehicle(name_or_path)
    found = structure(VehicleParams, raw, file=file)
    refuse(_problems(found), file)
    return found


def _problems(found: VehicleParams) -> Iterator[tuple[str, str]]:
    """What is wrong beyond single values, and the remedy."""
    for name in found.measured:
        section, _, last = name.partition(".")
        if not last or not isinstance(getattr(getattr(found, section, None), last, None), float):
            yield f"measured: there is no number '{name}'", "give dotted names such as body.track_m"
    if found.steering is not None and found.drive.type not in STEERED_DRIVES:
        yield f"steering: drive.type is '{found.drive.type}'", f"give one of {', '.join(STEERED_DRIVES)}"
    if found.effects:
        from terrafusion.twin.effects.catalogue import checked

        for key, value in found.effects.items():
            try:
                checked({key: value})
            except ConfigError as error:
                yield f"effects: {error.what}", error.remedy or ""


def as_vehicle(vehicle: str | Path | VehicleParams) -> VehicleParams:
    """The vehicle of a name, of a YAML file, or itself."""
    return vehicle if isinstance(vehicle, VehicleParams) else load_vehicle(vehicle)


def with_payload(
    vehicle: VehicleParams, payload_kg: float, at_m: tuple[float, float, float] | None = None
) -> VehicleParams:
    """The vehicle with a payload whose centre of gravity is at `at_m` (body frame), or at the vehicle's own.

    The payload is taken to spread as the vehicle does: it has the vehicle's radius of gyration about
    its own centre of gravity (assumed), and both turn about the common one by the parallel axis theorem.
    """
    body = vehicle.body
    own = (body.cg_forward_m, body.cg_left_m, body.cg_height_m)
    share = payload_kg / (body.mass_kg + payload_kg)
    arm = tuple(a - b for a, b in zip(at_m or own, own, strict=True))
    forward, left, height = (b + share * w for b, w in zip(own, arm, strict=True))
    spread = body.yaw_inertia_kgm2 * (1.0 + payload_kg / body.mass_kg)
    loaded = dataclasses.replace(
        body,
        mass_kg=body.mass_kg + payload_kg,
        yaw_inertia_kgm2=spread + body.mass_kg * share * (arm[0] ** 2 + arm[1] ** 2),
        cg_forward_m=forward,
        cg_left_m=left,
        cg_height_m=height,
    )
    return dataclasses.replace(vehicle, body=loaded)


def with_overrides(vehicle: VehicleParams, overrides: Overrides) -> VehicleParams:
    """The vehicle with what a log reports: drive, wheel radius, track, wheelbase, steering, sensors' places.

    Radius, track and wheelbase replace the odometry's numbers and, unless `measured`, the body's: the log
    knows one geometry only.
    """
    body, wheel, odometry, sensors = vehicle.body, vehicle.wheel, vehicle.odometry, vehicle.sensors
    if overrides.wheel_radius_m is not None:
        if GEOMETRY["wheel_radius_m"] not in vehicle.measured:
            wheel = dataclasses.replace(wheel, radius_m=overrides.wheel_radius_m)
        odometry = dataclasses.replace(odometry, wheel_radius_m=overrides.wheel_radius_m)
    if overrides.track_m is not None:
        if GEOMETRY["track_m"] not in vehicle.measured:
            body = dataclasses.replace(body, track_m=overrides.track_m)
        odometry = dataclasses.replace(odometry, track_m=overrides.track_m)
    if overrides.wheelbase_m is not None and GEOMETRY["wheelbase_m"] not in vehicle.measured:
        body = dataclasses.replace(body, wheelbase_m=overrides.wheelbase_m)
    drive, steering = vehicle.drive, vehicle.steering
    if overrides.drive is not None:
        drive = dataclasses.replace(drive, type=overrides.drive)
        steering = steering if overrides.drive in STEERED_DRIVES else None
    if overrides.steering_ratio is not None and drive.type in STEERED_DRIVES:
        steering = dataclasses.replace(steering or SteeringSpec(), ratio=overrides.steering_ratio)
    robot = vehicle.robot
    if overrides.antenna_m is not None and not _antenna_calibrated(vehicle):
        robot = dataclasses.replace(robot, antenna_m=None)
        gnss = dataclasses.replace(sensors.gnss, antenna_m=overrides.antenna_m)
        sensors = dataclasses.replace(sensors, gnss=gnss)
    if overrides.imu_m is not None:
        imu = dataclasses.replace(sensors.imu, position_m=overrides.imu_m)
        sensors = dataclasses.replace(sensors, imu=imu)
    return dataclasses.replace(
        vehicle, body=body, wheel=wheel, odometry=odometry, sensors=sensors, drive=drive, steering=steering,
        robot=robot,
    )  # fmt: skip


def _antenna_calibrated(vehicle: VehicleParams) -> bool:
    """Whether logs of this robot gave the place of its antenna: what a log assumes does not replace it."""
    return vehicle.robot.antenna_m is not None and vehicle.robot.antenna_m.known == "calibrated"


def reported_geometry(recordings: Sequence[Recording]) -> Overrides:
    """The geometry that logs of one vehicle report; the drive that some leave out is that of the others.

    Raises:
        DataError: two of them differ.
    """
    first = recordings[0]
    drive = next((r.overrides.drive for r in recordings if r.overrides.drive is not None), None)
    reported = dataclasses.replace(first.overrides, drive=drive)
    for recording in recordings[1:]:
        own = dataclasses.replace(recording.overrides, drive=recording.overrides.drive or drive)
        differing = [name for name, value in vars(own).items() if value != getattr(reported, name)]
        if differing:
            raise DataError(
                f"it reports another geometry of the vehicle ({listed_overrides(recording.overrides)}) than "
                f"{first.name} ({listed_overrides(first.overrides)})",
                file=recording.name,
                remedy=f"give logs of one vehicle, or the same {' and '.join(differing)} in their meta.yaml "
                "(`terrafusion convert` makes a folder with one of a bag)",
            )  # fmt: skip
    return reported


def listed_overrides(overrides: Overrides) -> str:
    """The geometry a log reports, in words."""
    values = dataclasses.asdict(overrides).items()
    return ", ".join(f"{name} = {_in_words(value)}" for name, value in values if value is not None) or "none"


def _in_words(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_in_words, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def geometry_notes(vehicle: VehicleParams, overrides: Overrides) -> tuple[str, ...]:
    """What `with_overrides` takes from a log, and what it leaves, in a sentence."""
    if overrides == Overrides():
        return ()
    note = f"the log's own geometry is used: {listed_overrides(overrides)}"
    reported = [number for name, number in GEOMETRY.items() if getattr(overrides, name) is not None]
    retained = [number for number in reported if number in vehicle.measured]
    if retained:
        note += f"; measured on this robot before, and retained for its body: {', '.join(retained)}"
    if overrides.antenna_m is not None and _antenna_calibrated(vehicle):
        note += "; the antenna is where calibration found it"
    return (note,)
