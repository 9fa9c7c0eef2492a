"""`simulate`: one drive of the twin, as a `Recording` with truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.errors import ConfigError
from terrafusion.datasets.frames import matrix_to_quaternion
from terrafusion.datasets.recording import Command, Recording, Terrain
from terrafusion.datasets.trajectory import Trajectory
from terrafusion.twin import sensors
from terrafusion.twin.drive import Driven, drive
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.plant import Plant
from terrafusion.twin.ground import patch_share
from terrafusion.twin.layout import INDEX, VEHICLE_PARAMETERS, state_slice, vehicle_vector
from terrafusion.twin.motion import Motion, motion_of
from terrafusion.twin.route import Route
from terrafusion.twin.scenario import Scenario, load_scenario
from terrafusion.twin.soil import SoilParams
from terrafusion.twin.vehicle import VehicleParams, load_vehicle

Array = NDArray[np.float64]

START_NS = 1_704_067_200 * 10**9
"""Simulated drives start on 2024-01-01 00:00 UTC."""
DATUM = (52.0, 8.0, 100.0)
"""ENU origin of simulated drives: latitude deg, longitude deg, height m."""
MOVING_MPS = 0.1
"""Slip is averaged over samples that move faster than this."""
STOPPED_MPS = 0.05
LOST_TRAVEL_M = 5.0
"""A robot that stands while this much more travel is commanded is immobilised."""
_TERRAIN_HZ = 10.0
_COMMAND_HZ = 50.0


@dataclass(frozen=True)
class RunSummary:
    """What a run amounts to.

    `mean_abs_slip` is the mean of |1 - v_odom / v_truth| over samples with
    |v_truth| > 0.1 m/s (the source study's proxy, eq. 2), `mean_slip_ratio`
    that of the usual |w R - u| / max(|w R|, |u|); both NaN for a run that never
    moves. `energy_j` is drawn from the battery, `motor_work_j` done at the
    wheels. `immobilised_at_s` is when the robot came to rest for good although
    more driving was commanded, None when it did not.
    """

    duration_s: float
    distance_m: float
    mean_abs_slip: float
    mean_slip_ratio: float
    energy_j: float
    energy_per_m_j: float
    motor_work_j: float
    immobilised_at_s: float | None


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A recording with what no sensor sees.

    Attributes:
        recording: the drive as sensors report it, with truth.
        t_s: (N,) seconds, at the IMU's rate.
        states: (N, 38) in the order of `layout.STATES`.
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
    """A run before it is driven; `t_s` (N,) are the samples, at the IMU's rate from 0."""

    scenario: Scenario
    vehicle: VehicleParams
    route: Route
    plant: Plant
    t_s: Array

    def motion(self, states: Array) -> Motion:
        """The body's motion in the world from the states (N, 38)."""
        slope, aspect = math.radians(self.scenario.slope_deg), math.radians(self.scenario.aspect_deg)
        return motion_of(self.t_s, states, self.vehicle, slope, aspect)


def simulate(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    payload_kg: float = 0.0,
    seed: int = 0,
    noiseless: bool = False,
    backend: str = "auto",
) -> Recording:
    """One drive with all channels and its truth; see `simulate_run`."""
    return simulate_run(
        scenario, vehicle=vehicle, terrain=terrain, slope_deg=slope_deg, payload_kg=payload_kg, seed=seed,
        noiseless=noiseless, backend=backend,
    ).recording  # fmt: skip


def simulate_run(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    payload_kg: float = 0.0,
    seed: int = 0,
    noiseless: bool = False,
    backend: str = "auto",
    soils: Mapping[str, SoilParams] | None = None,
) -> SimulatedRun:
    """Drive a scenario and keep the states, too.

    Args:
        scenario: name, path of a YAML file, or `Scenario`.
        vehicle: name, path of a YAML file, or `VehicleParams`.
        terrain: ground of the whole route, in place of the scenario's.
        slope_deg: slope of the plane, 0 to 25 deg, in place of the scenario's.
        payload_kg: mass carried at the centre of gravity.
        seed: of all noise, and of ground that varies; on even ground the motion does not depend on it.
        noiseless: exact sensors (no noise, bias, quantisation, vibration, latency).
        backend: "c", "vm" or "auto", see `integrate.integrate`.
        soils: grounds by name, in place of the library's.

    Raises:
        ConfigError: unknown name, bad file, or a number out of range.
        TerrafusionError: the integration diverged.
    """
    setup = set_up(
        scenario, vehicle=vehicle, terrain=terrain, slope_deg=slope_deg, payload_kg=payload_kg, seed=seed,
        soils=soils,
    )  # fmt: skip
    driven = drive_through(setup, backend)
    motion = setup.motion(driven.states)
    recording = _record(setup, driven, motion, sensors.Noise(seed, noiseless))
    recording = dataclasses.replace(
        recording, description=_description(setup.scenario, payload_kg, seed, noiseless)
    )
    if backend != "c" and (backend == "vm" or not compiled()):
        recording = recording.with_notes("integrated in CasADi's virtual machine (slower, same numbers)")
    slip = slip_ratios(driven.states, motion, setup.vehicle)
    summary = summarise(driven, motion, setup.vehicle, slip)
    return SimulatedRun(recording, setup.t_s, driven.states, slip, summary, driven.wanted)


def set_up(
    scenario: str | Path | Scenario,
    *,
    vehicle: str | Path | VehicleParams = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    payload_kg: float = 0.0,
    seed: int = 0,
    soils: Mapping[str, SoilParams] | None = None,
) -> RunSetup:
    """What `simulate_run` drives with the same arguments."""
    vehicle = vehicle if isinstance(vehicle, VehicleParams) else load_vehicle(vehicle)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    scenario = scenario.with_ground(terrain, slope_deg)
    _check(vehicle, payload_kg, seed)
    route = Route.of(scenario, soils)
    slope, aspect = math.radians(scenario.slope_deg), math.radians(scenario.aspect_deg)
    parameters = vehicle_vector(vehicle, slope_rad=slope, aspect_rad=aspect, payload_kg=payload_kg)
    rate = vehicle.sensors.imu.rate_hz
    count = max(2, round(scenario.duration_s * rate) + 1)
    return RunSetup(scenario, vehicle, route, Plant(parameters, route.table(seed)), np.arange(count) / rate)


def drive_through(setup: RunSetup, backend: str = "auto") -> Driven:
    """The run's motion, without any sensor."""
    dt_s = 1.0 / setup.vehicle.sensors.imu.rate_hz

    def run(x0: Array, inputs: Array, t0_s: float) -> Array:
        return integrate(x0, inputs, dt_s, setup.plant, t0_s=t0_s, backend=backend)

    return drive(setup.scenario, setup.t_s, setup.vehicle, run)


def _check(vehicle: VehicleParams, payload_kg: float, seed: int) -> None:
    limit = vehicle.body.payload_max_kg
    if not 0.0 <= payload_kg <= limit:
        raise ConfigError(
            f"payload {payload_kg:g} kg is out of range", file=vehicle.name, remedy=f"give 0 to {limit:g} kg"
        )
    if seed < 0:
        raise ConfigError(f"seed {seed} is negative", remedy="give a whole number from 0")


def _record(setup: RunSetup, driven: Driven, motion: Motion, noise: sensors.Noise) -> Recording:
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
        gnss=sensors.gnss_channel(t_ns, motion, vehicle, scenario.gnss_fix, scenario.gnss_outages, noise),
        motor=sensors.motor_channel(t_ns, motion, states, named, vehicle, noise),
        terrain=Terrain(t_ns[seen], route.labels(along[seen], patch[seen]), source="simulation"),
        truth=_truth(t_ns, motion),
        datum=DATUM,
        truth_channels=("position", "yaw", "orientation", "velocity"),
        terrain_name=route.soils[0].name if len(route.soils) == 1 and not patch.any() else "mixed",
        source="terrafusion twin",
    )


def _truth(t_ns: NDArray[np.int64], motion: Motion) -> Trajectory:
    zero = np.zeros((len(t_ns), 2))
    twist = np.hstack([motion.velocity_body_mps, zero, motion.yaw_rate_radps[:, None]])
    return Trajectory(t_ns, motion.position_m, matrix_to_quaternion(motion.rotation), twist)


def _description(scenario: Scenario, payload_kg: float, seed: int, noiseless: bool) -> str:
    patches = [scenario.patches.terrain] if scenario.patches else []
    grounds = ", ".join(dict.fromkeys([*(leg.terrain for leg in scenario.route), *patches]))
    extras = "exact sensors" if noiseless else f"seed {seed}"
    return (
        f"simulated: {scenario.description or scenario.name}; {grounds}; slope {scenario.slope_deg:g} deg; "
        f"payload {payload_kg:g} kg; {extras}"
    )


def slip_ratios(states: Array, motion: Motion, vehicle: VehicleParams) -> Array:
    """Slip ratio (N, 4) of each wheel, (w R - u) / max(|w R|, |u|), 0 at rest."""
    rim = states[:, state_slice("wheel_speed")] * vehicle.wheel.radius_m
    half = 0.5 * vehicle.body.track_m * np.array([1.0, -1.0, 1.0, -1.0])
    hub = motion.velocity_body_mps[:, :1] - motion.yaw_rate_radps[:, None] * half
    larger = np.maximum(np.abs(rim), np.abs(hub))
    return np.where(larger > 1e-3, (rim - hub) / np.maximum(larger, 1e-3), 0.0)


def summarise(driven: Driven, motion: Motion, vehicle: VehicleParams, slip: Array) -> RunSummary:
    """The run in a few numbers, from its states and slip ratios (N, 4)."""
    states, t_s = driven.states, motion.t_s
    speed = motion.velocity_body_mps[:, 0]
    odometry = states[:, state_slice("wheel_speed")].mean(axis=1) * vehicle.odometry.wheel_radius_m
    moving = np.abs(speed) > MOVING_MPS
    distance = float(np.sum(np.linalg.norm(np.diff(motion.position_m, axis=0), axis=1)))
    energy = float(states[-1, INDEX["electric_energy"]])
    proxy = np.abs(1.0 - odometry[moving] / speed[moving])
    ratio = np.abs(slip.mean(axis=1))[moving]
    return RunSummary(
        duration_s=float(t_s[-1]),
        distance_m=distance,
        mean_abs_slip=float(proxy.mean()) if moving.any() else math.nan,
        mean_slip_ratio=float(ratio.mean()) if moving.any() else math.nan,
        energy_j=energy,
        energy_per_m_j=energy / distance if distance > 0.1 else math.nan,
        motor_work_j=float(states[-1, INDEX["motor_work"]]),
        immobilised_at_s=_immobilised_at(t_s, motion, driven.wanted[:, 0]),
    )


def _immobilised_at(t_s: Array, motion: Motion, wanted_mps: Array) -> float | None:
    moving = np.hypot(motion.velocity_body_mps[:, 0], motion.velocity_body_mps[:, 1]) > STOPPED_MPS
    last = int(np.flatnonzero(moving)[-1]) if moving.any() else 0
    missing = float(np.sum(np.abs(wanted_mps[last:]))) * float(t_s[1] - t_s[0])
    return float(t_s[last]) if missing > LOST_TRAVEL_M else None
