"""The runs of a sweep as rows of its table; runs without sensors are driven several at once, in the engine's
lanes.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.json_text import finite
from terrafusion.twin.analysis.speeds import speed_errors
from terrafusion.twin.analysis.summary import RunSummary
from terrafusion.twin.engine.integrate import raise_if_diverged
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.model.vehicle import VehicleParams
from terrafusion.twin.physics.layout import INDEX, state_slice
from terrafusion.twin.run_setup import RunSetup, set_up
from terrafusion.twin.scenario.commands import SETTLE_S, DrivenStates, open_loop, settled, settling
from terrafusion.twin.sensors.effects import as_driven
from terrafusion.twin.simulate import simulate_run
from terrafusion.twin.sweep.plan import Sweep, SweepPoint, at_speed, top_speed_mps

Row = dict[str, str | float | int | None]

DONE, SPINNING, IMMOBILISED, SLID, FAILED = ("done", "spinning", "immobilised", "slid", "failed")
STATUSES = (DONE, SPINNING, IMMOBILISED, SLID, FAILED)
"""How a run ended: it drove on; its wheels turned, but it covered less than a tenth of the commanded
distance; it came to rest for good; it ended behind its start, as on too steep a slope; it failed."""
MOBILE_RATIO = 0.1
"""A robot that covers less than this share of the commanded distance spins (assumed)."""
MIN_COMMANDED_M = 0.5
"""With a shorter commanded distance there is no travel ratio."""
T = TypeVar("T")

TOGETHER = 8
"""Runs whose states are held at a time, which bounds the memory: 16 MB for 60 s at 100 Hz."""


@dataclass(frozen=True)
class Column:
    """A column of the table: "int", "float" or "text", and what it holds."""

    name: str
    kind: str
    about: str


_AXES = (
    Column("run", "int", "number of the run, from 0"),
    Column("terrain", "text", "ground, or the grounds of the route"),
    Column("friction", "float", "effective friction cap; null where the route's grounds differ in it"),
    Column("slope_deg", "float", "slope of the plane, deg"),
    Column("payload_kg", "float", "payload at the centre of gravity, kg"),
    Column("speed_scale", "float", "commanded speeds over the scenario's"),
    Column("speed_mps", "float", "fastest forward speed commanded, m/s"),
    Column("seed", "int", "seed of the sensors' noise and of ground that varies"),
)
_RESULTS = (
    Column("status", "text", f"one of {', '.join(STATUSES)}"),
    Column("duration_s", "float", "length of the run, s"),
    Column("distance_m", "float", "length of the path of the body origin, m"),
    Column("travel_m", "float", "net way forward, m"),
    Column("travel_ratio", "float", "net way forward over the way commanded; null where none is"),
    Column("mean_abs_slip", "float", "mean |1 - v_odom / v_truth| while moving; null if it never moved"),
    Column("mean_slip_ratio", "float", "mean |w R - u| / max(|w R|, |u|) while moving; null likewise"),
    Column("energy_j", "float", "energy drawn from the battery, J"),
    Column("energy_per_m_j", "float", "energy over distance, J/m; null below 0.1 m"),
    Column("mean_power_w", "float", "energy over duration, W"),
    Column("peak_power_w", "float", "most power drawn from the battery between two samples, W"),
    Column("motor_work_j", "float", "work of the motors at the wheels, J"),
    Column("slip_work_j", "float", "of that, spent in the slip of the wheels, J"),
    Column("resistance_work_j", "float", "of that, spent in rolling, compaction and drag, J"),
    Column("heat_j", "float", "energy drawn less the motors' work, J"),
    Column("immobilised_at_s", "float", "when the robot came to rest for good, s; null if it did not"),
    Column("immobilised_cause", "text", "traction lost (wheels turn) or motors stalled; null likewise"),
    Column("yaw_error_rad", "float", "heading turned by the wheels' odometry less the true one, at the end"),
)
_SENSORS = (
    Column("odometry_error_pct", "float", "mean speed error of the odometry, % of the true speed"),
    Column("imu_error_pct", "float", "mean speed error of the integrated IMU, %"),
    Column("gnss_error_pct", "float", "mean speed error of the differenced GNSS positions, %"),
)
_ERROR = Column("error", "text", "why the run failed; null if it did not")


def columns(sensors: bool) -> tuple[Column, ...]:
    """The columns of a table with or without sensors."""
    return (*_AXES, *_RESULTS, *(_SENSORS if sensors else ()), _ERROR)


def run_chunk(sweep: Sweep, cases: Sequence[SweepPoint]) -> list[Row]:
    """The rows of some runs, in their order. A failed run has its reason in `error`."""
    rows: list[Row] = []
    for first in range(0, len(cases), TOGETHER):
        some = cases[first : first + TOGETHER]
        outcomes = _with_sensors(sweep, some) if sweep.sensors else _without(sweep, some)
        rows += [_row(sweep, case, outcome) for case, outcome in zip(some, outcomes, strict=True)]
    return rows


def arguments(sweep: Sweep, case: SweepPoint) -> dict[str, Any]:
    """The arguments of `simulate_run` for a run of the sweep."""
    soils = dict(sweep.soils)
    if case.friction is not None:
        for name in _grounds(sweep, case):
            shear = dataclasses.replace(soils[name].shear, friction_cap=case.friction)
            soils[name] = dataclasses.replace(soils[name], shear=shear)
    return {
        "scenario": at_speed(sweep.scenario, sweep.speed_scale(case)),
        "vehicle": sweep.vehicle,
        "terrain": case.terrain,
        "slope_deg": case.slope_deg,
        "payload_kg": case.payload_kg,
        "seed": case.seed,
        "soils": soils,
    }


def _grounds(sweep: Sweep, case: SweepPoint) -> list[str]:
    """Names of the grounds along the route."""
    return [case.terrain] if case.terrain is not None else [leg.terrain for leg in sweep.scenario.route]


def _with_sensors(sweep: Sweep, cases: Sequence[SweepPoint]) -> list[Row | Exception]:
    def sensed(case: SweepPoint) -> Row:
        run = simulate_run(**arguments(sweep, case))
        row = _results(run.t_s, run.commanded, run.states, run.summary, sweep.vehicle)
        errors = speed_errors(run.recording, sweep.vehicle.odometry.wheel_radius_m)
        return row | {f"{name}_error_pct": error for name, error in errors.items()}

    return [attempt(sensed, case) for case in cases]


def _without(sweep: Sweep, cases: Sequence[SweepPoint]) -> list[Row | Exception]:
    setups = [attempt(lambda c: set_up(**arguments(sweep, c)), case) for case in cases]
    return [attempt(results, *run) for run in zip(setups, drive_many(setups), strict=True)]


def _row(sweep: Sweep, case: SweepPoint, outcome: Row | Exception) -> Row:
    row = _axes(sweep, case)
    if isinstance(outcome, Exception):
        known = isinstance(outcome, TerrafusionError)
        row |= {"status": FAILED, "error": str(outcome) if known else f"{type(outcome).__name__}: {outcome}"}
    else:
        row |= outcome
    return {column.name: finite(row.get(column.name)) for column in columns(sweep.sensors)}


def _axes(sweep: Sweep, case: SweepPoint) -> Row:
    """The conditions of a run, those that no axis names among them."""
    legs = _grounds(sweep, case)
    soils = dict(sweep.soils)
    caps = {soils[name].shear.friction_cap for name in legs} if case.friction is None else {case.friction}
    scale = sweep.speed_scale(case)
    return {
        "run": case.run,
        "terrain": " + ".join(dict.fromkeys(legs)),
        "friction": caps.pop() if len(caps) == 1 else None,
        "slope_deg": sweep.scenario.slope_deg if case.slope_deg is None else case.slope_deg,
        "payload_kg": sweep.scenario.payload_kg if case.payload_kg is None else case.payload_kg,
        "speed_scale": scale,
        "speed_mps": scale * top_speed_mps(sweep.scenario),
        "seed": case.seed,
    }


def results(setup: RunSetup, driven: DrivenStates) -> Row:
    """Results of a run without sensors."""
    _, summary = setup.summarise(driven, setup.motion(driven))
    return _results(setup.t_s, driven.commanded, driven.states, summary, setup.vehicle)


def _results(t_s: Array, twist: Array, states: Array, summary: RunSummary, vehicle: VehicleParams) -> Row:
    travel = float(states[-1, INDEX["travel"]])
    commanded = float(np.sum(twist[:, 0])) * float(t_s[1] - t_s[0])
    ratio = travel / commanded if abs(commanded) >= MIN_COMMANDED_M else None
    status = DONE
    if summary.immobilised_at_s is not None:
        status = IMMOBILISED
    elif ratio is not None and ratio < MOBILE_RATIO:
        status = SLID if ratio < 0.0 else SPINNING
    true, turned = float(states[-1, INDEX["yaw"]] - states[0, INDEX["yaw"]]), _odometry_yaw(states, vehicle)
    return dataclasses.asdict(summary) | {
        "status": status,
        "travel_m": travel,
        "travel_ratio": ratio,
        "yaw_error_rad": None if turned is None else turned - true,
    }


def _odometry_yaw(states: Array, vehicle: VehicleParams) -> float | None:
    """Angle the robot turned by its wheels' angles, rad; None where all wheels are steered."""
    if vehicle.drive.type == "four_wheel_steer":
        return None
    pairs = (states[-1] - states[0])[state_slice("wheel_angle")].reshape(2, 2)
    left, right = pairs[1] if vehicle.drive.type == "ackermann" else pairs.mean(axis=0)
    return float(right - left) * vehicle.odometry.wheel_radius_m / vehicle.odometry.track_m


def attempt(work: Callable[..., T], *inputs: Any) -> T | Exception:
    """`work(*inputs)`, or the exception it raises or finds among its inputs: other runs go on."""
    failed = next((value for value in inputs if isinstance(value, Exception)), None)
    if failed is not None:
        return failed
    try:
        return work(*inputs)
    except Exception as error:
        return error


def drive_many(setups: Sequence[RunSetup | Exception]) -> list[DrivenStates | Exception]:
    """The motions of runs of one vehicle and one scenario but for speeds and ground, in their order.

    The same numbers as `RunSetup.drive` run by run, which is how scenarios with waypoints are driven.
    A run that could not be set up, or that diverges, has its exception in place of a motion.
    """
    ready = [setup for setup in setups if isinstance(setup, RunSetup)]
    if not ready or ready[0].scenario.waypoints:
        return [attempt(RunSetup.drive, setup) for setup in setups]
    together = attempt(_batched, ready)
    if isinstance(together, Exception):  # then each alone, so that only those fail that must
        return [attempt(RunSetup.drive, setup) for setup in setups]
    driven = iter(together)
    return [setup if isinstance(setup, Exception) else next(driven) for setup in setups]


def _batched(setups: Sequence[RunSetup]) -> list[DrivenStates | Exception]:
    dt_s = 1.0 / setups[0].vehicle.sensors.imu.rate_hz
    plants = [setup.plant for setup in setups]
    rests = [settling(setup.scenario, dt_s) for setup in setups]
    still = rests[0][1]
    rested = integrate_many(
        np.stack([x for x, _ in rests]), still, dt_s, plants, t0_s=-SETTLE_S, every=len(still) - 1
    )
    starts = [settled(setup.scenario, states[-1]) for setup, states in zip(setups, rested, strict=True)]
    commands = [open_loop(s.scenario, s.t_s, as_driven(s.vehicle, s.effects)) for s in setups]
    motions = integrate_many(np.stack(starts), np.stack([inputs for _, inputs in commands]), dt_s, plants)
    return [attempt(_driven, *each, dt_s) for each in zip(commands, motions, strict=True)]


def _driven(commands: tuple[Array, Array], states: Array, dt_s: float) -> DrivenStates:
    if not np.isfinite(states[-1]).all():  # a run that diverged is blank to its end
        raise_if_diverged(states, 0.0, dt_s)
    return DrivenStates(*commands, states)
