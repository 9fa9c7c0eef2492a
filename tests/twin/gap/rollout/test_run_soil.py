"""Each run on its own ground."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.refit import RunWithEffects, whitened_errors
from terrafusion.twin.gap.null.evidence import GapEvidence, gather_evidence
from terrafusion.twin.gap.rollout.batch import SOIL_SIGMAS
from terrafusion.twin.gap.rollout.residuals import RunResiduals, WhitenedRun, clip_outliers
from terrafusion.twin.gap.rollout.run_soil import SoilSearch, soil_limit
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

STRONGER = {"soil_strength/shear": 0.9}


@pytest.fixture(scope="module")
def evidence() -> GapEvidence:
    candidates = Candidates.of(["soil_strength", "motion_resistance", "wheel_radius"])
    given = runs(980, 2, STRONGER), runs(985, 4)
    return gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=2)


def residuals(runs: list[WhitenedRun]) -> list[RunResiduals]:
    return [run.residuals for run in runs]


def test_a_run_looks_for_its_ground_where_the_references_are(evidence: GapEvidence) -> None:
    """A gap is not taken up as ground before anything else is asked; references stay near each other."""
    first = evidence.runs[0].residuals
    assert len(first.soil) == len(SOIL_SIGMAS)
    assert all(np.abs(run.soil[0]) < 2.0 for run in residuals(evidence.runs))  # .9 is 4.5 typical sizes
    wide = [dataclasses.replace(first, soil=np.array([3.0, 0.0, 0.0]))] * 9
    near = [dataclasses.replace(first, soil=np.zeros(3))] * 9
    assert soil_limit(wide, evidence.candidates)[0] == 4.0
    assert soil_limit(near, evidence.candidates)[0] < 0.6


def test_a_search_that_steps_too_far_tries_a_shorter_step_and_is_the_same_for_judged_runs_and_references(
    evidence: GapEvidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Slip grows steeply as the ground gets weaker: a run whose full step went too far stayed on the
    references' ground, and one with a limit, which shortens the step, did not."""
    step = SoilSearch.step
    monkeypatch.setattr(SoilSearch, "step", lambda *given: 8.0 * step(*given))
    found = gather_evidence(
        runs(990, 1), runs(990, 3), load_vehicle("elevate"), None, evidence.candidates, jobs=2
    )
    by_name = {run.name: run for run in found.references}
    assert all(run.soil.any() for run in residuals([by_name["run990"], by_name["run991"]]))
    same = [found.runs[0], by_name[found.runs[0].name]]
    np.testing.assert_array_equal(*(run.soil for run in residuals(same)))


def test_a_ground_beyond_its_range_is_neither_driven_nor_carried_back(evidence: GapEvidence) -> None:
    """Nothing rolls with less than no resistance: a run that asks for it is as on the references' ground."""
    k = list(SOIL_SIGMAS).index("motion_resistance/rolling")
    assert "motion_resistance/rolling" not in evidence.model.effects
    below, above = np.zeros(len(SOIL_SIGMAS)), np.zeros(len(SOIL_SIGMAS))
    below[k], above[k] = -1.0, 1.0
    none, same, other = whitened_errors(
        evidence, [RunWithEffects(0, {}, own) for own in (np.zeros(len(SOIL_SIGMAS)), below, above)]
    )
    assert none is not None
    np.testing.assert_array_equal(none, same)
    assert np.abs(none - other).max() > 0.1
    assert all(r.soil[k] >= 0.0 for r in residuals(evidence.runs))


def test_limits_move_with_what_the_states_explain(evidence: GapEvidence) -> None:
    """An error that is all state stays whole at any size, and none at all stays none: limits are about
    what is left, whatever an error was when the limits were set."""
    run = evidence.runs[0]
    J = run.rows[:, : run.states].astype(float)
    gain = np.linalg.solve(J.T @ J + 1e-6 * np.eye(run.states), J.T)
    tight = dataclasses.replace(run, state_gain=gain, limit=np.full(len(run.limit), 4.0))
    far = 60.0 * J[:, 0] / np.abs(J[:, 0]).max()
    np.testing.assert_allclose(clip_outliers(tight, far), far, atol=4.0)
    assert np.abs(clip_outliers(tight, 0.0 * far)).max() == 0.0
    spike = np.zeros(len(J))
    spike[len(J) // 2] = 100.0
    assert 3.9 < clip_outliers(tight, spike).max() < 8.0
