"""The answer of a calibration, from where the search ended: parameters with sigma, fits, notes."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.twin.calibrate.coordinates import Coordinate
from terrafusion.twin.calibrate.identifiability import NOT_IDENTIFIED, Identifiability
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise_learning import by_channel
from terrafusion.twin.calibrate.predict import input_delay_s
from terrafusion.twin.calibrate.problem import Problem, ResidualBlock
from terrafusion.twin.calibrate.result import Calibration, ChannelFit, FittedParameter
from terrafusion.twin.calibrate.solver import OUTCOMES, Solution

LATE_S = 0.15
"""Commands that the wheels follow later than this are noted: speed loops of shipped vehicles take 0.1 s."""


def answer_of(
    problem: Problem, solution: Solution, covariance: Array, identified: Identifiability, notes: Sequence[str]
) -> Calibration:
    """The calibration, from the covariance (G, G) of `covariance.covariance_of`."""
    point, P, B = solution.point, len(problem.coordinates), len(problem.errors)
    cov = covariance[:P, :P]
    sigma = np.sqrt(np.diag(cov))
    fitted = [
        _fitted(c, float(w), float(s), identified.status[i], float(identified.ratio[i]))
        for i, (c, w, s) in enumerate(zip(problem.coordinates, point.w, sigma, strict=True))
    ]
    rate = np.array([c.rate(float(w)) for c, w in zip(problem.coordinates, point.w, strict=True)])
    errors = {
        log.name: {
            e.name: (
                float(point.errors[i, k] * e.sigma),
                float(math.sqrt(covariance[P + B * i + k, P + B * i + k]) * e.sigma),
            )
            for k, e in enumerate(problem.errors)
            if any(o.channel == e.channel for o in log.observed)
        }
        for i, log in enumerate(problem.logs)
    }
    channels = channel_fits(problem, solution)
    misfits = [sentence for channel in channels if (sentence := channel.misfit()) is not None]
    return Calibration(
        tuple(fitted), cov / np.outer(sigma, sigma), cov * np.outer(rate, rate), identified,
        _marked(problem.model_at(point.w), fitted), problem.model, channels, errors,
        solution.outcome, OUTCOMES[solution.outcome], solution.runs, problem.seconds(),
        (*notes, *misfits, *_late(problem, point.w), *_assumptions(problem)),
    )  # fmt: skip


def channel_fits(problem: Problem, solution: Solution) -> tuple[ChannelFit, ...]:
    """Every channel of every log; "before" has the start values, with sensor errors and poses fitted."""
    fits = []
    before, after = by_channel(_nuisances_fitted(problem, solution)), by_channel(solution.blocks)
    for key, mine in after.items():
        log, noise = problem.logs[key[0]], solution.noise[key]
        observed = log.observed[key[1]]
        rows = np.concatenate([b.rows for b in mine])
        residual = np.concatenate([b.residual for b in mine])
        old = np.concatenate([b.residual for b in before[key]])
        white = [problem.whitened(b, solution.noise)[0] for b in mine]
        measured = observed.value[rows]
        fits.append(
            ChannelFit(
                log.name, observed.channel, 0.5 * (observed.begin_s + observed.end_s)[rows], measured,
                measured + old, measured + residual, noise.scale * float(np.median(observed.sigma)),
                noise.rho[1] if len(noise.rho) > 1 else 0.0, _lag_one(white),
                float(np.mean(np.abs(np.concatenate(white)) > 4.0)), noise.scale,
            )
        )  # fmt: skip
    return tuple(fits)


def _lag_one(white: list[Array]) -> float:
    """Autocorrelation of whitened residuals at a lag of one row, over all windows."""
    below = sum(float(w @ w) for w in white)
    return sum(float(w[1:] @ w[:-1]) for w in white) / below if below > 0.0 else 0.0


def _nuisances_fitted(problem: Problem, solution: Solution) -> list[ResidualBlock]:
    """The first blocks after one step of sensor errors and poses, which enter all but linearly."""
    P = len(problem.coordinates)
    normal = problem.normal(problem.start(), solution.first, solution.noise)
    d = np.zeros(len(normal.g))
    d[P:] = np.linalg.solve(normal.H[P:, P:], -normal.g[P:])
    _, derrors, dpose = problem.step(normal, d)
    out = []
    for b in solution.first:
        local = np.concatenate([np.zeros(P), derrors[b.log], dpose[b.log][b.window]])
        out.append(dataclasses.replace(b, residual=b.residual + b.change @ local))
    return out


def _marked(model: Model, fitted: Sequence[FittedParameter]) -> Model:
    """The model with the identified numbers of the vehicle in `VehicleParams.measured`."""
    names = {
        f.name.removeprefix("vehicle.")
        for f in fitted
        if f.name.startswith("vehicle.") and f.status != NOT_IDENTIFIED
    }
    measured = tuple(sorted({*model.vehicle.measured, *names}))
    return dataclasses.replace(model, vehicle=dataclasses.replace(model.vehicle, measured=measured))


def _fitted(c: Coordinate, w: float, sigma: float, status: str, ratio: float) -> FittedParameter:
    low, high = c.bounds()
    return FittedParameter(
        c.name, c.unit, c.value(w), c.rate(w) * sigma, c.value(w - 2.0 * sigma), c.value(w + 2.0 * sigma),
        c.start, c.prior, c.rate(0.0), status, ratio, w <= low + 1e-9 or w >= high - 1e-9,
    )  # fmt: skip


def _late(problem: Problem, w: Array) -> list[str]:
    """Where a robot follows its commands later than its twin: other numbers then explain that."""
    model, notes = problem.model_at(w), []
    for log in problem.logs:
        dead_time_s = input_delay_s(log, model, model.effects)
        late_s = log.lateness_s(dead_time_s)
        if late_s is not None and late_s > LATE_S:
            notes.append(
                f"{log.name}: the wheels follow the commands {late_s:.2f} s after the dead time of "
                f"{dead_time_s:.2f} s, so that numbers are biased: calibrate vehicle.drive.dead_time_s, too, "
                "correct the limits of acceleration in the vehicle's file, or use --input wheels"
            )
    return notes


def _assumptions(problem: Problem) -> list[str]:
    model, slope_deg = problem.model, math.degrees(problem.model.slope_rad)
    plane = f"a plane with a slope of {slope_deg:g} deg" if model.slope_rad else "level ground"
    notes = [
        f"all logs were driven on {plane} with a payload of {model.payload_kg:g} kg",
        "everything that was not calibrated is as the vehicle's and the soils' files say",
    ]
    if not all(log.follows for log in problem.logs):
        notes.append("commands were limited in acceleration as the vehicle's file says")
    if any(o.correlation is not None for log in problem.logs for o in log.observed):
        notes.append("GNSS position errors drift with the time constant of the receiver's data sheet")
    if problem.robust:
        notes.append("outliers were weighed down (Huber)")
    return notes
