"""Scores of a blind check by answers whose figures are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis.strategies import integers

from terrafusion.twin.effects.catalogue import built_in
from terrafusion.twin.gap.blind.plan import (
    D_PRIMES,
    FULL,
    PLAIN,
    plan,
)
from terrafusion.twin.gap.blind.rates import Rate, reliability
from terrafusion.twin.gap.blind.score import score
from terrafusion.twin.gap.blind.verdicts import judge
from tests.studies.blind.sensitivity import Oracle, size_for
from tests.twin.gap.blind import blind_answers as fake

BUILT_IN = tuple(dict.fromkeys(form.effect for form in built_in().values() if form.candidate))


def as_answers(trials: Any, answer: Any) -> dict[str, Any]:
    return {t.trial: {"diagnosis": {"seconds": 1.0, "error": None, "answer": answer(t)}} for t in trials}


def figures(trials: Any, answer: Any) -> dict[str, Any]:
    return dict(score(trials, as_answers(trials, answer))["figures"]["diagnosis"])


def one(setting: str, family: str = "null") -> Any:
    return next(t for t in plan(0, FULL) if (t.setting, t.family) == (setting, family))


def test_the_truth_scores_full_marks() -> None:
    trials = plan(0, FULL)
    scores = score(trials, as_answers(trials, fake.perfect))
    own = scores["figures"]["diagnosis"]
    assert own["crashes"] == []
    for row in scores["headline"]:
        assert row["diagnosis"]["met"] in (True, None), row
    assert own["false_alarms"][PLAIN]["hits"] == own["false_alarms"]["other drives"]["hits"] == 0
    assert {rate["rate"] for rate in own["power_all"].values()} == {1.0}
    assert own["pairs"]["both"]["count"] == FULL.pairs
    for truth, said in own["confusion"].items():
        outside = truth not in (*BUILT_IN, "no_gap")
        assert set(said) == {"unknown" if outside else truth}


def test_guesses_score_at_chance_and_their_confidence_is_honest() -> None:
    """One of 37 first, three of 37 among the first three; stated 1/37, so no calibration error beyond
    chance."""
    found = figures(plan(0, FULL), fake.guessed)
    for family in ("same", "shifted"):
        for places, name in ((1, "top1"), (3, "top3")):
            given_, p = found[name][family], places / 37.0
            assert abs(given_["rate"] - p) < 4.0 * math.sqrt(p * (1.0 - p) / given_["count"])
        assert found["confidence"][family]["ece"] < 0.06
    assert found["false_alarms"][PLAIN]["rate"] == 1.0
    assert found["unknown"]["recall"]["rate"] == 0.0


def test_the_certainty_judged_is_that_of_the_credible_set_as_the_reader_sees_it() -> None:
    """Not that of the causes in it, which may act together."""
    trial = one(PLAIN, "same")
    (effect,) = trial.effects()
    answer = fake.diagnosis("effect", [(effect, 0.5), ("another", 0.5)], [effect, "another"])
    assert judge(trial, as_answers([trial], lambda t: answer)[trial.trial]["diagnosis"]).confidence == 0.5
    answer["sets"] = [{"effects": [effect], "probability": 0.98, "named": True}]
    assert judge(trial, as_answers([trial], lambda t: answer)[trial.trial]["diagnosis"]).confidence == 0.98


def test_a_pair_counts_where_both_effects_are_seen_alone() -> None:
    """An effect that is not even seen alone is no fault of the search for two."""
    trials = plan(0, FULL)
    pairs = [t for t in trials if t.family == "pair"]
    blind_to = next(t.trial for t in trials if t.part_of == pairs[0].trial)

    def overlooks(t: Any) -> Any:
        return fake.diagnosis("no_gap") if t.trial in (blind_to, pairs[0].trial) else fake.perfect(t)

    found = figures(trials, overlooks)["pairs"]
    assert (found["both"]["hits"], found["both"]["count"]) == (len(pairs) - 1, len(pairs) - 1)
    assert found["both_of_all"]["count"] == len(pairs)
    one_alone = [t for t in trials if t.trial != blind_to]  # its other single trial is not there yet
    assert figures(one_alone, fake.perfect)["pairs"]["both"]["count"] == len(pairs) - 1


def test_sizes_are_compared_with_the_truth_in_their_sigma() -> None:
    """By the catalogue's own law; a size by another law has another meaning and is left out."""
    trial = next(t for t in plan(0, FULL) if t.shapes == ("gyro_scale/same",))
    for law, wanted in (("gyro_scale/scale", 1.5), ("gyro_scale/asymmetry", None)):
        answer = fake.diagnosis("effect", [("gyro_scale", 0.9)], ["gyro_scale"])
        answer["causes"][0]["parameters"] = {
            law: {"value": -1.3 * trial.values[0], "sigma": 0.2 * trial.values[0]}
        }
        found = judge(trial, {"seconds": 1.0, "answer": answer}).deviation
        assert found == (None if wanted is None else pytest.approx(wanted))


def test_look_alikes_count_once_and_extras_are_told() -> None:
    pair = one(PLAIN, "pair")
    first, second = pair.effects()
    extra = next(e for e in BUILT_IN if e not in (first, second))
    alike = next(e for e in BUILT_IN if e not in (first, second, extra))
    answer = fake.diagnosis("effect", [(first, 0.4), (extra, 0.3), (alike, 0.2)], [alike, first, extra])
    for cause in answer["causes"]:
        if cause["effect"] in (first, alike):
            cause["class"] = [first, alike]
    judged = judge(pair, {"seconds": 1.0, "error": None, "answer": answer})
    assert (judged.found, judged.extras, judged.rank) == (1, 1, 1)
    assert judged.confidence == pytest.approx(0.6)


@pytest.mark.parametrize("lost", ["causes", "gap", "verdict", "named", "shrink"])
def test_an_answer_that_breaks_the_contract_is_a_crash(lost: str) -> None:
    trial = one(PLAIN, "same")
    answer = fake.perfect(trial)
    answer.pop(lost)
    assert judge(trial, {"seconds": 1.0, "error": None, "answer": answer}).crashed
    assert judge(trial, None).crashed


@given(integers(0, 300), integers(1, 300))
def test_intervals_hold_their_rate(hits: int, more: int) -> None:
    found = Rate(hits, hits + more)
    low, high = found.interval()
    assert 0.0 <= low <= found.hits / found.count <= high <= 1.0


def test_intervals_and_calibration_by_known_figures() -> None:
    """Wilson (1927) at 0 of 10 and 5 of 10; confidence .8 with 3 of 4 right."""
    assert Rate(0, 10).interval()[1] == pytest.approx(0.2775, abs=1e-4)
    assert Rate(5, 10).interval() == pytest.approx((0.2366, 0.7634), abs=1e-4)
    found = reliability([0.8] * 4, [True, True, True, False])
    assert found.ece == pytest.approx(0.05)
    assert found.brier == pytest.approx((3 * 0.04 + 0.64) / 4)


def test_the_oracle_finds_the_detectability_of_a_known_shift() -> None:
    """White noise and one strong common direction: d' is that of the whitened shift, in proportion."""
    rng = np.random.default_rng(0)
    common = np.sin(np.arange(30.0))
    null = rng.normal(size=(400, 30)) + 5.0 * rng.normal(size=(400, 1)) * common
    shift = np.zeros(30)
    shift[7] = 4.0
    covariance = np.eye(30) + np.eye(30) + 25.0 * np.outer(common, common)  # of the runs, and the floors
    oracle = Oracle(null, np.ones(30))
    wanted = math.sqrt(shift @ np.linalg.solve(covariance, shift))
    assert oracle.d_prime(shift) == pytest.approx(wanted, rel=0.1)
    assert oracle.d_prime(2.0 * shift) == pytest.approx(2.0 * oracle.d_prime(shift))
    assert oracle.d_prime(np.zeros(30)) == 0.0
    assert oracle.d_prime(common) < 0.5  # what null runs do by themselves is no sign of an effect


def test_sizes_follow_a_power_law_up_to_the_largest() -> None:
    assert size_for([(2.0, 12.0), (1.0, 3.0)], 27.0, 99.0) == pytest.approx(3.0, rel=1e-3)
    assert size_for([(1.0, 3.0), (2.0, 12.0)], 6.0, 99.0) == pytest.approx(math.sqrt(2.0), rel=1e-3)
    assert size_for([(1.0, 1.0), (2.0, 2.0)], 50.0, 9.0) == 9.0
    bent = [(1.0, 5.0), (2.0, 4.0), (4.0, 30.0)]
    assert sorted(size_for(bent, d, 9.0) for d in D_PRIMES) == [size_for(bent, d, 9.0) for d in D_PRIMES]


def test_a_right_cause_called_unknown_is_not_right() -> None:
    """Ranked first is not enough for the headline; only the verdict differs between the two checks."""
    trials = [t for t in plan(0, FULL) if t.family in ("same", "shifted")]
    for verdict, rate in (("effect", 1.0), ("unknown", 0.0)):
        found = figures(trials, lambda t, v=verdict: fake.diagnosis(v, [(t.effects()[0], 0.9)]))
        assert {found["right"][family]["rate"] for family in ("same", "shifted")} == {rate}
        assert {found["top1"][family]["rate"] for family in ("same", "shifted")} == {1.0}
