"""Fits through the twin on each run's own ground: what a state explained first, a law may take over."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.cause_posterior import linear_residuals
from terrafusion.twin.gap.infer.channels import ChannelTable
from terrafusion.twin.gap.infer.nonlinear_refit import NonlinearRefit, line_search_size
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.infer.refit import RunWithEffects, whitened_errors
from terrafusion.twin.gap.null.evidence import GapEvidence, gather_evidence
from terrafusion.twin.gap.null.null import learn_null
from terrafusion.twin.gap.null.score import learn_state_sigma, score
from terrafusion.twin.gap.rollout.residuals import SOIL_SIGMAS, clip_outliers, initial_state_sigma
from terrafusion.twin.gap.rollout.run_soil import soil_limit
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

STRONGER = {"soil_strength/shear": 0.9}


@pytest.fixture(scope="module")
def evidence() -> GapEvidence:
    candidates = Candidates.of(["soil_strength", "motion_resistance", "wheel_radius"])
    given = runs(980, 2, STRONGER), runs(985, 4)
    return gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=2)


def refit_of(evidence: GapEvidence) -> NonlinearRefit:
    """What fits laws to the evidence's runs."""
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(evidence.candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (evidence.references, evidence.runs))
    null = learn_null(normal, len(scores))
    table = ChannelTable.of(evidence.runs, evidence.references, normal, sigma, len(evidence.candidates.keys))
    return NonlinearRefit(evidence, scores, sigma, null, PooledScores.of(scores, null), table)


def test_a_ground_far_away_is_driven_and_not_a_multiple_of_a_small_change(evidence: GapEvidence) -> None:
    """Fitted through the twin little is left; no multiple of the derivative at the references' does that."""
    refit = refit_of(evidence)
    residuals, sizes = linear_residuals(refit.table, refit.pooled, evidence.candidates)
    law = next(h for h in evidence.candidates.hypotheses if (h.effect, h.form) == ("soil_strength", "shear"))
    found = refit.fits([(law, sizes[law])])[0][law]
    scale = evidence.candidates.scale[law.columns[0]]
    assert float(found.fit.value[0]) * scale == pytest.approx(STRONGER["soil_strength/shear"], abs=0.1)
    assert found.left.total < 0.35 * residuals[law].total
    assert all((np.abs(own) <= evidence.soil_limit).all() for own in found.fit.soils)


def test_a_run_looks_for_its_ground_where_the_references_are(evidence: GapEvidence) -> None:
    """A gap is not taken up as ground before anything else is asked; references stay near each other."""
    assert len(evidence.residuals[0].soil) == len(SOIL_SIGMAS)
    assert all(np.abs(run.soil[0]) < 2.0 for run in evidence.residuals)  # .9 is 4.5 typical sizes
    wide = [dataclasses.replace(evidence.residuals[0], soil=np.array([3.0, 0.0, 0.0]))] * 9
    near = [dataclasses.replace(evidence.residuals[0], soil=np.zeros(3))] * 9
    assert soil_limit(wide, evidence.candidates)[0] == 4.0
    assert soil_limit(near, evidence.candidates)[0] < 0.6


def test_a_ground_beyond_its_range_is_neither_driven_nor_carried_back(evidence: GapEvidence) -> None:
    """Nothing rolls with less than no resistance: a run that asks for it is as on the references' ground."""
    k = list(SOIL_SIGMAS).index("motion_resistance/rolling")
    assert evidence.model.effects["motion_resistance/rolling"] == 0.0
    below, above = np.zeros(len(SOIL_SIGMAS)), np.zeros(len(SOIL_SIGMAS))
    below[k], above[k] = -1.0, 1.0
    none, same, other = whitened_errors(
        evidence, [RunWithEffects(0, {}, own) for own in (np.zeros(len(SOIL_SIGMAS)), below, above)]
    )
    assert none is not None
    np.testing.assert_array_equal(none, same)
    assert np.abs(none - other).max() > 0.1
    assert all(r.soil[k] >= 0.0 for r in evidence.residuals)


def test_limits_move_with_what_the_states_explain(evidence: GapEvidence) -> None:
    """An error that is all state stays whole at any size, and none at all stays none: limits are about
    what is left, whatever an error was when the limits were set."""
    run = evidence.runs[0]
    J = run.rows[:, : run.states].astype(float)
    gain = np.linalg.solve(J.T @ J + np.diag(initial_state_sigma(evidence.candidates) ** -2.0), J.T)
    tight = dataclasses.replace(run, state_gain=gain, limit=np.full(len(run.limit), 4.0))
    far = 60.0 * J[:, 0] / np.abs(J[:, 0]).max()
    np.testing.assert_allclose(clip_outliers(tight, far), far, atol=4.0)
    assert np.abs(clip_outliers(tight, 0.0 * far)).max() == 0.0
    spike = np.zeros(len(J))
    spike[len(J) // 2] = 100.0
    assert 3.9 < clip_outliers(tight, spike).max() < 8.0


def test_the_next_size_lies_between_the_best_ones_and_beyond_the_last() -> None:
    def tried(*pairs: tuple[float, float]) -> list[tuple[np.ndarray, float]]:
        return [(np.array([size]), left) for size, left in pairs]

    whole = [(x, (x - 0.7) ** 2) for x in (0.3, 0.6, 1.2)]
    assert line_search_size(tried(*whole), before=0.49) == pytest.approx(
        0.7, abs=0.05
    )  # a parabola's own least
    assert line_search_size(tried((1.0, 3.0), (2.0, 1.0)), before=4.0) == pytest.approx(3.0)
    assert line_search_size(tried((-1.0, 3.0), (-2.0, 1.0)), before=4.0) == pytest.approx(-3.0)
    assert line_search_size(tried((1.0, 9.0), (2.0, 9.5)), before=8.0) == pytest.approx(
        -1.0
    )  # none helps: below zero
