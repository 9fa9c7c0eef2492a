"""Verdicts are computed by rules that say what they decide by."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import ConfigError
from tests.studies.source_study.claims import (
    AGREE,
    BASES,
    DISAGREE,
    NOT_EXAMINED,
    PARTLY,
    PREDICTED,
    Claim,
    Criterion,
    counts,
    judge,
    load_claims,
)
from tests.studies.source_study.published import CASES
from tests.studies.source_study.spread import Spread, spread
from tests.studies.source_study.study import StudyPlan, run_study
from tests.studies.source_study.text import COLUMNS, markdown_rows


def runs(*values: float) -> Spread:
    return spread(values)


A_RULE = Criterion("at_least", (1, 0.5))


@pytest.mark.parametrize(
    ("rule", "found", "verdict"),
    [
        (Criterion("near", (60.0, 10.0, 20.0)), runs(51.0), AGREE),
        (Criterion("near", (60.0, 10.0, 20.0)), runs(79.0), PARTLY),
        (Criterion("near", (60.0, 10.0, 20.0)), runs(81.0), DISAGREE),
        (Criterion("at_least", (5.0, 2.0)), runs(5.0), AGREE),
        (Criterion("at_least", (5.0, 2.0)), runs(4.9), PARTLY),
        (Criterion("at_least", (5.0, 2.0)), runs(1.0), DISAGREE),
        (Criterion("at_most", (5.0, 10.0)), runs(5.0), AGREE),
        (Criterion("at_most", (5.0, 10.0)), runs(11.0), DISAGREE),
        (Criterion("published", (27.0,)), runs(29.0), AGREE),
        (Criterion("published", (27.0,)), runs(14.0), PARTLY),
        (Criterion("published", (27.0,)), runs(13.0), DISAGREE),
        (Criterion("published", (2.0,)), runs(2.9), AGREE),
        (Criterion("published", (9.0,)), runs(2.0, 4.0, 20.0), AGREE),
        (Criterion("published", (9.0,)), runs(4.0, 4.1), DISAGREE),
        (Criterion("near", (1, 1, 1)), runs(math.nan), DISAGREE),
        (Criterion("at_least", (0, 0)), runs(math.nan), DISAGREE),
        (Criterion("at_most", (1, 1)), runs(math.nan), DISAGREE),
        (Criterion("published", (1,)), runs(math.nan), DISAGREE),
    ],
)
def test_verdicts(rule: Criterion, found: Spread, verdict: str) -> None:
    assert rule.verdict(found) == verdict


@given(st.floats(-100, 100), st.floats(0, 10), st.floats(0, 10), st.floats(-1000, 1000))
def test_agreement_is_never_worse_nearer_to_the_study(
    target: float, agree: float, more: float, found: float
) -> None:
    rule, order = Criterion("near", (target, agree, agree + more)), [AGREE, PARTLY, DISAGREE]
    nearer = target + 0.5 * (found - target)
    assert order.index(rule.verdict(runs(nearer))) <= order.index(rule.verdict(runs(found)))


def test_a_rule_tells_its_own_numbers() -> None:
    assert Criterion("near", (60, 10, 20)).words("s") == "within 10 s (partly: 20 s)"
    assert Criterion("near", (60, 10, 20)).wanted("s") == "60 s"
    assert Criterion("at_most", (0, 0)).words("of 17") == "at most 0 of 17"
    assert "10 %" in Criterion("published", (27.0,)).words("%")


def test_the_reason_told_is_that_of_the_verdict() -> None:
    claim = Claim("Tab. 1", "it is so", "so", "so", A_RULE, why="because", why_not="although")
    (good,), (bad,) = judge([claim], {"so": runs(2.0)}), judge([claim], {"so": runs(0.7)})
    assert (good.verdict, good.why) == (AGREE, "because")
    assert (bad.verdict, bad.why) == (PARTLY, "although")
    (unseen,) = judge([dataclasses.replace(claim, why_not="")], {"so": runs(0.0)})
    assert (unseen.verdict, unseen.why) == (DISAGREE, NOT_EXAMINED)
    assert counts([good, bad]) == {AGREE: 1, PARTLY: 1, DISAGREE: 0}
    assert counts([good, bad], "calibrated") == {AGREE: 0, PARTLY: 0, DISAGREE: 0}


def test_a_claim_about_nothing_measured_is_an_error() -> None:
    with pytest.raises(KeyError):
        judge([Claim("Tab. 1", "it is so", "so", "so", A_RULE)], {})


def test_every_number_of_table_4_is_claimed_and_every_claim_is_whole() -> None:
    claims = load_claims()
    published = [c.criterion.numbers[0] for c in claims if c.criterion.rule == "published"]
    for case in CASES:
        assert published.count(case.gnss) == 2
        for number in (case.slip, case.odometry, case.imu):
            assert number in published
    assert len({(claim.statement, claim.quantity) for claim in claims}) == len(claims)
    for claim in claims:
        assert claim.basis in BASES
        assert claim.why, claim
    assert sum(claim.basis == PREDICTED for claim in claims) > len(claims) / 2


def test_a_table_in_markdown_has_all_columns() -> None:
    claim = Claim("Tab. 1", "mean |s|", "so", "so", A_RULE, why="because")
    head, rule, row = markdown_rows(judge([claim], {"so": runs(2.0)}))
    assert head.count("|") == rule.count("|") == len(COLUMNS) + 1
    assert "mean \\|s\\|" in row


@pytest.mark.parametrize("seeds", [0, 1001])
def test_a_number_of_seeds_out_of_range_is_refused(seeds: int) -> None:
    with pytest.raises(ConfigError, match="seeds"):
        run_study(StudyPlan(seeds=seeds))
