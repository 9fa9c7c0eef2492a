"""The test for a gap: by each effect's own score and beside all others, and the tail of its p-value."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.twin.gap.blind.rates import Rate
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer.detect import detect, scores_against
from terrafusion.twin.gap.null.score import Score

CANDIDATES = Candidates.of(["gyro_bias", "gyro_scale", "encoder_scale", "wheel_radius_asymmetry", "slope"])
P = len(CANDIDATES.keys) + 4
ROWS, COLUMN = 200, 2
SIGNATURES = np.random.default_rng(0).standard_normal((ROWS, P))


def scores(rng: np.random.Generator, count: int, size: float = 0.0, scatter: float = 0.0) -> list[Score]:
    """Runs with noise, one effect of that size, and a scatter of every column from run to run."""
    out = []
    for _ in range(count):
        phi = scatter * rng.standard_t(3, P)
        phi[COLUMN] += size
        error = rng.standard_normal(ROWS) + SIGNATURES @ phi
        out.append(Score(SIGNATURES.T @ error, SIGNATURES.T @ SIGNATURES, float(error @ error), ROWS))
    return out


def test_of_runs_that_are_alike_one_in_twenty_is_called_a_gap_at_most() -> None:
    rng, count = np.random.default_rng(1), 150
    alarms = 0
    for i in range(count):
        some = scores(rng, 12, scatter=0.2)
        alarms += detect(some[:3], some[3:], CANDIDATES, i).p_value <= 0.05
    assert Rate(alarms, count).interval()[0] <= 0.05


def test_an_effect_is_seen_where_all_scatter_from_run_to_run() -> None:
    """Few references do not tell how scores covary; each by itself shows it."""
    rng = np.random.default_rng(2)
    pairs = [(scores(rng, 3, 1.5, 0.2), scores(rng, 8, scatter=0.2)) for _ in range(30)]
    seen = [detect(*pair, CANDIDATES, i).p_value for i, pair in enumerate(pairs)]
    assert sum(p <= 0.05 for p in seen) >= 27


def test_the_more_an_effect_stands_out_the_less_is_chance() -> None:
    rng = np.random.default_rng(3)
    normal = scores(rng, 12)
    found = [detect(scores(rng, 3, size), normal, CANDIDATES, 0) for size in (0.0, 1.0, 10.0)]
    tails = [d.tail_probability(0.05) for d in found]
    assert tails[0] == found[0].p_value > 0.05  # no gap: nothing is carried on
    assert tails[0] > tails[1] > tails[2]
    assert tails[2] < 1e-4 < found[2].p_value
    assert found[2].statistic > 5.0 * found[1].statistic > 5.0 * found[0].statistic
    assert found[2].scatter[COLUMN] < 3.0 < 0.1 * found[2].typical[COLUMN]  # the gap is no scatter


def test_a_choice_of_judged_runs_that_shows_more_of_the_gap_does_not_make_it_doubtful() -> None:
    """One of three runs is without the effect: two of them with a reference show as much."""
    rng = np.random.default_rng(3)
    normal = scores(rng, 12)
    found = detect([*scores(rng, 2, 10.0), *scores(rng, 1)], normal, CANDIDATES, 0)
    assert 0.01 < found.p_value <= 0.05
    assert found.tail_probability(0.05) < 1e-4
    assert found.tail_probability(0.01) == found.p_value


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_taking_an_effect_out_leaves_what_references_leave(size: float) -> None:
    rng = np.random.default_rng(4)
    normal, runs = scores(rng, 12), scores(rng, 3)
    changed = [
        Score(r.b + r.A[:, COLUMN] * size, r.A, r.square, r.samples) for r in runs
    ]  # as the effect would change the same noise
    alone = scores_against(changed, normal).marginal
    whole = alone.squares()
    assert int(np.argmax(whole)) == COLUMN
    np.testing.assert_allclose(
        alone.squares([COLUMN], np.array([size])),
        scores_against(runs, normal).marginal.squares(),
        rtol=1e-9,
        atol=1e-12,
    )


@pytest.mark.parametrize("scatter", [0.0, 0.3])
def test_sigmas_are_how_sizes_scatter_from_run_to_run(scatter: float) -> None:
    """By each column's own score, fits of runs without an effect."""
    rng = np.random.default_rng(6)
    normal = scores(rng, 40, scatter=scatter)
    groups = [scores_against(scores(rng, 3, scatter=scatter), normal).marginal for _ in range(150)]
    sizes = np.array([g.gain / np.diag(g.moved) for g in groups])
    sigmas = np.array([g.sigmas(range(P)) for g in groups])
    z = (sizes / sigmas)[:, : len(CANDIDATES.keys)]
    assert 0.92 < float(np.mean(np.abs(z) < 2.0)) < 0.98  # .954 of a normal
    assert (sigmas.mean() > 0.1) == (scatter > 0.0)
