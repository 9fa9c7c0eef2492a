"""The gap as somebody else sees it who has to work with such logs, an estimator for one.

The twin drives what each log was told, with the same channels, noise of its own data sheets and ground set
to the references: once as it is, and once with the named effect. What a judge makes of these logs is held
against what it makes of the real ones. The judge is a function that is passed in: this package knows none.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.infer.refit import effects_at
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

Array = NDArray[np.float64]

STEP_S = 0.1
"""Commands of the twin's drive are held this long."""

Marks = Mapping[str, float]
"""What a judge says of one log, by name of the mark, such as "NIS of wheels"; marks it cannot give are left
out."""
Judge = Callable[[Recording], Marks]


@dataclass(frozen=True)
class Compared:
    """One mark: mean over the logs of each kind, None where no log has it.

    Attributes:
        references, runs: real logs.
        twin: the twin's logs of the same drives.
        corrected: the same with the named effect; None where none was named.
    """

    mark: str
    references: float | None
    runs: float | None
    twin: float | None
    corrected: float | None


def judged(
    found: GapDiagnosis,
    runs: Sequence[Recording],
    references: Sequence[Recording],
    judge: Judge,
    seed: int = 0,
) -> tuple[list[Compared], list[str]]:
    """Marks of real logs, and of the twin's logs of the judged runs' drives; and why some have none.

    Args:
        found: the diagnosis of these runs against these references.
        judge: gives marks; a `TerrafusionError` of it is told and that log left out.
    """
    failed: list[str] = []

    def marks(logs: Sequence[Recording]) -> list[Marks]:
        out = []
        for log in logs:
            try:
                out.append(judge(log))
            except TerrafusionError as error:
                failed.append(str(error))
        return out

    def twins(effects: Mapping[str, float]) -> list[Recording]:
        drives = zip(runs, found.evidence.runs, itertools.count(seed), strict=False)
        return [twin_of(run, evidence.log, found.evidence.model, effects, k) for run, evidence, k in drives]

    groups = [marks(references), marks(runs), marks(twins({})), []]
    fit = found.verdict.fit
    if fit is not None:
        groups[-1] = marks(twins(effects_at(found.evidence, fit.columns, fit.value)))
    names = dict.fromkeys(name for group in groups for one in group for name in one)
    return [Compared(name, *(_mean(group, name) for group in groups)) for name in names], failed


def _mean(group: Sequence[Marks], name: str) -> float | None:
    values = [one[name] for one in group if name in one and math.isfinite(one[name])]
    return float(np.mean(values)) if values else None


def twin_of(
    recording: Recording, log: PreparedLog, model: Model, effects: Mapping[str, float], seed: int
) -> Recording:
    """The twin's log of a drive: the channels the recording has, no truth, noise by the vehicle's file.

    Args:
        log: the recording made ready: what the twin was told, and the ground.
        effects: on top of the model's own.
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
    """The drive of a log as commands: the speeds its sides were told, at the vehicle's radius and track."""
    every = round(STEP_S / DT_S)
    rim = model.vehicle.wheel.radius_m * log.sides[: len(log.sides) // every * every]
    sides = rim.reshape(-1, every, 2).mean(axis=1)
    v, r = sides.mean(axis=1), (sides[:, 1] - sides[:, 0]) / model.vehicle.odometry.track_m
    drive = tuple(DriveSegment(STEP_S, float(a), float(b)) for a, b in zip(v, r, strict=True))
    return Scenario(log.name, len(v) * STEP_S, route=_route(log), route_over="time", drive=drive)


def _route(log: PreparedLog) -> tuple[RouteLeg, ...]:
    lengths = [float(x) for x in np.diff(np.concatenate([[0.0], log.borders]))]
    return (*(RouteLeg(g, x) for g, x in zip(log.labels, lengths, strict=False)), RouteLeg(log.labels[-1]))
