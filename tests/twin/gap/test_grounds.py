"""Fits through the twin on each run's own ground: what a state explained first, a law may take over."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.cause_posterior import linear
from terrafusion.twin.gap.infer.channels import Table
from terrafusion.twin.gap.infer.evidence import Bench, gather
from terrafusion.twin.gap.infer.nonlinear_refit import Fitter, between
from terrafusion.twin.gap.infer.posterior import Pool
from terrafusion.twin.gap.infer.refit import Tried, errors_of
from terrafusion.twin.gap.null.null import learn
from terrafusion.twin.gap.null.score import learnt_sigma, score
from terrafusion.twin.gap.rollout.residuals import SOIL_STATE, reach, state_sigmas, within_limits
from terrafusion.twin.model.vehicle import load_vehicle
from tests.twin.gap.drives import runs

STRONGER = {"soil_strength/shear": 0.9}


@pytest.fixture(scope="module")
def bench() -> Bench:
    candidates = Candidates.of(["soil_strength", "motion_resistance", "wheel_radius"])
    given = runs(980, 2, STRONGER), runs(985, 4)
    return gather(*given, load_vehicle("elevate"), None, candidates, jobs=2)


def fitter_of(bench: Bench) -> Fitter:
    """What fits laws to the bench's runs."""
    sigma = learnt_sigma(bench.references, state_sigmas(bench.candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (bench.references, bench.runs))
    null = learn(normal, len(scores))
    table = Table.of(bench.runs, bench.references, normal, sigma, len(bench.candidates.keys))
    return Fitter(bench, scores, sigma, null, Pool.of(scores, null), table)


def test_a_ground_far_away_is_driven_and_not_a_multiple_of_a_small_change(bench: Bench) -> None:
    """Fitted through the twin little is left; no multiple of the derivative at the references' does that."""
    fitter = fitter_of(bench)
    told, sizes = linear(fitter.table, fitter.pool, bench.candidates)
    law = next(h for h in bench.candidates.hypotheses if (h.effect, h.form) == ("soil_strength", "shear"))
    found = fitter.fits([(law, sizes[law])])[0][law]
    scale = bench.candidates.scale[law.columns[0]]
    assert float(found.fit.value[0]) * scale == pytest.approx(STRONGER["soil_strength/shear"], abs=0.1)
    assert found.left.total < 0.35 * told[law].total
    assert all((np.abs(own) <= bench.reach).all() for own in found.fit.grounds)


def test_a_run_looks_for_its_ground_where_the_references_are(bench: Bench) -> None:
    """A gap is not taken up as ground before anything else is asked; references stay near each other."""
    assert len(bench.raws[0].own) == len(SOIL_STATE)
    assert all(np.abs(raw.own[0]) < 2.0 for raw in bench.raws)  # .9 is 4.5 typical sizes
    wide = [dataclasses.replace(bench.raws[0], own=np.array([3.0, 0.0, 0.0]))] * 9
    near = [dataclasses.replace(bench.raws[0], own=np.zeros(3))] * 9
    assert reach(wide, bench.candidates)[0] == 4.0
    assert reach(near, bench.candidates)[0] < 0.6


def test_a_ground_beyond_its_range_is_neither_driven_nor_carried_back(bench: Bench) -> None:
    """Nothing rolls with less than no resistance: a run that asks for it is as on the references' ground."""
    k = list(SOIL_STATE).index("motion_resistance/rolling")
    assert bench.model.effects["motion_resistance/rolling"] == 0.0
    below, above = np.zeros(len(SOIL_STATE)), np.zeros(len(SOIL_STATE))
    below[k], above[k] = -1.0, 1.0
    none, same, other = errors_of(
        bench, [Tried(0, {}, own) for own in (np.zeros(len(SOIL_STATE)), below, above)]
    )
    assert none is not None
    np.testing.assert_array_equal(none, same)
    assert np.abs(none - other).max() > 0.1
    assert all(r.own[k] >= 0.0 for r in bench.raws)


def test_limits_move_with_what_the_states_explain(bench: Bench) -> None:
    """An error that is all state stays whole at any size, and none at all stays none: limits are about
    what is left, whatever an error was when the limits were set."""
    run = bench.runs[0]
    J = run.rows[:, : run.states].astype(float)
    gain = np.linalg.solve(J.T @ J + np.diag(state_sigmas(bench.candidates) ** -2.0), J.T)
    tight = dataclasses.replace(run, gain=gain, limit=np.full(len(run.limit), 4.0))
    far = 60.0 * J[:, 0] / np.abs(J[:, 0]).max()
    np.testing.assert_allclose(within_limits(tight, far), far, atol=4.0)
    assert np.abs(within_limits(tight, 0.0 * far)).max() == 0.0
    spike = np.zeros(len(J))
    spike[len(J) // 2] = 100.0
    assert 3.9 < within_limits(tight, spike).max() < 8.0


def test_the_next_size_lies_between_the_best_ones_and_beyond_the_last() -> None:
    def tried(*pairs: tuple[float, float]) -> list[tuple[np.ndarray, float]]:
        return [(np.array([size]), left) for size, left in pairs]

    whole = [(x, (x - 0.7) ** 2) for x in (0.3, 0.6, 1.2)]
    assert between(tried(*whole), before=0.49) == pytest.approx(0.7, abs=0.05)  # a parabola's own least
    assert between(tried((1.0, 3.0), (2.0, 1.0)), before=4.0) == pytest.approx(3.0)
    assert between(tried((-1.0, 3.0), (-2.0, 1.0)), before=4.0) == pytest.approx(-3.0)
    assert between(tried((1.0, 9.0), (2.0, 9.5)), before=8.0) == pytest.approx(-1.0)  # none helps: below zero
