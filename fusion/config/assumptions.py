"""The numbers a run used that neither log nor vehicle file gives, and how far they may be off."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.channels import Fix, Gnss
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.robot import antenna_spread_m
from terrafusion.datasets.core.sensors import ASSUMED_SIGMA_M, ASSUMED_VELOCITY_SIGMA_MPS, STEERED_DRIVES
from terrafusion.fusion.config.sensor_config import SensorConfig
from terrafusion.twin.model.vehicle import VehicleParams, vehicle_names
from terrafusion.twin.model.vehicle_file import read_vehicle


@dataclass(frozen=True)
class RobotNumber:
    """A number of a vehicle file: its place there, and 1 sigma of a value that nobody measured.

    `override` is the field of `Overrides` by which a log gives it.
    """

    section: tuple[str, ...]
    override: str
    unit: str
    sigma: float


NUMBERS = {
    "wheel_radius_m": RobotNumber(("odometry", "wheel_radius_m"), "wheel_radius_m", "m", 0.05),
    "track_m": RobotNumber(("odometry", "track_m"), "track_m", "m", 0.2),
    "wheelbase_m": RobotNumber(("body", "wheelbase_m"), "wheelbase_m", "m", 0.5),
    "antenna_m": RobotNumber(("sensors", "gnss", "antenna_m"), "antenna_m", "m", 0.3),
    "imu_m": RobotNumber(("sensors", "imu", "position_m"), "imu_m", "m", 0.2),
}
"""Sigmas: half the range over robots of 15 to 100 kg with wheels of 0.1 to 0.3 m (assumed)."""
OWN_PLACES = ("antenna_m", "imu_m")
"""Where these sit is each robot's own: in a file that comes with the library they are those of one robot."""
YAW_FACTOR_SIGMA = 0.15
"""Half the range of the factors measured (docs/explanation/planar.md)."""
TAKEN = ("assumed", "taken as", "taken for", "taken from", "brought to", "rotated from", "nominal")
"""Words by which readers note what they took for granted."""


@dataclass(frozen=True)
class Assumption:
    """One assumed number: `value` in `unit`, its 1 sigma, None where it is arbitrary."""

    name: str
    value: Any
    sigma: float | None
    unit: str

    def __str__(self) -> str:
        if isinstance(self.value, str):
            return f"{self.name}: {self.value}"
        value = np.round(self.value, 6).tolist()
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        spread = "" if self.sigma is None else f" +- {self.sigma:g}"
        return f"{self.name} = {shown}{spread} {self.unit}".rstrip()


def assumptions(
    recording: Recording,
    asked: str | Path | VehicleParams | None,
    vehicle: VehicleParams,
    inputs: SensorConfig,
    used: Gnss | None,
) -> tuple[Assumption, ...]:
    """What a run of `vehicle`, chosen for what was `asked`, assumed."""
    found = [*_of_the_vehicle(recording, asked, vehicle, inputs, used)]
    if inputs.yaw == "wheels":
        rig = vehicle.rig()
        factor = rig.track_m / inputs.rig(rig).track_m
        found.append(Assumption("yaw_factor", factor, YAW_FACTOR_SIGMA, ""))
    found += [*_of_the_fixes(recording, used), *_of_the_reader(recording)]
    return tuple(found)


def _of_the_vehicle(
    recording: Recording,
    asked: str | Path | VehicleParams | None,
    vehicle: VehicleParams,
    inputs: SensorConfig,
    used: Gnss | None,
) -> Iterator[Assumption]:
    sources, shipped = _sources(asked or recording.vehicle, vehicle.name)
    wheels = recording.wheels
    needed = {
        "wheel_radius_m": wheels is not None and wheels.unit == "radps",
        "track_m": inputs.sides,
        "wheelbase_m": vehicle.drive.type in STEERED_DRIVES,
        "antenna_m": used is not None and bool(len(used)),
        "imu_m": inputs.imu == "six_axis",
    }
    for name, number in NUMBERS.items():
        given = getattr(recording.overrides, number.override) is not None
        if not needed[name] or given or ".".join(number.section) in vehicle.measured:
            continue
        if _is_assumed(sources, number.section) or (shipped and name in OWN_PLACES):
            value = functools.reduce(getattr, number.section, vehicle)
            size_m = antenna_spread_m(vehicle.body.wheelbase_m) if name == "antenna_m" else 0.0
            yield Assumption(name, value, round(max(number.sigma, size_m), 2), number.unit)
    bias = ("sensors", "imu", "gyro_bias_sigma_radps")
    if inputs.imu != "none" and vehicle.robot.gyro_bias_radps is None and _is_assumed(sources, bias):
        sigma = vehicle.sensors.imu.gyro_bias_sigma_radps
        yield Assumption("gyro_bias_radps", 0.0, sigma, "rad/s")


def _is_assumed(sources: dict[str, Any], section: tuple[str, ...]) -> bool:
    entry: Any = sources
    for key in section:
        entry = entry.get(key, {}) if isinstance(entry, dict) else {}
    return isinstance(entry, dict) and str(entry.get("source", "")).startswith("assumed")


def _of_the_fixes(recording: Recording, used: Gnss | None) -> Iterator[Assumption]:
    gnss = recording.gnss
    if used is None or gnss is None or not len(used):
        yield Assumption("start_position_m", (0.0, 0.0), None, "m")
        yield Assumption("start_heading_rad", 0.0, None, "rad")
        return
    if recording.datum is None:
        yield Assumption("datum", "origin of the log's own frame", None, "")
    unknown = ~(gnss.sigma_enu_m[:, :2] > 0.0).all(axis=1) & (gnss.fix != Fix.NONE)
    for fix in np.unique(gnss.fix[unknown]).tolist():
        sigma = ASSUMED_SIGMA_M[Fix(fix)]
        yield Assumption(f"gnss_sigma_m ({Fix(fix).name.lower()})", sigma, sigma, "m")
    velocity, sigma_v = gnss.velocity_enu_mps, gnss.sigma_v_mps
    if velocity is not None and (sigma_v is None or not (sigma_v > 0.0).any()):
        yield Assumption("gnss_velocity_sigma_mps", ASSUMED_VELOCITY_SIGMA_MPS, None, "m/s")


def _of_the_reader(recording: Recording) -> Iterator[Assumption]:
    """What a reader took for granted, in its own words, by channel: axes, stamps, classes, sigmas."""
    for note in recording.notes:
        channel, colon, what = note.partition(": ")
        if colon and channel in (*Recording.CHANNELS, "truth") and any(word in what for word in TAKEN):
            yield Assumption(channel, what, None, "")


def _sources(asked: object, vehicle: str) -> tuple[dict[str, Any], bool]:
    """Content of the vehicle's file, and whether it comes with the library; empty where there is none."""
    for name in (asked, vehicle):
        if isinstance(name, str | Path) and str(name):
            try:
                raw, _ = read_vehicle(name)
            except ConfigError:
                continue
            return raw, str(name) in vehicle_names()
    return {}, False
