"""The gap as the estimator sees it: how it performs on real logs and on the twin's logs of the same drives.

The twin drives the commands of each log, with the same channels, noise of its own data sheets and soil set to
the references: once as it is, and once with the named effect. Any function that scores a log can take the
estimator's place.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.replay import replay
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

STEP_S = 0.1  # step of the commands of the twin's drive
ERROR = "distance from fixes held out, m (median)"
NIS = "squared innovation of {}, a degree of freedom"

LogScores = Mapping[str, float]  # scores of one log by name; those that it does not allow are left out
Scorer = Callable[[Recording], LogScores]


@dataclass(frozen=True)
class Compared:
    """One score: mean over the logs of each kind, None where no log has it.

    Attributes:
        references, runs: real logs.
        twin: the twin's logs of the same drives.
        corrected: the same with the named effect; None where none was named.
    """

    score: str
    references: float | None
    runs: float | None
    twin: float | None
    corrected: float | None


def estimator_scorer(vehicle: str) -> Scorer:
    """A function that replays a log with a vehicle, by name or file, and scores it without reference pose.

    The error is that against every fifth fix, which the estimator is not given; a log without GNSS has none.
    A squared innovation (NIS) of one a degree of freedom is what its own covariance says.
    """

    def score(recording: Recording) -> dict[str, float]:
        result = replay(dataclasses.replace(recording, truth=None, truth_channels=()), vehicle=vehicle)
        scores = {}
        if result.scores.held_out is not None:
            scores[ERROR] = result.scores.held_out.median_m
        by_sensor: dict[str, list[float]] = {}
        for one in result.estimate.innovations:
            if one.dof > 0 and math.isfinite(one.nis):
                by_sensor.setdefault(one.sensor, []).append(one.nis / one.dof)
        return scores | {NIS.format(sensor): fmean(values) for sensor, values in by_sensor.items()}

    return score


def estimator_gap(
    found: GapDiagnosis,
    runs: Sequence[Recording],
    references: Sequence[Recording],
    scorer: Scorer,
    seed: int = 0,
) -> tuple[list[Compared], list[str]]:
    """Scores of real logs, and of the twin's logs of the judged runs' drives; and why some have none.

    Args:
        found: the diagnosis of these runs against these references.
        scorer: a `TerrafusionError` of it is returned and that log left out.
    """
    failed: list[str] = []

    def scores(logs: Sequence[Recording]) -> list[LogScores]:
        out = []
        for log in logs:
            try:
                out.append(scorer(log))
            except TerrafusionError as error:
                failed.append(str(error))
        return out

    def twins(effects: Mapping[str, float]) -> list[Recording]:
        pairs = zip(runs, found.evidence.runs, itertools.count(seed), strict=False)
        return [twin_of(run, white.log, found.evidence.model, effects, k) for run, white, k in pairs]

    groups = [scores(references), scores(runs), scores(twins({})), []]
    fit = found.verdict.fit
    if fit is not None:
        effects = found.evidence.candidates.changed(fit.columns, np.concatenate(fit.values))
        groups[-1] = scores(twins(effects))
    names = dict.fromkeys(name for group in groups for one in group for name in one)
    return [Compared(name, *(_mean(group, name) for group in groups)) for name in names], failed


def _mean(group: Sequence[LogScores], name: str) -> float | None:
    values = [one[name] for one in group if name in one and math.isfinite(one[name])]
    return float(np.mean(values)) if values else None


def twin_of(
    recording: Recording, log: PreparedLog, model: Model, effects: Mapping[str, float], seed: int
) -> Recording:
    """The twin's log of a prepared drive: the recording's channels, no truth, noise by the vehicle file.

    `effects` are added to the model's own.
    """
    run = simulate_run(
        scenario_of(log, model), vehicle=model.vehicle, soils=model.soils, seed=seed,
        effects={**model.effects, **effects},
    )  # fmt: skip
    made = run.recording
    absent: dict[str, Any] = {
        name: None for name in ("wheels", "imu", "gnss", "motor") if getattr(recording, name) is None
    }
    return dataclasses.replace(
        made, name=f"twin of {recording.name}", vehicle=recording.vehicle, overrides=recording.overrides,
        truth=None, truth_channels=(), **absent,
    )  # fmt: skip


def scenario_of(log: PreparedLog, model: Model) -> Scenario:
    """The drive of a log as commands: the speeds of its sides, at the vehicle's radius and track."""
    every = round(STEP_S / DT_S)
    rim = model.vehicle.odometry.wheel_radius_m * log.sides[: len(log.sides) // every * every]
    sides = rim.reshape(-1, every, 2).mean(axis=1)
    v, r = sides.mean(axis=1), (sides[:, 1] - sides[:, 0]) / model.vehicle.odometry.track_m
    drive = tuple(DriveSegment(STEP_S, float(a), float(b)) for a, b in zip(v, r, strict=True))
    return Scenario(log.name, len(v) * STEP_S, route=_route(log), route_over="time", drive=drive)


def _route(log: PreparedLog) -> tuple[RouteLeg, ...]:
    lengths = [float(x) for x in np.diff(np.concatenate([[0.0], log.borders]))]
    return (*(RouteLeg(g, x) for g, x in zip(log.labels, lengths, strict=False)), RouteLeg(log.labels[-1]))
