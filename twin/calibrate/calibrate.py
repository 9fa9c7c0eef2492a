"""`calibrate`: fit parameters of a vehicle and its grounds to logs, by making the twin drive as they did."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from terrafusion.datasets.core.arguments import checked_names, checked_progress
from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError, TerrafusionError
from terrafusion.datasets.core.quantity import Quantity, checked_number
from terrafusion.datasets.readers.logs import Log, opened
from terrafusion.twin.calibrate.answer import answer_of
from terrafusion.twin.calibrate.coordinates import Prior
from terrafusion.twin.calibrate.covariance import covariance_of
from terrafusion.twin.calibrate.identifiability import NOT_IDENTIFIED, Identifiability, examine
from terrafusion.twin.calibrate.inputs import check_source
from terrafusion.twin.calibrate.log import prepare
from terrafusion.twin.calibrate.observations import checked_channels
from terrafusion.twin.calibrate.problem import Problem
from terrafusion.twin.calibrate.result import CONVERGED, Calibration
from terrafusion.twin.calibrate.solver import Solution, solve
from terrafusion.twin.calibrate.start import (
    Soils,
    coordinates_of,
    refuse_bypassed,
    start_model,
    uniquely_named,
)
from terrafusion.twin.effects.catalogue import checked
from terrafusion.twin.model.choose import vehicle_of_logs
from terrafusion.twin.model.vehicle import VehicleParams, as_vehicle
from terrafusion.twin.scenario.scenario import MAX_SLOPE_DEG

PARAMETERS = (
    "soil.shear.friction_cap", "soil.shear.shear_modulus_m", "soil.resistance.rolling",
    "vehicle.wheel.radius_m", "vehicle.body.track_m", "vehicle.body.mass_kg",
)  # fmt: skip
"""What is calibrated where nothing is named."""

_RANGES = {
    "window_s": Quantity("s", 1.0, 600.0),
    "slope_deg": Quantity("deg", 0.0, MAX_SLOPE_DEG),
    "aspect_deg": Quantity("deg", -360.0, 360.0),
    "payload_kg": Quantity("kg", 0.0, 5000.0),
}


def calibrate(
    logs: Log | Sequence[Log],
    vehicle: str | Path | VehicleParams | None = None,
    soils: Soils = None,
    parameters: str | Sequence[str] = PARAMETERS,
    *,
    priors: Mapping[str, Prior] | None = None,
    effects: Mapping[str, float] | None = None,
    source: str = "auto",
    truth: bool = False,
    robust: bool = False,
    channels: str | Sequence[str] | None = None,
    window_s: float = 10.0,
    slope_deg: float = 0.0,
    aspect_deg: float = 0.0,
    payload_kg: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Calibration:
    """Fit the named parameters to one or more logs of one vehicle.

    Args:
        logs: recordings, or paths or catalogue names.
        vehicle: name, YAML file or `VehicleParams` to start from, by default the one that the logs name, else
            a generic one; the geometry that a log reports (`Recording.overrides`) replaces its own.
        soils: the ground of all logs (name, file or `SoilParams`); or grounds by the logs' labels; None:
            each label's soil of the library.
        parameters: dotted names, see `model`.
        priors: prior of a parameter by name, in place of the default (see `coordinates`).
        effects: values of optional effects to start from, by key of `effects.catalogue`.
        source: one of `inputs.SOURCES`: what drives the twin.
        truth: use the reference poses of the logs, too.
        robust: down-weight outliers (Huber).
        channels: use only these, by name or beginning of a name (see `observations.CHANNELS`).
        window_s: the pose starts anew after so long, 1 to 600 s.
        slope_deg: slope of the plane that all logs were driven on, 0 to 25 deg.
        aspect_deg: direction in which it rises, deg from east to the left.
        payload_kg: mass carried at the centre of gravity.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: an unknown name, or a number out of its range.
        DataError: a log without what the fit needs.
        TerrafusionError: the twin diverges at the start values.
    """
    # Inputs, checked.
    recordings = uniquely_named(tuple(opened(logs, None if vehicle is None else as_vehicle(vehicle).rig())))
    if not recordings:
        raise DataError("no log was given", remedy="give at least one")
    check_source(source)
    checked_progress(progress)
    wanted = None if channels is None else checked_channels(checked_names(channels, "channels"))
    given = {
        "window_s": window_s, "slope_deg": slope_deg, "aspect_deg": aspect_deg, "payload_kg": payload_kg,
    }  # fmt: skip
    for key, value in given.items():
        checked_number(value, _RANGES[key], file="the calibration", key=key)
    checked(effects or {})
    named, said = vehicle_of_logs(recordings, vehicle)
    known = as_vehicle(named)
    recordings = tuple(opened(recordings, known.rig()))
    # The model to start from, and its unknown parameters.
    model, ground, notes = start_model(recordings, known, soils, effects)
    model = dataclasses.replace(
        model, slope_rad=math.radians(slope_deg), aspect_rad=math.radians(aspect_deg), payload_kg=payload_kg
    )
    coordinates = coordinates_of(parameters, model, priors or {})
    # The logs: input of the twin, windows, measurements averaged over intervals.
    prepared = [
        prepare(r, model, source=source, truth=truth, window_s=window_s, ground=ground, channels=wanted)
        for r in recordings
    ]
    refuse_bypassed(coordinates, prepared)
    # The search, with what the data identify.
    problem = Problem(prepared, model, coordinates, robust=robust)
    solution, covariance, identified = _search(problem, progress)
    # The answer.
    notes += [*said, *(f"{log.name}: {note}" for log in prepared for note in log.notes)]
    return answer_of(problem, solution, covariance, identified, notes)


def _search(
    problem: Problem, progress: Callable[[float], None] | None
) -> tuple[Solution, Array, Identifiability]:
    """Solution, covariance (G, G) and identifiability; a TerrafusionError where the twin diverges at once.

    Parameters that are not identified return to their priors, and the others are solved again.
    """
    solution = solve(problem, progress=progress)
    if solution.normal is None:
        raise TerrafusionError(
            "the twin diverges at the start values", file=problem.logs[0].name,
            remedy="check vehicle and soil, or give other start values",
        )  # fmt: skip
    P = len(problem.coordinates)
    covariance = covariance_of(problem, solution)
    identified = examine(problem.names, covariance[:P, :P])
    free = np.array([status != NOT_IDENTIFIED for status in identified.status])
    if free.all():
        return solution, covariance, identified
    point = dataclasses.replace(solution.point, w=np.where(free, solution.point.w, 0.0))
    again = dataclasses.replace(solution, point=point)
    second = solve(problem, free=free, start=again, progress=progress)
    if second.normal is None:
        return solution, covariance, identified
    # Noise and identifiability are those of the first search: if it did not converge, nor did the whole.
    outcome = second.outcome if solution.outcome in CONVERGED else solution.outcome
    solution = dataclasses.replace(
        second, first=solution.first, runs=solution.runs + second.runs, outcome=outcome
    )
    covariance = covariance_of(problem, solution)
    second_look = examine(problem.names, covariance[:P, :P])
    return solution, covariance, dataclasses.replace(second_look, status=identified.status)
