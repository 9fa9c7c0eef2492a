"""The integrator's accuracy and speed, measured.

`python -m tests.studies.engine_accuracy` prints what docs/explanation/twin.md quotes: the
position error of the default step, the creep of a parked robot, and how long
300 s of motion take.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import INDEX, STATES
from terrafusion.twin.scenario.commands import delayed_inputs, limit_slew, side_speeds, within_limit
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

Array = NDArray[np.float64]

DT_S = 0.01
"""Interval of the inputs, that of the nominal IMU."""
SUBSTEPS = 3
"""The default number of integration steps in it (`integrate`: at most 3.33 ms and 5/3 of the motor lag)."""
REFERENCE_SUBSTEPS = 24
CREEP_SLOPE_DEG = 5.0
TYPICAL = (("paper_profile", "loose_sand"), ("figure_eight", "mud"), ("figure_eight", "asphalt"))
"""Scenario and ground of the runs whose convergence is told."""


def path_of(scenario: str, terrain: str, substeps: int) -> Array:
    """Positions (N, 2), m, of a scenario's command on one ground, driven open loop."""
    plan, vehicle = load_scenario(scenario), load_vehicle("elevate")
    t_s: Array = np.arange(round(plan.duration_s / DT_S) + 1, dtype=float) * DT_S
    twist = limit_slew(within_limit(plan.commanded(t_s), DT_S, plan), DT_S, vehicle, np.zeros(2))
    inputs = delayed_inputs(side_speeds(twist, vehicle), DT_S)
    return integrate(np.zeros(len(STATES)), inputs, DT_S, _plant(terrain), substeps=substeps)[:, :2]


def position_error_m(scenario: str, terrain: str, substeps: int) -> float:
    """Largest deviation from the path integrated with `REFERENCE_SUBSTEPS`, m."""
    difference = path_of(scenario, terrain, substeps) - path_of(scenario, terrain, REFERENCE_SUBSTEPS)
    return float(np.abs(difference).max())


def creep_mps(terrain: str) -> float:
    """How fast a parked robot creeps down 5 deg, m/s, over 50 s after 10 s of rest."""
    parked = Scenario("parked", 60.0, drive=(DriveSegment(60.0),), route=(RouteLeg("asphalt"),))
    run = simulate_run(parked, terrain=terrain, slope_deg=CREEP_SLOPE_DEG, noiseless=True)
    x, late = run.states[:, INDEX["x"]], int(np.searchsorted(run.t_s, 10.0))
    return abs(float(x[-1] - x[late])) / float(run.t_s[-1] - run.t_s[late])


def motion_seconds(backend: str, repeats: int = 3) -> float:
    """Wall time of 300 s of motion without sensors on loose sand, the best of `repeats`, s."""
    speed = 1.0 + 0.5 * np.sin(0.001 * np.arange(30001)[:, None])
    radius = load_vehicle("elevate").odometry.wheel_radius_m
    inputs = delayed_inputs(np.tile(speed / radius, (1, 2)), DT_S)
    plant = _plant("loose_sand")
    start = np.zeros(len(STATES))
    return best_of(repeats, lambda: integrate(start, inputs, DT_S, plant, backend=backend))


def best_of(repeats: int, work: Callable[[], Any]) -> float:
    """Shortest wall time of `work`, s."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def numerics_lines() -> list[str]:
    """Everything this module measures, as text."""
    lines = []
    for scenario, terrain in TYPICAL:
        whole, half = (1e6 * position_error_m(scenario, terrain, n) for n in (SUBSTEPS, 2 * SUBSTEPS))
        lines.append(f"{scenario} on {terrain}: position error {whole:.3f} um, at half step {half:.3f} um")
    grounds = ("asphalt", "medium_sand", "loose_sand", "mud")
    creeps = [f"{terrain} {1e3 * creep_mps(terrain):.5f}" for terrain in grounds]
    lines.append(f"parked on {CREEP_SLOPE_DEG:g} deg, creep in mm/s: {', '.join(creeps)}")
    for backend in ("c", "vm") if compiled() else ("vm",):
        took = motion_seconds(backend, 3 if backend == "c" else 1)
        lines.append(f"300 s of motion, backend {backend}: {took:.2f} s ({300 / took:.0f} x real time)")
    took = best_of(3, lambda: simulate_run("paper_profile"))
    return [*lines, f"simulate_run('paper_profile') with all sensors: {took:.2f} s"]


def _plant(terrain: str) -> Plant:
    route = RouteTable("travel", np.zeros(1), soil_vector(load_soil(terrain))[None])
    return Plant(vehicle_vector(load_vehicle("elevate")), route)


if __name__ == "__main__":
    print("\n".join(numerics_lines()))
