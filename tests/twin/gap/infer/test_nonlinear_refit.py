"""A law without a signature is driven at sizes over its range."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer import candidate_selection
from terrafusion.twin.gap.infer.cause_posterior import (
    linear_residuals,
)
from terrafusion.twin.gap.infer.channels import ChannelTable
from terrafusion.twin.gap.infer.nonlinear_refit import NonlinearRefit, starting_sizes
from terrafusion.twin.gap.infer.posterior import PooledScores
from terrafusion.twin.gap.null.evidence import gather_evidence
from terrafusion.twin.gap.null.null import learn_null
from terrafusion.twin.gap.null.score import learn_state_sigma, score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.runs import runs

LOST = 0.85
"""Of the torque limit: what is left does not suffice to speed up as residuals."""


@pytest.fixture(scope="module")
def refit() -> NonlinearRefit:
    candidates = Candidates.of(["torque_limit", "drivetrain_friction", "wheel_radius"])
    given = runs(970, 1, {"torque_limit/scale": LOST}), runs(975, 4)
    evidence = gather_evidence(*given, load_vehicle("elevate"), None, candidates, jobs=1)
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (evidence.references, evidence.runs))
    null = learn_null(normal, 1)
    table = ChannelTable.of(evidence.runs, evidence.references, normal, sigma, len(candidates.keys))
    return NonlinearRefit(evidence, scores, sigma, null, PooledScores.of(scores, null), table)


def test_a_torque_limit_is_silent_and_others_are_not(refit: NonlinearRefit) -> None:
    silent = {
        (law.effect, law.form) for law in refit.evidence.candidates.hypotheses if refit.is_insensitive(law)
    }
    assert silent == {("torque_limit", "scale"), ("torque_limit", "heating")}


def test_it_is_found_although_its_signature_says_nothing(
    refit: NonlinearRefit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidate_selection, "BY_ODDS", 2)
    monkeypatch.setattr(candidate_selection, "BY_FACTOR", 1)
    candidates = refit.evidence.candidates
    residuals, _ = linear_residuals(refit.table, refit.pooled, candidates)
    law = next(h for h in candidates.hypotheses if (h.effect, h.form) == ("torque_limit", "scale"))
    assert residuals[law].total > 0.99 * min(one.total for one in residuals.values())
    posterior, fits, _ = candidate_selection.select_and_refit(refit, True)
    assert posterior.ranked()[0] == "torque_limit"
    i = candidates.keys.index("torque_limit/scale")
    assert float(fits[law].fit.value[0]) * candidates.scale[i] == pytest.approx(LOST, abs=0.06)
    assert fits[law].left.total < 0.5 * refit.table.before().total


def test_sizes_tried_hold_the_linear_one_and_stay_within_bounds() -> None:
    low, high = np.array([0.0]), np.array([9.0])
    tried = [float(p[0]) for p in starting_sizes(np.array([3.0]), low, high)]
    assert 3.0 in tried
    assert len(set(tried)) == len(tried) == 4
    assert max(tried) == 9.0
    small = starting_sizes(np.array([0.1, 0.0]), np.full(2, -9.0), np.full(2, 9.0))
    assert max(float(np.linalg.norm(p)) for p in small) > 5.0


def test_a_large_lag_is_found_through_the_twin_where_its_signature_misleads() -> None:
    """A lag of the command of 0.4 s: eight typical sizes, far from linear."""
    candidates = Candidates.of(["actuator_lag"])
    law = next(h for h in candidates.hypotheses if h.form == "command")
    key, truth = "actuator_lag/command", 0.4
    evidence = gather_evidence(
        runs(970, 1, {key: truth}), runs(975, 3), load_vehicle("elevate"), None, candidates, jobs=1
    )
    sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (evidence.references, evidence.runs))
    null = learn_null(normal, 1)
    pooled = PooledScores.of(scores, null)
    table = ChannelTable.of(evidence.runs, evidence.references, normal, sigma, len(candidates.keys))
    scale = float(candidates.scale[candidates.keys.index(key)])
    value, _ = table.linear_fit(law.columns, *candidates.bounds(law.columns))
    best = NonlinearRefit(evidence, scores, sigma, null, pooled, table).fits([(law, value)])[0][law]
    error = abs(float(best.fit.value[0]) * scale - truth)
    assert error < 0.04
    assert error < 0.5 * abs(float(value[0]) * scale - truth)
    assert best.left.total < 0.4 * table.before().total
    assert best.fit.explained > 0.0
