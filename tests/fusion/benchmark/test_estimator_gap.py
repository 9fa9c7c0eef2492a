"""The twin's log of a drive, and what a judge's marks become."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.estimator_gap import (
    ERROR,
    NIS,
    estimator_gap,
    estimator_scorer,
    scenario_of,
    twin_of,
)
from terrafusion.fusion.reports.gap import judge_rows
from terrafusion.twin.calibrate.log import PreparedLog, prepare
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.start import start_model
from terrafusion.twin.gap.infer.single_effects import Fitted
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.commands import side_speeds
from terrafusion.twin.simulate import simulate
from tests.twin.gap.runs import run

MODEL = Model(load_vehicle("elevate"), {"loose_sand": load_soil("loose_sand")})


@pytest.fixture(scope="module")
def driven() -> tuple[Recording, PreparedLog]:
    recording = run(500)
    return recording, prepare(recording, MODEL, source="wheels")


def test_the_scenario_of_a_log_drives_as_its_wheels_did(driven: tuple[Recording, PreparedLog]) -> None:
    recording, log = driven
    scenario = scenario_of(log, MODEL)
    assert scenario.duration_s == pytest.approx(recording.duration_s(), abs=0.5)
    assert [leg.terrain for leg in scenario.route] == ["loose_sand"]
    told = sum(s.duration_s * s.v_mps for s in scenario.drive)
    rolled = MODEL.vehicle.wheel.radius_m * float(log.sides.mean(axis=1).sum()) * 0.01
    assert told == pytest.approx(rolled, rel=0.01)


def test_the_twin_of_a_run_turns_its_wheels_alike_and_lacks_what_the_log_lacks(
    driven: tuple[Recording, PreparedLog],
) -> None:
    recording, log = driven
    made = twin_of(dataclasses.replace(recording, gnss=None), log, MODEL, {}, seed=1)
    assert made.gnss is None
    assert made.truth is None
    assert made.wheels is not None
    assert recording.wheels is not None
    radius = MODEL.vehicle.odometry.wheel_radius_m
    t_s = np.arange(2.0, recording.duration_s() - 2.0, 0.1)

    def speeds(log: Recording) -> np.ndarray:
        at_s = (log.wheels.t_ns - log.start_ns) * 1e-9
        return np.interp(t_s, at_s, log.wheels.side_speeds_mps(radius)[:, 0])

    assert np.abs(speeds(made) - speeds(recording)).mean() < 0.05


def test_the_scenario_is_of_the_speeds_that_the_log_reports() -> None:
    """A Pathfinder's odometry takes its wheels for smaller than they are."""
    vehicle = load_vehicle("pathfinder")
    recording = simulate("straight", vehicle=vehicle, seed=1)
    model, ground, _ = start_model([recording], vehicle, None)
    log = prepare(recording, model, ground=ground)
    twist = scenario_of(log, model).commanded(np.arange(300) * 0.1)
    told = np.abs(side_speeds(twist, model.vehicle)).max()
    assert told == pytest.approx(np.abs(log.sides).max(), rel=0.01)


def fake(found_fit: Fitted | None, driven: tuple[Recording, PreparedLog]) -> SimpleNamespace:
    evidence = SimpleNamespace(model=MODEL, runs=[SimpleNamespace(log=driven[1])])
    return SimpleNamespace(evidence=evidence, verdict=SimpleNamespace(fit=found_fit))


def test_scores_are_means_and_a_log_that_cannot_be_scored_is_listed(
    driven: tuple[Recording, PreparedLog],
) -> None:
    def judge(log: Recording) -> dict[str, float]:
        if log.name == "bad":
            raise DataError("no wheels", file="bad")
        return {"mark": 3.0 if log.name.startswith("twin of") else 1.0}

    recording = driven[0]
    references = [recording, dataclasses.replace(recording, name="bad")]
    scores, failed = estimator_gap(fake(None, driven), [recording], references, judge)
    row = {"mark": "mark", "references": 1.0, "runs": 1.0, "twin": 3.0, "corrected": None}
    assert judge_rows(scores) == [row]
    assert len(failed) == 1
    assert "no wheels" in failed[0]


def test_the_estimator_gives_its_error_and_its_innovations(driven: tuple[Recording, PreparedLog]) -> None:
    judge = estimator_scorer("elevate")
    marks = judge(driven[0])
    assert 0.0 < marks[ERROR] < 5.0
    assert marks[NIS.format("gnss")] > 0.0
    assert ERROR not in judge(dataclasses.replace(driven[0], gnss=None))
