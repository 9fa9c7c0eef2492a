"""A simulated run before its sensors: vehicle, ground and commands, checked and ready to be driven."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.analysis.summary import RunSummary, slip_ratios, summarise
from terrafusion.twin.effects.catalogue import by_key, checked
from terrafusion.twin.effects.steered import drive_terms
from terrafusion.twin.model.motion import BodyMotion, motion_of, wheel_shares
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vectors import vehicle_vector
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle, with_payload
from terrafusion.twin.scenario.commands import DrivenStates, drive
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.route import Route
from terrafusion.twin.scenario.scenario import Scenario
from terrafusion.twin.scenario.validity import check_ground, check_slip
from terrafusion.twin.sensors.effects import as_driven, true_motion, with_effects
from terrafusion.twin.sensors.gnss import best_fix


@dataclass(frozen=True, eq=False)
class RunSetup:
    """Everything that decides the motion of a run.

    Attributes:
        scenario, route: with ground, slope and payload of this run.
        vehicle: with its payload.
        plant: what the integrator drives.
        t_s: (N,) samples, at the rate of the IMU.
        effects: optional effects by key.
    """

    scenario: Scenario
    vehicle: VehicleParams
    route: Route
    plant: Plant
    t_s: Array
    effects: Mapping[str, float] = field(default_factory=dict)

    def drive(self, backend: str = "auto") -> DrivenStates:
        """Commands, inputs and integrated states."""
        vehicle = as_driven(self.vehicle, self.effects)
        return drive(self.scenario, self.t_s, vehicle, self.plant, backend)

    def motion(self, driven: DrivenStates) -> BodyMotion:
        """Motion of the body in the world."""
        motion = motion_of(self.t_s, driven.states, self.vehicle, *self.scenario.plane())
        return true_motion(motion, driven, self.plant, self.vehicle) if self.plant.effects else motion

    def summarise(self, driven: DrivenStates, motion: BodyMotion) -> tuple[Array, RunSummary]:
        """Slip ratios (N, 4) of the wheels, and the run in a few numbers.

        Raises:
            ConfigError: slip outside the range for which a soil was measured.
        """
        slip = slip_ratios(driven, motion, self.vehicle, self.plant)
        check_slip(self.route, self.plant.route.field, self.t_s, driven.states, slip)
        return slip, summarise(driven, motion, self.vehicle, slip)


def set_up(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    cross_slope_deg: float | None = None,
    payload_kg: float | None = None,
    payload_at_m: tuple[float, float, float] | None = None,
    seed: int = 0,
    soils: Mapping[str, SoilParams] | None = None,
    effects: Mapping[str, float] | None = None,
) -> RunSetup:
    """Load and check what `simulate_run` drives with the same arguments.

    Raises:
        ConfigError: unknown name, bad file, or a number out of range.
    """
    if not (terrain is None or isinstance(terrain, str | Path)):
        raise ConfigError(f"terrain is {terrain!r}", remedy="give the name of one ground, or its file")
    numbers = {"slope_deg": slope_deg, "cross_slope_deg": cross_slope_deg, "payload_kg": payload_kg}
    for key, value in numbers.items():
        if not (value is None or isinstance(value, Real)):
            raise ConfigError(f"'{key}' is {value!r}", remedy="give a number")
    vehicle = as_vehicle(vehicle)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    scenario = scenario.with_ground(terrain, slope_deg, cross_slope_deg)
    scenario = scenario.with_payload(payload_kg, payload_at_m)
    _check_numbers(scenario)
    _check_options(scenario, vehicle, seed)
    vehicle = with_payload(vehicle, scenario.payload_kg, scenario.payload_at_m)
    route = Route.of(scenario, soils)
    check_ground(route, scenario, vehicle)
    _check_stands(scenario, vehicle)
    slope, aspect = scenario.plane()
    parameters = vehicle_vector(vehicle, slope_rad=slope, aspect_rad=aspect)
    known = checked({**by_key(vehicle.effects), **by_key(effects or {})})
    plant = with_effects(Plant(parameters, route.table(seed)), known, drive_terms(vehicle.drive.type))
    rate = vehicle.sensors.imu.rate_hz
    count = max(2, round(scenario.duration_s * rate) + 1)
    return RunSetup(scenario, vehicle, route, plant, np.arange(count) / rate, known)


def _check_numbers(scenario: Scenario) -> None:
    """Numbers of a scenario that is made in Python: those of files are checked on loading."""
    segments = [dataclasses.asdict(segment) for segment in scenario.drive]
    given = {f"drive[{i}].{key}": value for i, one in enumerate(segments) for key, value in one.items()}
    points = enumerate(scenario.waypoints)
    given |= {f"waypoints[{i}][{k}]": value for i, point in points for k, value in enumerate(point)}
    given |= {"heading_deg": scenario.heading_deg, "duration_s": scenario.duration_s}
    for key, value in given.items():
        if not math.isfinite(value):
            raise ConfigError(f"'{key}' is {value}", file=scenario.name, remedy="give a finite number")
        if value <= 0.0 and key.endswith(("duration_s", ".period_s")):
            raise ConfigError(f"'{key}' is {value:g}", file=scenario.name, remedy="give a number above zero")
    if not scenario.route:
        raise ConfigError("'route' is empty", file=scenario.name, remedy="name at least one terrain")


def _check_options(scenario: Scenario, vehicle: VehicleParams, seed: int) -> None:
    limit, payload = vehicle.body.payload_max_kg, scenario.payload_kg
    if not 0.0 <= payload <= limit:
        raise ConfigError(
            f"payload {payload:g} kg is out of range", file=vehicle.name, remedy=f"give 0 to {limit:g} kg"
        )
    if scenario.payload_at_m is not None and scenario.payload_at_m[2] < 0.0:
        raise ConfigError(
            f"the payload is {-scenario.payload_at_m[2]:g} m below the ground",
            file=scenario.name,
            remedy="give its height above the ground, 0 to 5 m",
        )
    best, fix = best_fix(vehicle.sensors.gnss), scenario.gnss_fix
    if fix is not None and not Fix.SINGLE <= fix <= best:
        raise ConfigError(
            f"'gnss_fix' is {fix.name.lower()}, not a class the receiver of '{vehicle.name}' reaches",
            file=scenario.name,
            remedy=f"give single to {best.name.lower()}",
        )
    if not isinstance(seed, Integral):
        raise ConfigError(f"seed {seed!r} is no whole number", remedy="give one from 0")
    if seed < 0:
        raise ConfigError(f"seed {seed} is negative", remedy="give a whole number from 0")


def _check_stands(scenario: Scenario, vehicle: VehicleParams) -> None:
    share = wheel_shares(math.radians(scenario.heading_deg), vehicle, *scenario.plane()).min()
    if share <= 0.0:
        raise ConfigError(
            f"the robot tips over where it starts: its centre of gravity at {vehicle.body.cg_height_m:.2f} m "
            f"is not above its wheels",
            file=scenario.name,
            remedy="carry the payload lower or nearer to the centre, or lower the slope",
        )
