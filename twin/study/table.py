"""The source study's table, and the twin's own numerics, measured.

`python -m terrafusion.twin.study` prints what `docs/twin.md` quotes: speed
errors of odometry, IMU and GNSS on three grounds, processed as in the study,
then the integrator's convergence, speed and the creep of a parked robot.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.recording import Recording
from terrafusion.twin.drive import told
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.plant import Plant, RouteTable
from terrafusion.twin.layout import INDEX, STATES, soil_vector, vehicle_vector
from terrafusion.twin.scenario import DriveSegment, RouteLeg, Scenario, load_scenario
from terrafusion.twin.simulate import MOVING_MPS, simulate_run
from terrafusion.twin.soil import load_soil
from terrafusion.twin.vehicle import load_vehicle

Array = NDArray[np.float64]

CASES = (("mud", 0.0), ("loose_sand", 5.0), ("medium_sand", 5.0))
"""Ground and slope (deg) of the study's three runs."""
PUBLISHED = {
    "mud": (2.0, 2.6, 4.9, 45.7),
    "loose_sand": (27.0, 27.0, 9.3, 17.9),
    "medium_sand": (1.0, 1.4, 7.3, 57.1),
}
"""The study's Tab. 4, mean percent: |slip|, odometry, IMU and GNSS speed error."""
SEEDS = 10
"""Runs a sensor error is averaged over."""
_REST_S = 2.0
_AVERAGE_S = 0.5


@dataclass(frozen=True)
class SpeedErrors:
    """Mean |v - v_truth| / |v_truth| over samples above 0.1 m/s; NaN where nothing was measured."""

    odometry: float
    imu: float
    gnss_velocity: float
    gnss_positions: float


def imu_speed(recording: Recording) -> tuple[Array, Array]:
    """Time (N,) s and speed (N,) m/s from forward acceleration, as in the study (eq. 4).

    The mean of the first 2 s at rest is taken off, a 0.5 s moving average
    smooths, the trapezoid rule integrates.
    """
    imu = recording.imu
    if imu is None:
        raise ValueError("the recording has no IMU")
    t: Array = np.asarray((imu.t_ns - recording.start_ns) * 1e-9, dtype=float)
    forward = imu.accel_mps2[:, 0] - imu.accel_mps2[t <= _REST_S, 0].mean()
    width = max(1, round(_AVERAGE_S / float(np.median(np.diff(t)))))
    smooth = np.convolve(forward, np.ones(width) / width, mode="same")
    steps = 0.5 * (smooth[1:] + smooth[:-1]) * np.diff(t)
    return t, np.concatenate([[0.0], np.cumsum(steps)])


def speed_errors(recording: Recording, wheel_radius_m: float) -> SpeedErrors:
    """Relative speed errors of the recording's sensors against its truth."""
    truth, wheels, gnss = recording.truth, recording.wheels, recording.gnss
    if truth is None or truth.twist_body is None or wheels is None or gnss is None:
        raise ValueError("the recording lacks truth with twist, wheels or GNSS")
    clock = (truth.t_ns - recording.start_ns) * 1e-9
    actual = truth.twist_body[:, 0]

    def error(t: Array, speed: Array) -> float:
        reference = np.interp(t, clock, actual)
        moving = np.abs(reference) > MOVING_MPS
        relative = np.abs(speed - np.abs(reference))[moving] / np.abs(reference)[moving]
        return float(relative.mean()) if moving.any() else float("nan")

    t_wheels: Array = np.asarray((wheels.t_ns - recording.start_ns) * 1e-9, dtype=float)
    t_gnss: Array = np.asarray((gnss.t_ns - recording.start_ns) * 1e-9, dtype=float)
    t_imu, v_imu = imu_speed(recording)
    velocity = gnss.velocity_enu_mps if gnss.velocity_enu_mps is not None else np.full((len(gnss), 3), np.nan)
    between = np.hypot(*np.diff(gnss.enu_m[:, :2], axis=0).T) / np.diff(t_gnss)
    return SpeedErrors(
        odometry=error(t_wheels, wheels.side_speeds_mps(wheel_radius_m).mean(axis=1)),
        imu=error(t_imu, v_imu),
        gnss_velocity=error(t_gnss, np.hypot(velocity[:, 0], velocity[:, 1])),
        gnss_positions=error(0.5 * (t_gnss[1:] + t_gnss[:-1]), between),
    )


def study_table() -> list[str]:
    """Lines of the comparison with the study's Tab. 4; sensor errors are means over the seeds 0 to 9."""
    radius = load_vehicle("elevate").odometry.wheel_radius_m
    lines = ["mean %        |s|           odometry      IMU           GNSS positions, velocity   immobilised"]
    lines.append("              twin  study   twin  study   twin  study   twin (RTK)     study")
    for terrain, slope in CASES:
        runs = [simulate_run("paper_profile", terrain=terrain, slope_deg=slope, seed=n) for n in range(SEEDS)]
        errors = [dataclasses.astuple(speed_errors(run.recording, radius)) for run in runs]
        odometry, imu, velocity, positions = 100.0 * np.mean(errors, axis=0)
        known = PUBLISHED[terrain]
        summary = runs[0].summary
        at = "no" if summary.immobilised_at_s is None else f"{summary.immobilised_at_s:.1f} s"
        lines.append(
            f"{terrain:12s} {100 * summary.mean_abs_slip:6.1f} {known[0]:6.1f} "
            f"{odometry:6.1f} {known[1]:6.1f} {imu:6.1f} {known[2]:6.1f} {positions:6.1f} {velocity:6.1f} "
            f"{known[3]:8.1f}            {at}"
        )
    return lines


def convergence_lines() -> list[str]:
    """Position error of the default step and its half against an eighth, for typical runs."""
    lines = []
    for terrain, scenario in (
        ("loose_sand", "paper_profile"),
        ("mud", "figure_eight"),
        ("asphalt", "figure_eight"),
    ):
        paths = {n: _path(scenario, terrain, n) for n in (3, 6, 24)}
        whole, half = (float(np.abs(paths[n] - paths[24]).max()) for n in (3, 6))
        lines.append(
            f"{scenario} on {terrain}: position error {1e6 * whole:.3f} um, at half step {1e6 * half:.3f} um"
        )
    return lines


def _path(scenario: str, terrain: str, substeps: int) -> Array:
    """Positions (N, 2) of a scenario's command on one ground, by open-loop side speeds."""
    from terrafusion.twin.drive import limit_slew, side_speeds

    plan, vehicle = load_scenario(scenario), load_vehicle("elevate")
    t = np.arange(round(plan.duration_s * 100) + 1) / 100.0
    sides = side_speeds(limit_slew(plan.commanded(t), 0.01, vehicle, plan, np.zeros(2)), vehicle)
    route = RouteTable("travel", np.zeros(1), soil_vector(load_soil(terrain))[None])
    plant = Plant(vehicle_vector(vehicle), route)
    states = integrate(np.zeros(len(STATES)), told(sides, 0.01), 0.01, plant, substeps=substeps)
    return states[:, :2]


def creep_line() -> str:
    """How fast a parked robot creeps down 5 deg."""
    parked = Scenario("parked", 60.0, drive=(DriveSegment(60.0),), route=(RouteLeg("asphalt"),))
    creeps = []
    for terrain in ("asphalt", "medium_sand", "loose_sand", "mud"):
        x = simulate_run(parked, terrain=terrain, slope_deg=5.0, noiseless=True).states[:, INDEX["x"]]
        creeps.append(f"{terrain} {1e3 * abs(x[-1] - x[1000]) / 50.0:.5f}")
    return "parked on 5 deg, creep in mm/s: " + ", ".join(creeps)


def speed_lines() -> list[str]:
    """Wall time of a 300 s run, motion alone and with sensors, by backend."""
    vehicle = load_vehicle("elevate")
    route = RouteTable("travel", np.zeros(1), soil_vector(load_soil("loose_sand"))[None])
    plant = Plant(vehicle_vector(vehicle), route)
    sides = np.tile(1.0 + 0.5 * np.sin(np.arange(30001)[:, None] * 0.001), (1, 2)) / 0.175
    lines = []
    for backend in ("c", "vm") if compiled() else ("vm",):
        best = min(
            _seconds(integrate, np.zeros(len(STATES)), told(sides, 0.01), 0.01, plant, backend=backend)
            for _ in range(3)
        )
        lines.append(f"300 s of motion, backend {backend}: {best:.2f} s ({300 / best:.0f} x real time)")
    whole = min(_seconds(simulate_run, "paper_profile") for _ in range(3))
    return [*lines, f"simulate_run('paper_profile') with all sensors: {whole:.2f} s"]


def _seconds(function, *args, **kwargs) -> float:  # type: ignore[no-untyped-def]
    start = time.perf_counter()
    function(*args, **kwargs)
    return time.perf_counter() - start


def main() -> None:
    """Print the table and the numerics."""
    for line in (*study_table(), "", *convergence_lines(), creep_line(), *speed_lines()):
        print(line)
