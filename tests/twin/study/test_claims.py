"""Verdicts are computed by rules that say what they decide by."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.study.claims import (
    AGREE,
    BASES,
    DISAGREE,
    NOT_EXAMINED,
    PARTLY,
    PREDICTED,
    AtLeast,
    AtMost,
    Claim,
    Criterion,
    Near,
    Published,
    counts,
    judge,
    load_claims,
)
from terrafusion.twin.study.published import CASES
from terrafusion.twin.study.spread import Spread, spread
from terrafusion.twin.study.study import StudyPlan, run_study
from terrafusion.twin.study.text import COLUMNS, markdown_rows


def runs(*values: float) -> Spread:
    return spread(values)


@pytest.mark.parametrize(
    ("rule", "found", "verdict"),
    [
        (Near(60.0, 10.0, 20.0), runs(51.0), AGREE),
        (Near(60.0, 10.0, 20.0), runs(79.0), PARTLY),
        (Near(60.0, 10.0, 20.0), runs(81.0), DISAGREE),
        (AtLeast(5.0, 2.0), runs(5.0), AGREE),
        (AtLeast(5.0, 2.0), runs(4.9), PARTLY),
        (AtLeast(5.0, 2.0), runs(1.0), DISAGREE),
        (AtMost(5.0, 10.0), runs(5.0), AGREE),
        (AtMost(5.0, 10.0), runs(11.0), DISAGREE),
        (Published(27.0), runs(29.0), AGREE),
        (Published(27.0), runs(14.0), PARTLY),
        (Published(27.0), runs(13.0), DISAGREE),
        (Published(2.0), runs(2.9), AGREE),
        (Published(9.0), runs(2.0, 4.0, 20.0), AGREE),
        (Published(9.0), runs(4.0, 4.1), DISAGREE),
        *(
            (rule, runs(math.nan), DISAGREE)
            for rule in (Near(1, 1, 1), AtLeast(0, 0), AtMost(1, 1), Published(1))
        ),
    ],
)
def test_verdicts(rule: Criterion, found: Spread, verdict: str) -> None:
    assert rule.verdict(found) == verdict


@given(st.floats(-100, 100), st.floats(0, 10), st.floats(0, 10), st.floats(-1000, 1000))
def test_agreement_is_never_worse_nearer_to_the_study(
    target: float, agree: float, more: float, found: float
) -> None:
    rule, order = Near(target, agree, agree + more), [AGREE, PARTLY, DISAGREE]
    nearer = target + 0.5 * (found - target)
    assert order.index(rule.verdict(runs(nearer))) <= order.index(rule.verdict(runs(found)))


def test_a_rule_tells_its_own_numbers() -> None:
    assert Near(60, 10, 20).words("s") == "within 10 s (partly: 20 s)"
    assert Near(60, 10, 20).wanted("s") == "60 s"
    assert AtMost(0, 0).words("of 17") == "at most 0 of 17"
    assert "10 %" in Published(27.0).words("%")


def test_the_reason_told_is_that_of_the_verdict() -> None:
    claim = Claim("Tab. 1", "it is so", "so", "so", AtLeast(1, 0.5), why="because", why_not="although")
    (good,), (bad,) = judge([claim], {"so": runs(2.0)}), judge([claim], {"so": runs(0.7)})
    assert (good.verdict, good.why) == (AGREE, "because")
    assert (bad.verdict, bad.why) == (PARTLY, "although")
    (unseen,) = judge([dataclasses.replace(claim, why_not="")], {"so": runs(0.0)})
    assert (unseen.verdict, unseen.why) == (DISAGREE, NOT_EXAMINED)
    assert counts([good, bad]) == {AGREE: 1, PARTLY: 1, DISAGREE: 0}
    assert counts([good, bad], "calibrated") == {AGREE: 0, PARTLY: 0, DISAGREE: 0}


def test_a_claim_about_nothing_measured_is_an_error() -> None:
    with pytest.raises(KeyError):
        judge([Claim("Tab. 1", "it is so", "so", "so", AtLeast(1, 0.5))], {})


def test_every_number_of_table_4_is_claimed_and_every_claim_is_whole() -> None:
    claims = load_claims()
    published = [claim.criterion.target for claim in claims if isinstance(claim.criterion, Published)]
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
    claim = Claim("Tab. 1", "mean |s|", "so", "so", AtLeast(1, 0.5), why="because")
    head, rule, row = markdown_rows(judge([claim], {"so": runs(2.0)}))
    assert head.count("|") == rule.count("|") == len(COLUMNS) + 1
    assert "mean \\|s\\|" in row


@pytest.mark.parametrize("seeds", [0, 1001])
def test_a_number_of_seeds_out_of_range_is_refused(seeds: int) -> None:
    with pytest.raises(ConfigError, match="seeds"):
        run_study(StudyPlan(seeds=seeds))
