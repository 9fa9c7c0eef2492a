"""Odds of causes: what channels leave, fits from a ladder of sizes, and weights trained on truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.gap.answer.verdict import UNKNOWN
from terrafusion.twin.gap.blind import plan
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.infer import cause_posterior as choice_module
from terrafusion.twin.gap.infer.cause_posterior import Told, Weights, probabilities, weights
from terrafusion.twin.gap.infer.channels import RIDGE, Block, Products, Table
from terrafusion.twin.gap.infer.evidence import gather
from terrafusion.twin.gap.infer.goodness_of_fit import Goodness
from terrafusion.twin.gap.infer.nonlinear_refit import Fitter, bounds, sizes
from terrafusion.twin.gap.infer.posterior import Pool
from terrafusion.twin.gap.null.null import learn
from terrafusion.twin.gap.null.score import learnt_sigma, score
from terrafusion.twin.gap.rollout.residuals import state_sigmas
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.blind.development import (
    Trial,
    crossed,
    read,
    site,
    specs,
    train,
    utilities,
    write,
)
from tests.twin.gap.drives import runs

CHANNELS, ROWS, STATES, EFFECTS = 3, 400, 1, 4
NO_REFERENCES = np.zeros((0, 2 * CHANNELS))
LOW, HIGH = np.full(1, -20.0), np.full(1, 20.0)


def columns(rng: np.random.Generator) -> np.ndarray:
    return 0.3 * rng.standard_normal((CHANNELS, ROWS, STATES + EFFECTS))


def block(J: np.ndarray, error: np.ndarray) -> Block:
    gram = np.einsum("cni,cnj->cij", J, J)
    made = Products(np.einsum("cni,cn->ci", J, error), (error**2).sum(axis=1))
    inverse = np.linalg.inv(gram + RIDGE * np.eye(J.shape[2]))
    return Block(gram, inverse, made, STATES, np.full(CHANNELS, float(ROWS)))


def table(blocks: list[Block]) -> Table:
    """A reference leaves unit variance: so many directions inside, the rest outside."""
    N = STATES + EFFECTS
    inside, outside = np.full(CHANNELS, float(N)), np.full(CHANNELS, float(ROWS - N))
    return Table((), tuple(blocks), np.ones(STATES), inside, outside, np.ones(STATES), NO_REFERENCES)


def test_taking_an_effect_out_is_what_it_is_in_full() -> None:
    rng = np.random.default_rng(1)
    J, e = columns(rng), rng.standard_normal((CHANNELS, ROWS))
    size = np.array([1.5, -0.7])
    moved = block(J, e).moved(block(J, e).error, [0, 2], size)
    again = block(J, e - J[:, :, [STATES, STATES + 2]] @ size).error
    np.testing.assert_allclose(moved.gain, again.gain, atol=1e-9)
    np.testing.assert_allclose(moved.square, again.square)


def test_the_true_effect_leaves_least_and_its_size_is_found() -> None:
    rng = np.random.default_rng(2)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        blocks.append(block(J, rng.standard_normal((CHANNELS, ROWS)) + J[:, :, STATES + 1] * 4.0))
    found = {i: table(blocks).linear([i], LOW, HIGH) for i in range(EFFECTS)}
    assert min(found, key=lambda i: found[i][1].total) == 1
    assert found[1][0][0] == pytest.approx(4.0, abs=0.3)
    assert found[1][1].total < 0.1 * table(blocks).before().total
    assert table(blocks).linear([1], LOW, np.array([2.0]))[0][0] == 2.0


def test_a_channel_that_nothing_explains_speaks_for_none() -> None:
    """An error of another kind in one channel, a hundred times the noise: the other channels still decide."""
    rng = np.random.default_rng(3)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        e = rng.standard_normal((CHANNELS, ROWS)) + J[:, :, STATES + 1] * 4.0
        e[0] += 100.0 * rng.standard_normal(ROWS)
        blocks.append(block(J, e))
    value, left = table(blocks).linear([1], LOW, HIGH)
    assert value[0] == pytest.approx(4.0, abs=0.4)
    others = [table(blocks).linear([i], LOW, HIGH)[1].total for i in (0, 2, 3)]
    assert min(others) > left.total + 1.0


def test_what_the_states_take_up_is_not_explained() -> None:
    """An effect whose signature is that of a state: it leaves less, as the state need not go so far."""
    rng = np.random.default_rng(4)
    blocks = []
    for _ in range(3):
        J = columns(rng)
        J[:, :, STATES + 1] = J[:, :, 0]
        blocks.append(block(J, rng.standard_normal((CHANNELS, ROWS)) + J[:, :, 0] * 6.0))
    before = table(blocks).before()
    value, left = table(blocks).linear([1], LOW, HIGH)
    assert before.total > 2.0
    assert left.total < 0.5 * before.total
    assert value[0] == pytest.approx(6.0, abs=1.0)


def told(left: float) -> Told:
    return Told(0.6 * left, 0.1 * left, 0.3 * left)


def chances(one: float, other: float, before: float) -> tuple[dict[str, float], float]:
    """Of two causes that leave so much of a gap, and of the unknown one."""
    by, gap = Weights(6.0, 0.9, 2.0, 3.0, 4.0), told(before)
    odds = {"one": by.cause(told(one), gap), "other": by.cause(told(other), gap)}
    return probabilities(odds, by.outsider(gap))


def test_odds_follow_what_is_left_and_an_unknown_cause_what_is_unexplained() -> None:
    known, unknown = chances(3.0, 3.0, 10.0)
    assert known["one"] == pytest.approx(known["other"])
    assert sum(known.values()) + unknown == pytest.approx(1.0)
    known, _ = chances(3.0, 5.0, 10.0)
    assert known["one"] > 2.0 * known["other"] > 0.0
    shares = [chances(left, 9.8, 10.0)[1] for left in (1.0, 5.0, 8.0, 9.0, 9.8)]
    assert shares == sorted(shares)
    assert shares[0] < 0.05
    assert shares[-1] > 0.5


def test_the_less_the_best_fits_the_likelier_is_an_unknown_cause() -> None:
    by, gap = Weights(6.0, 0.9, 2.0, 3.0, 4.0), told(8.0)
    odds = {"one": by.cause(told(5.0), gap), "other": by.cause(told(6.0), gap)}
    worse = [(0.0, 1.0, 0.0), (0.5, 1.0, 0.0), (1.0, 1.0, 0.0)]
    quieter = [(0.5, 1.0, 0.0), (0.5, 1.0, 0.5), (0.5, 1.0, 1.0)]
    for ways in (worse, quieter):
        shares = [probabilities(odds, by.outsider(gap, Goodness(*way)))[1] for way in ways]
        assert shares[0] < shares[1] < shares[2]
    known, unknown = probabilities(odds, by.outsider(gap, Goodness(1.0, 1.0, 1.0)))
    assert unknown > 0.5
    assert sum(known.values()) == pytest.approx(1.0 - unknown)
    assert known["one"] > known["other"]


def test_a_larger_gap_makes_the_same_shares_surer() -> None:
    small, large = (chances(0.4 * gap, 0.6 * gap, gap)[0] for gap in (2.0, 20.0))
    assert large["one"] / large["other"] > 2.0 * small["one"] / small["other"]


def test_sizes_tried_hold_the_linear_one_and_stay_within_bounds() -> None:
    low, high = np.array([0.0]), np.array([9.0])
    tried = [float(p[0]) for p in sizes(np.array([3.0]), low, high)]
    assert 3.0 in tried
    assert len(set(tried)) == len(tried) == 4
    assert max(tried) == 9.0
    small = sizes(np.array([0.1, 0.0]), np.full(2, -9.0), np.full(2, 9.0))
    assert max(float(np.linalg.norm(p)) for p in small) > 5.0


def test_a_large_lag_is_found_through_the_twin_where_its_signature_misleads() -> None:
    """A lag of the command of 0.4 s: eight typical sizes, far from linear."""
    candidates = Candidates.of(["actuator_lag"])
    law = next(h for h in candidates.hypotheses if h.form == "command")
    key, truth = "actuator_lag/command", 0.4
    bench = gather(
        runs(970, 1, {key: truth}), runs(975, 3), load_vehicle("elevate"), None, candidates, jobs=1
    )
    sigma = learnt_sigma(bench.references, state_sigmas(candidates))
    normal, scores = ([score(r, sigma) for r in some] for some in (bench.references, bench.runs))
    null = learn(normal, 1)
    pool = Pool.of(scores, null)
    held = Table.of(bench.runs, bench.references, normal, sigma, len(candidates.keys))
    scale = float(candidates.scale[candidates.keys.index(key)])
    value, _ = held.linear(law.columns, *bounds(candidates, law.columns))
    best = Fitter(bench, scores, sigma, null, pool, held).fits([(law, value)])[0][law]
    error = abs(float(best.fit.value[0]) * scale - truth)
    assert error < 0.04
    assert error < 0.5 * abs(float(value[0]) * scale - truth)
    assert best.left.total < 0.4 * held.before().total
    assert best.fit.explained > 0.0


def made(rng: np.random.Generator, effect: str | None) -> Trial:
    """A trial in which the true effect leaves a third and others most of the gap."""
    before = float(rng.uniform(4.0, 12.0))
    left = {name: before * float(rng.uniform(0.85, 1.0)) for name in "abcdef"}
    if effect is not None:
        left[effect] = before * float(rng.uniform(0.1, 0.5))
    parts = {name: (x, 0.2 * x, 0.3 * x) for name, x in left.items()}
    gap, fits = (before, 0.2 * before, 0.3 * before), (float(rng.uniform(0.0, 0.9)), 1.0, 0.0)
    return Trial(f"{effect}/same", "gentle", "grass", 1.5, effect, parts, gap, fits, {})


def test_trained_weights_name_causes_they_were_not_trained_on() -> None:
    rng = np.random.default_rng(5)
    trained = train([made(rng, effect) for effect in [*"abc" * 6, *[None] * 8]])
    for effect in [*"def" * 5, *[None] * 10]:
        odds = utilities(made(rng, effect), trained)
        assert max(odds, key=lambda k: odds[k]) == effect


def test_sites_left_out_are_judged_by_the_others() -> None:
    rng = np.random.default_rng(7)
    sites = [[made(rng, effect) for effect in ["a", "b", "c", None, None]] for _ in range(4)]
    known, outside = crossed(sites)
    assert (len(known), len(outside)) == (12, 8)
    assert max(known) < UNKNOWN < min(outside)


def test_trials_and_weights_survive_a_file(tmp_path: Path) -> None:
    import json

    trial, path = made(np.random.default_rng(6), "a"), tmp_path / "site.json"
    path.write_text(json.dumps([dataclasses.asdict(trial)]), encoding="utf-8")
    assert read([path]) == [trial]
    found = train([trial])
    write(tmp_path / "choice.yaml", found, [trial], 1)
    text = (tmp_path / "choice.yaml").read_text(encoding="utf-8")
    assert "1 trials" in text
    assert f"slope: {found.slope:.4g}" in text


def test_weights_of_the_package_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert weights().slope > 0.0
    assert 0.5 < weights().share < 1.5
    assert weights().misfit > 0.0
    assert weights().quieter > 0.0
    (tmp_path / "choice.yaml").write_text("weights: {slope: 1}\n", encoding="utf-8")
    monkeypatch.setattr(choice_module.resources, "files", lambda _: tmp_path)
    weights.cache_clear()
    with pytest.raises(ConfigError, match="weights"):
        weights()
    weights.cache_clear()


def test_development_trials_share_no_draw_with_a_blind_check() -> None:
    kind, soil, trials = site(3)
    assert (kind, soil) == ("gentle", "grass")
    assert site(3)[2] == trials
    here = {spec.seed for number in range(4) for spec in specs(number)}
    checked = plan.plan(0, plan.QUICK)
    there = {spec.seed for trial in checked for spec in plan.specs(trial)}
    assert not here & there
    robots = {spec.robot_seed for spec in specs(3)}
    assert len(robots) == 1
    assert robots.isdisjoint(spec.robot_seed for trial in checked for spec in plan.specs(trial))
