"""`calibrate`: the numbers of a vehicle and its grounds that make the twin drive as the logs did."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.config import Quantity, checked_number
from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.coordinates import Coordinate, Prior
from terrafusion.twin.calibrate.identifiability import UNTOLD, Identifiability, examine
from terrafusion.twin.calibrate.inputs import check_source
from terrafusion.twin.calibrate.log import PreparedLog, grounds, prepare
from terrafusion.twin.calibrate.model import Model, resolve
from terrafusion.twin.calibrate.predict import FOLLOWING
from terrafusion.twin.calibrate.problem import Problem
from terrafusion.twin.calibrate.residuals import channel_fits
from terrafusion.twin.calibrate.result import CONVERGED, Calibration, FittedParameter
from terrafusion.twin.calibrate.sandwich import scattered
from terrafusion.twin.calibrate.solver import OUTCOMES, Solution, solve
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import (
    VehicleParams,
    geometry_notes,
    load_vehicle,
    reported_geometry,
    with_overrides,
)
from terrafusion.twin.scenario.scenario import MAX_SLOPE_DEG

Array = NDArray[np.float64]

PARAMETERS = (
    "soil.shear.friction_cap", "soil.shear.shear_modulus_m", "soil.resistance.rolling",
    "vehicle.wheel.radius_m", "vehicle.body.track_m", "vehicle.body.mass_kg",
)  # fmt: skip
"""What is calibrated where nothing is named."""

GROUND = (
    Quantity("deg", 0.0, MAX_SLOPE_DEG), Quantity("deg", -360.0, 360.0), Quantity("kg", 0.0, 5000.0)
)  # fmt: skip
"""Slope, aspect and payload that may be told, as in a scenario."""

MISFIT = 5.0
"""A channel that is off by more than this many times its noise is told of (assumed)."""

Soils = str | Path | SoilParams | Mapping[str, str | Path | SoilParams] | None


def calibrate(
    recordings: Recording | Sequence[Recording],
    vehicle: str | Path | VehicleParams = "elevate",
    soils: Soils = None,
    parameters: Sequence[str] = PARAMETERS,
    *,
    priors: Mapping[str, Prior] | None = None,
    effects: Mapping[str, float] | None = None,
    source: str = "auto",
    truth: bool = False,
    robust: bool = False,
    channels: Sequence[str] | None = None,
    window_s: float = 10.0,
    slope_deg: float = 0.0,
    aspect_deg: float = 0.0,
    payload_kg: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Calibration:
    """Fit the named numbers to one or more logs of one vehicle.

    Args:
        recordings: the logs.
        vehicle: name, YAML file or `VehicleParams` to start from; what a log says of its geometry
            (`Recording.overrides`) goes before it.
        soils: the ground of all logs (name, file or `SoilParams`); or grounds by the logs' labels; None:
            each label's soil of the library.
        parameters: dotted names, see `model`.
        priors: what is known of a number by name, in place of the default (see `coordinates`).
        effects: values of optional effects to start from, by key of `effects.catalogue`.
        source: one of `inputs.SOURCES`: what drives the twin.
        truth: use the logs' reference poses, too.
        robust: weigh outliers down (Huber).
        channels: use only these, by name or beginning of a name (see `layout.OUTPUTS`).
        window_s: the pose starts anew after so long.
        slope_deg, aspect_deg, payload_kg: the plane that all logs were driven on, and the load.
        progress: told the share done, 0 to 1.

    Raises:
        ConfigError: an unknown name, or a number out of its range.
        DataError: a log without what the fit needs.
        TerrafusionError: the twin diverges at the start values.
    """
    logs_in = _named_apart((recordings,) if isinstance(recordings, Recording) else tuple(recordings))
    _check(logs_in, source, window_s)
    for name, value, quantity in zip(
        ("slope_deg", "aspect_deg", "payload_kg"), (slope_deg, aspect_deg, payload_kg), GROUND, strict=True
    ):
        checked_number(value, quantity, file="the calibration", key=name)
    robot = vehicle if isinstance(vehicle, VehicleParams) else load_vehicle(vehicle)
    start, ground = _start(logs_in, robot, soils, effects or {})
    start = dataclasses.replace(
        start, slope_rad=math.radians(slope_deg), aspect_rad=math.radians(aspect_deg), payload_kg=payload_kg
    )
    numbers = resolve(tuple(parameters), start)
    spelt = {k: v for name, v in (priors or {}).items() for k in _spelt(name, start)}
    unknown = set(spelt) - set(numbers)
    if unknown:
        raise ConfigError(
            f"a prior is given for '{min(unknown)}', which is not calibrated", remedy="name it, too"
        )
    coordinates = [Coordinate.of(n, q, start.value(n), spelt.get(n)) for n, q in numbers.items()]
    wanted = None if channels is None else tuple(channels)
    logs = [
        prepare(r, start, source=source, truth=truth, window_s=window_s, ground=ground, channels=wanted)
        for r in logs_in
    ]
    _refuse_followed(numbers, logs)
    problem = Problem(logs, start, coordinates, robust=robust)
    solution, told = search(problem, progress)
    notes = [*geometry_notes(robot, reported_geometry(logs_in))]
    notes += [f"{log.name}: {note}" for log in logs for note in log.notes]
    return _answer(problem, solution, told, [*notes, *misfits(problem, solution), *assumptions(problem)])


def search(
    problem: Problem, progress: Callable[[float], None] | None = None
) -> tuple[Solution, Identifiability]:
    """Solve; numbers that the data say nothing about go back to their priors, the others are solved again.

    Raises:
        TerrafusionError: the twin diverges at the start values.
    """
    solution = solve(problem, progress=progress)
    if solution.normal is None:
        raise TerrafusionError(
            "the twin diverges at the start values", file=problem.logs[0].name,
            remedy="check vehicle and soil, or give other start values",
        )  # fmt: skip
    P = len(problem.coordinates)
    told = examine(problem.names, covariance_of(problem, solution)[:P, :P])
    lost = np.array([status == UNTOLD for status in told.status])
    if lost.any():
        w = np.where(lost, 0.0, solution.point.w)
        again = dataclasses.replace(solution, point=dataclasses.replace(solution.point, w=w))
        second = solve(problem, free=~lost, start=again, progress=progress)
        if second.normal is not None:
            # Noise and what is told come from the first search: where it did not converge, nor did the whole.
            outcome = second.outcome if solution.outcome in CONVERGED else solution.outcome
            solution = dataclasses.replace(
                second, first=solution.first, runs=solution.runs + second.runs, outcome=outcome
            )
            covariance = covariance_of(problem, solution)[:P, :P]
            told = dataclasses.replace(examine(problem.names, covariance), status=told.status)
    return solution, told


def covariance_of(problem: Problem, solution: Solution) -> Array:
    """Covariance (G, G) of the numbers in prior sigmas, then of the sensors' errors; poses marginalised.

    That of the noise model; where the scores scatter more than it says, sigma is raised to what they show.
    """
    if solution.normal is None:
        return np.eye(len(problem.coordinates) + len(problem.logs) * len(problem.errors))
    modelled = np.linalg.inv(solution.normal.H)
    shown = scattered(problem, solution.blocks, solution.normal, solution.noise)
    # No number is less known after the log than before it.
    most = np.maximum(1.0 / np.diag(modelled), 1.0)
    raised = np.sqrt(np.clip(np.diag(shown) / np.diag(modelled), 1.0, most))
    return np.asarray(modelled * np.outer(raised, raised))


def _answer(problem: Problem, solution: Solution, told: Identifiability, notes: list[str]) -> Calibration:
    whole, point, P = covariance_of(problem, solution), solution.point, len(problem.coordinates)
    cov = whole[:P, :P]
    sigma = np.sqrt(np.diag(cov))
    fitted = [
        _fitted(c, float(w), float(s), told.status[i], float(told.ratio[i]))
        for i, (c, w, s) in enumerate(zip(problem.coordinates, point.w, sigma, strict=True))
    ]
    rate = np.array([c.rate(float(w)) for c, w in zip(problem.coordinates, point.w, strict=True)])
    B = len(problem.errors)
    errors = {
        log.name: {
            e.name: (
                float(point.errors[i, k] * e.sigma),
                float(math.sqrt(whole[P + B * i + k, P + B * i + k]) * e.sigma),
            )
            for k, e in enumerate(problem.errors)
            if any(o.channel == e.channel for o in log.observed)
        }
        for i, log in enumerate(problem.logs)
    }
    return Calibration(
        tuple(fitted), cov / np.outer(sigma, sigma), cov * np.outer(rate, rate), told,
        _marked(problem.model_at(point.w), fitted), problem.model, channel_fits(problem, solution), errors,
        solution.outcome, OUTCOMES[solution.outcome], solution.runs, problem.seconds(), tuple(notes),
    )  # fmt: skip


def _marked(model: Model, fitted: Sequence[FittedParameter]) -> Model:
    """The model whose vehicle knows which of its numbers the logs told (`VehicleParams.measured`)."""
    told = {
        f.name.removeprefix("vehicle.")
        for f in fitted
        if f.name.startswith("vehicle.") and f.status != UNTOLD
    }
    names = tuple(sorted({*model.vehicle.measured, *told}))
    return dataclasses.replace(model, vehicle=dataclasses.replace(model.vehicle, measured=names))


def _fitted(c: Coordinate, w: float, sigma: float, status: str, ratio: float) -> FittedParameter:
    low, high = c.bounds()
    return FittedParameter(
        c.name, c.unit, c.value(w), c.rate(w) * sigma, c.value(w - 2.0 * sigma), c.value(w + 2.0 * sigma),
        c.start, c.prior, c.rate(0.0), status, ratio, w <= low + 1e-9 or w >= high - 1e-9,
    )  # fmt: skip


def misfits(problem: Problem, solution: Solution) -> list[str]:
    """Channels whose residuals are `MISFIT` times what the sensor and its scatter explain, in sentences."""
    return [
        f"{problem.logs[i].name}: {problem.logs[i].observed[k].channel} is off by {noise.scale:.0f} times "
        "its noise: is it the right vehicle, ground, slope, load and frame?"
        for (i, k), noise in solution.noise.items()
        if noise.scale > MISFIT
    ]


def assumptions(problem: Problem) -> list[str]:
    """What was taken for granted, in sentences."""
    model = problem.model
    plane = (
        f"a plane with a slope of {math.degrees(model.slope_rad):g} deg"
        if model.slope_rad
        else "level ground"
    )
    said = [
        f"all logs were driven on {plane} with a payload of {model.payload_kg:g} kg",
        "everything that was not calibrated is as the vehicle's and the soils' files say",
        "commands were limited in acceleration as the vehicle's file says",
    ]
    if any(o.correlation is not None for log in problem.logs for o in log.observed):
        said.append("GNSS position errors drift with the time constant of the receiver's data sheet")
    if problem.robust:
        said.append("outliers were weighed down (Huber)")
    return said


def _check(recordings: tuple[Recording, ...], source: str, window_s: float) -> None:
    if not recordings:
        raise DataError("no log was given", remedy="give at least one")
    check_source(source)
    if not 1.0 <= window_s <= 600.0:
        raise ConfigError(f"a window of {window_s:g} s is out of range", remedy="give 1 to 600 s")


def _named_apart(recordings: tuple[Recording, ...]) -> tuple[Recording, ...]:
    """The logs, those of one name numbered: results go by name."""
    out: list[Recording] = []
    for recording in recordings:
        count = sum(r.name == recording.name for r in recordings[: len(out)])
        name = f"{recording.name} ({count + 1})" if count else recording.name
        out.append(dataclasses.replace(recording, name=name))
    return tuple(out)


def _start(
    recordings: tuple[Recording, ...],
    vehicle: VehicleParams,
    soils: Soils,
    effects: Mapping[str, float],
) -> tuple[Model, str | None]:
    """The model to start from, and the name of the one ground where there is one for all logs."""
    loaded, present = with_overrides(vehicle, reported_geometry(recordings)), {**vehicle.effects, **effects}
    if soils is not None and not isinstance(soils, Mapping):
        soil = soils if isinstance(soils, SoilParams) else load_soil(soils)
        return Model(loaded, {soil.name: soil}, present), soil.name
    given = dict(soils or {})
    found = {}
    for recording in recordings:
        for label in dict.fromkeys(grounds(recording, recording.start_ns)[0]):
            if label not in found:
                found[label] = _soil(given.get(label, label), label, recording)
    if unmet := sorted(set(given) - set(found)):
        raise ConfigError(
            f"no log drives on '{unmet[0]}'", channel="terrain", remedy=f"their grounds: {', '.join(found)}"
        )
    return Model(loaded, found, present), None


def _soil(given: str | Path | SoilParams, label: str, recording: Recording) -> SoilParams:
    if isinstance(given, SoilParams):
        return given
    try:
        return load_soil(given)
    except ConfigError:
        if given != label:
            raise
        what = f"its ground '{label}' is no soil of the library" if label else "it does not say its ground"
        raise DataError(
            what, file=recording.name, channel="terrain", remedy="name the soil with --terrain"
        ) from None


def _spelt(name: str, model: Model) -> list[str]:
    return [f"{s}.{name.removeprefix('soil.')}" for s in model.soils] if name.startswith("soil.") else [name]


def _refuse_followed(numbers: Mapping[str, object], logs: Sequence[PreparedLog]) -> None:
    """Refuse parameters of motors and speed loop where the twin's wheels follow measured ones in all logs."""
    if not all(log.follows for log in logs):
        return
    parts = ("speed_loop_p_nms", "speed_loop_i_nm", *FOLLOWING)
    for name in numbers:
        if name.startswith("vehicle.drive.") and name.rpartition(".")[2] in parts:
            raise DataError(
                f"'{name}' cannot be told where the twin follows the measured wheels",
                file=logs[0].name, remedy="give a log with commands, or leave the parameter out",
            )  # fmt: skip
