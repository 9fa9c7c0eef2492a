"""`simulate`: one drive of the twin, as a `Recording` with truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Command, Fix, Terrain
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.frames import matrix_to_quaternion
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.twin.analysis.summary import RunSummary, slip_ratios, summarise
from terrafusion.twin.effects.catalogue import checked
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.model.ground import patch_share
from terrafusion.twin.model.library import assumed
from terrafusion.twin.model.motion import BodyMotion, motion_of, wheel_shares
from terrafusion.twin.model.plant import Plant
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vectors import vehicle_vector
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle, with_payload
from terrafusion.twin.physics.layout import INDEX, VEHICLE_PARAMETERS, state_slice
from terrafusion.twin.scenario.commands import DrivenStates, drive
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.route import Route
from terrafusion.twin.scenario.scenario import Scenario
from terrafusion.twin.scenario.validity import check_ground, check_slip
from terrafusion.twin.sensors import suite as sensors
from terrafusion.twin.sensors.effects import as_driven, sensed, true_motion, with_effects

Array = NDArray[np.float64]

START_NS = 1_704_067_200 * 10**9
"""Simulated drives start on 2024-01-01 00:00 UTC."""
DATUM = (52.0, 8.0, 100.0)
"""ENU origin of simulated drives: latitude deg, longitude deg, height m."""
_TERRAIN_HZ = 10.0
_COMMAND_HZ = 50.0
_TIPPING_ROWS = 10
"""Whether the robot tips over is looked at in every so many samples."""


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A recording with what no sensor sees.

    Attributes:
        recording: the drive as sensors report it, with truth.
        t_s: (N,) seconds, at the IMU's rate.
        states: (N, X) in the order of `layout.STATES`.
        slip: (N, 4) slip ratio of each wheel, (w R - u) / max(|w R|, |u|), 0 at rest.
        summary: the run in a few numbers.
        wanted: (N, 2) commanded twist before limits, m/s and rad/s.
    """

    recording: Recording
    t_s: Array
    states: Array
    slip: Array
    summary: RunSummary
    wanted: Array


@dataclass(frozen=True, eq=False)
class RunSetup:
    """A run before it is driven: the vehicle with its payload; `t_s` (N,), the samples at the IMU's rate."""

    scenario: Scenario
    vehicle: VehicleParams
    route: Route
    plant: Plant
    t_s: Array
    effects: Mapping[str, float] = field(default_factory=dict)

    def motion(self, states: Array, inputs: Array | None = None) -> BodyMotion:
        """The body's motion in the world from the states (N, X); some effects need the inputs (N, U), too."""
        motion = motion_of(self.t_s, states, self.vehicle, *self.scenario.plane())
        return true_motion(motion, states, inputs, self.plant, self.vehicle) if self.plant.effects else motion


def simulate(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    cross_slope_deg: float | None = None,
    payload_kg: float | None = None,
    payload_at_m: tuple[float, float, float] | None = None,
    seed: int = 0,
    noiseless: bool = False,
    backend: str = "auto",
    effects: Mapping[str, float] | None = None,
) -> Recording:
    """One drive with all channels and its truth; see `simulate_run`."""
    return simulate_run(
        scenario, vehicle=vehicle, terrain=terrain, slope_deg=slope_deg, cross_slope_deg=cross_slope_deg,
        payload_kg=payload_kg, payload_at_m=payload_at_m, seed=seed, noiseless=noiseless, backend=backend,
        effects=effects,
    ).recording  # fmt: skip


def simulate_run(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    cross_slope_deg: float | None = None,
    payload_kg: float | None = None,
    payload_at_m: tuple[float, float, float] | None = None,
    seed: int = 0,
    noiseless: bool = False,
    backend: str = "auto",
    soils: Mapping[str, SoilParams] | None = None,
    effects: Mapping[str, float] | None = None,
) -> SimulatedRun:
    """Drive a scenario and keep the states, too.

    Args:
        scenario: name, path of a YAML file, or `Scenario`.
        vehicle: name, path of a YAML file, or `VehicleParams`.
        terrain: ground of the whole route, in place of the scenario's.
        slope_deg: slope of the plane, 0 to 25 deg, in place of the scenario's.
        cross_slope_deg: its slope across the start heading, -25 to 25 deg, rising to the left, likewise.
        payload_kg: mass carried, likewise.
        payload_at_m: where its centre of gravity is (body frame), likewise; by default at the vehicle's.
        seed: of all noise, and of ground that varies; on even ground the motion does not depend on it.
        noiseless: exact sensors (no noise, bias, quantisation, vibration, latency).
        backend: "c", "vm" or "auto", see `integrate.integrate`.
        soils: grounds by name, in place of the library's.
        effects: optional effects by name, see docs/effects.md, beside those of the vehicle's file or in their
            place; others are absent.

    Raises:
        ConfigError: unknown name, bad file, or a number out of range.
        TerrafusionError: the integration diverged.
    """
    setup = set_up(
        scenario, vehicle=vehicle, terrain=terrain, slope_deg=slope_deg, cross_slope_deg=cross_slope_deg,
        payload_kg=payload_kg, payload_at_m=payload_at_m, seed=seed, soils=soils, effects=effects,
    )  # fmt: skip
    driven = drive_through(setup, backend)
    motion = setup.motion(driven.states, driven.inputs)
    recording = _record(setup, driven, motion, sensors.NoiseStreams(seed, noiseless))
    if setup.effects:
        late_s = 0.0 if noiseless else setup.vehicle.realism.gnss_latency_s
        recording = sensed(
            recording, motion, driven.states, driven.inputs, setup.plant, setup.vehicle, setup.effects, late_s
        )
    recording = dataclasses.replace(recording, description=_description(setup, seed, noiseless))
    if backend != "c" and (backend == "vm" or not compiled()):
        recording = recording.with_notes("integrated in CasADi's virtual machine (slower, same numbers)")
    recording = recording.with_notes(*_notes(setup, motion, vehicle))
    slip = slip_ratios(driven.states, motion, setup.vehicle)
    check_slip(setup.route, setup.plant.route.field, setup.t_s, driven.states, slip)
    summary = summarise(driven, motion, setup.vehicle, slip)
    return SimulatedRun(recording, setup.t_s, driven.states, slip, summary, driven.wanted)


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
    """What `simulate_run` drives with the same arguments."""
    vehicle = vehicle if isinstance(vehicle, VehicleParams) else load_vehicle(vehicle)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    scenario = scenario.with_ground(terrain, slope_deg, cross_slope_deg).with_payload(
        payload_kg, payload_at_m
    )
    _check(scenario, vehicle, seed)
    vehicle = with_payload(vehicle, scenario.payload_kg, scenario.payload_at_m)
    route = Route.of(scenario, soils)
    check_ground(route, scenario, vehicle)
    slope, aspect = scenario.plane()
    _check_stands(scenario, vehicle)
    parameters = vehicle_vector(vehicle, slope_rad=slope, aspect_rad=aspect)
    rate = vehicle.sensors.imu.rate_hz
    count = max(2, round(scenario.duration_s * rate) + 1)
    known = checked({**vehicle.effects, **(effects or {})})
    plant = with_effects(Plant(parameters, route.table(seed)), known)
    return RunSetup(scenario, vehicle, route, plant, np.arange(count) / rate, known)


def drive_through(setup: RunSetup, backend: str = "auto") -> DrivenStates:
    """The run's motion, without any sensor."""
    dt_s = 1.0 / setup.vehicle.sensors.imu.rate_hz

    def run(x0: Array, inputs: Array, t0_s: float) -> Array:
        return integrate(x0, inputs, dt_s, setup.plant, t0_s=t0_s, backend=backend)

    return drive(setup.scenario, setup.t_s, as_driven(setup.vehicle, setup.effects), run)


def _check(scenario: Scenario, vehicle: VehicleParams, seed: int) -> None:
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
    best = sensors.best_fix(vehicle.sensors.gnss)
    fix = scenario.gnss_fix
    if fix is not None and not Fix.SINGLE <= fix <= best:
        raise ConfigError(
            f"'gnss_fix' is {fix.name.lower()}, not a class the receiver of '{vehicle.name}' reaches",
            file=scenario.name,
            remedy=f"give single to {best.name.lower()}",
        )
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


def _record(
    setup: RunSetup, driven: DrivenStates, motion: BodyMotion, noise: sensors.NoiseStreams
) -> Recording:
    """The channels at their own rates, all on the clock of the IMU."""
    scenario, vehicle, route = setup.scenario, setup.vehicle, setup.route
    states, rate = driven.states, vehicle.sensors.imu.rate_hz
    t_ns = START_NS + np.round(motion.t_s * 1e9).astype(np.int64)
    along = route.along(motion.t_s, states[:, INDEX["travel"]])
    patch = patch_share(setup.plant.route.field, states[:, INDEX["x"]], states[:, INDEX["y"]])
    rim = np.abs(states[:, state_slice("wheel_speed")]).mean(axis=1) * vehicle.wheel.radius_m
    named = dict(zip(VEHICLE_PARAMETERS, setup.plant.vehicle.tolist(), strict=True))
    told = sensors.rows_at_rate(len(t_ns), rate, _COMMAND_HZ)
    seen = sensors.rows_at_rate(len(t_ns), rate, _TERRAIN_HZ)
    return Recording(
        name=scenario.name,
        start_ns=START_NS,
        vehicle=vehicle.name,
        command=Command(t_ns[told], driven.wanted[told, 0], driven.wanted[told, 1]),
        wheels=sensors.wheels_channel(t_ns, motion, states, vehicle, noise),
        imu=sensors.imu_channel(t_ns, motion, vehicle, route.shares(along, patch), rim, noise),
        gnss=sensors.gnss_channel(t_ns, motion, states[:, INDEX["travel"]], vehicle, scenario, noise),
        motor=sensors.motor_channel(t_ns, motion, states, named, vehicle, noise),
        terrain=Terrain(t_ns[seen], route.labels(along[seen], patch[seen]), source="simulation"),
        barometer=sensors.barometer_channel(t_ns, motion, DATUM[2], vehicle, noise),
        magnetometer=sensors.magnetometer_channel(t_ns, motion, vehicle, noise),
        truth=_truth(t_ns, motion),
        datum=DATUM,
        truth_channels=("position", "yaw", "orientation", "velocity"),
        terrain_name=route.soils[0].name if len(route.soils) == 1 and not patch.any() else "mixed",
        source="terrafusion twin",
    )


def _truth(t_ns: NDArray[np.int64], motion: BodyMotion) -> Trajectory:
    zero = np.zeros((len(t_ns), 2))
    twist = np.hstack([motion.velocity_body_mps, zero, motion.yaw_rate_radps[:, None]])
    return Trajectory(t_ns, motion.position_m, matrix_to_quaternion(motion.rotation), twist)


def _description(setup: RunSetup, seed: int, noiseless: bool) -> str:
    scenario = setup.scenario
    patches = [scenario.patches.terrain] if scenario.patches else []
    grounds = ", ".join(dict.fromkeys([*(leg.terrain for leg in scenario.route), *patches]))
    extras = "exact sensors" if noiseless else f"seed {seed}"
    extras += "".join(f"; {key} = {value:g}" for key, value in setup.effects.items())
    if (varied := scenario.variation) is not None:
        grounds += f", strength varies by {varied.strength_sigma:g} over {varied.length_m:g} m"
    across = f", across {scenario.cross_slope_deg:g} deg" if scenario.cross_slope_deg else ""
    place = f" at {', '.join(f'{x:g}' for x in scenario.payload_at_m)} m" if scenario.payload_at_m else ""
    return (
        f"simulated: {scenario.description or scenario.name}; {grounds}; "
        f"slope {scenario.slope_deg:g} deg{across}; payload {scenario.payload_kg:g} kg{place}; {extras}"
    )


def _notes(setup: RunSetup, motion: BodyMotion, vehicle: str | Path | VehicleParams) -> list[str]:
    """What the reader of a recording should know of how it was made."""
    notes = []
    scenario = setup.scenario
    rows = np.arange(0, len(motion.t_s), _TIPPING_ROWS)
    tipped = rows[wheel_shares(motion.yaw_rad[rows], setup.vehicle, *scenario.plane()).min(axis=1) <= 0.0]
    if tipped.size:
        notes.append(
            f"from {motion.t_s[tipped[0]]:.1f} s on the robot would tip over: a wheel carries no load, "
            "and the model keeps it down"
        )
    patches = [scenario.patches.terrain] if scenario.patches else []
    parts = [("terrain", "soils", name) for name in [*(leg.terrain for leg in scenario.route), *patches]]
    if not isinstance(vehicle, VehicleParams):
        parts.insert(0, ("vehicle", "vehicles", str(vehicle)))
    counts = {(kind, name): assumed(folder, name) for kind, folder, name in parts}
    said = [
        f"{few} of {all_} numbers of {kind} '{name}'" for (kind, name), (few, all_) in counts.items() if few
    ]
    if said:
        notes.append(f"assumed, as their sources say: {', '.join(said)}")
    return notes
