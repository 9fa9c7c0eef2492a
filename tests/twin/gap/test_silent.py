"""A law without a signature is driven at sizes over its range."""

from __future__ import annotations

import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer import candidate_selection as choosing
from terrafusion.twin.gap.infer.cause_posterior import linear
from terrafusion.twin.gap.infer.channels import Table
from terrafusion.twin.gap.infer.evidence import gather
from terrafusion.twin.gap.infer.nonlinear_refit import Fitter
from terrafusion.twin.gap.infer.posterior import Pool, beliefs
from terrafusion.twin.gap.null.null import learn
from terrafusion.twin.gap.null.score import learnt_sigma, score
from terrafusion.twin.gap.rollout.residuals import state_sigmas
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.drives import runs

LOST = 0.85
"""Of the torque limit: what is left does not suffice to speed up as told."""


@pytest.fixture(scope="module")
def fitter() -> Fitter:
    candidates = Candidates.of(["torque_limit", "drivetrain_friction", "wheel_radius"])
    given = runs(970, 1, {"torque_limit/scale": LOST}), runs(975, 4)
    bench = gather(*given, load_vehicle("elevate"), None, candidates, jobs=1)
    sigma = learnt_sigma(bench.references, state_sigmas(candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (bench.references, bench.runs))
    null = learn(normal, 1)
    table = Table.of(bench.runs, bench.references, normal, sigma, len(candidates.keys))
    return Fitter(bench, scores, sigma, null, Pool.of(scores, null), table)


def test_a_torque_limit_is_silent_and_others_are_not(fitter: Fitter) -> None:
    silent = {(law.effect, law.form) for law in fitter.bench.candidates.hypotheses if fitter.silent(law)}
    assert silent == {("torque_limit", "scale"), ("torque_limit", "heating")}


def test_it_is_found_although_its_signature_says_nothing(
    fitter: Fitter, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choosing, "BY_ODDS", 2)
    monkeypatch.setattr(choosing, "BY_FACTOR", 1)
    candidates = fitter.bench.candidates
    told, _ = linear(fitter.table, fitter.pool, candidates)
    law = next(h for h in candidates.hypotheses if (h.effect, h.form) == ("torque_limit", "scale"))
    assert told[law].total > 0.99 * min(one.total for one in told.values())
    choice, fitted, _ = choosing.chosen(fitter, beliefs(fitter.pool, candidates), True)
    assert choice.first() == "torque_limit"
    i = candidates.keys.index("torque_limit/scale")
    assert float(fitted[law].fit.value[0]) * candidates.scale[i] == pytest.approx(LOST, abs=0.06)
    assert fitted[law].left.total < 0.5 * fitter.table.before().total
