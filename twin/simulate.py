"""`simulate`: one drive of the twin, as a `Recording` with truth."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.analysis.summary import RunSummary
from terrafusion.twin.engine.integrate import compiled
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import VehicleParams, vehicle_names
from terrafusion.twin.run_recording import record, run_notes
from terrafusion.twin.run_setup import set_up
from terrafusion.twin.scenario.scenario import Scenario
from terrafusion.twin.sensors.noise import NoiseStreams


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A recording with what no sensor sees.

    Attributes:
        recording: the drive as sensors report it, with truth.
        t_s: (N,) seconds, at the IMU's rate.
        states: (N, X) in the order of `layout.STATES`.
        slip: (N, 4) slip ratio of each wheel, (w R - u) / max(|w R|, |u|), 0 at rest.
        summary: the run in a few numbers.
        commanded: (N, 2) commanded twist before limits, m/s and rad/s.
    """

    recording: Recording
    t_s: Array
    states: Array
    slip: Array
    summary: RunSummary
    commanded: Array


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
    """Drive a scenario; the recording, and the states behind it.

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
        effects: optional effects by name (docs/reference/effects.md), added to those of the vehicle's file
            or in their place; others are absent.

    Raises:
        ConfigError: unknown name, bad file, or a number out of range.
        TerrafusionError: the integration diverged.
    """
    # Vehicle with payload, ground and commands, checked.
    setup = set_up(
        scenario, vehicle=vehicle, terrain=terrain, slope_deg=slope_deg, cross_slope_deg=cross_slope_deg,
        payload_kg=payload_kg, payload_at_m=payload_at_m, seed=seed, soils=soils, effects=effects,
    )  # fmt: skip
    # Settle on the slope, then integrate the vehicle-terrain model under the commands.
    driven = setup.drive(backend)
    # Pose and twist of the body in the world.
    motion = setup.motion(driven)
    # Slip (refused where a soil was not measured for it), energy, immobilisation.
    slip, summary = setup.summarise(driven, motion)
    # Every sensor at its own rate, with its own stream of noise.
    recording = record(setup, driven, motion, NoiseStreams(seed, noiseless))
    # What a reader of the recording should know of how it was made.
    if backend != "c" and (backend == "vm" or not compiled()):
        recording = recording.with_notes("integrated in CasADi's virtual machine (slower, same numbers)")
    recording = recording.with_notes(*run_notes(setup, motion, vehicle))
    # A vehicle of the user's own is found again by its file, which the writers of logs copy.
    if not isinstance(vehicle, VehicleParams) and str(vehicle) not in vehicle_names():
        recording = dataclasses.replace(recording, vehicle=str(vehicle))
    return SimulatedRun(recording, setup.t_s, driven.states, slip, summary, driven.commanded)
