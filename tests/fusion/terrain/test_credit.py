"""Credit of an external source: lost where wheels and IMU contradict it, kept where they bear it out."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.terrain.credit import SourceCredit

K = 4
PRIOR = np.full(K, 1.0 / K)
UNKNOWN = K - 1


def checked(claims: list[int], seen: list[int], fit: float = 1.0) -> SourceCredit:
    """After a window on ground `seen` a claim; other grounds are `fit` less likely in logarithm."""
    credit = SourceCredit(PRIOR, UNKNOWN)
    for claim, ground in zip(claims, seen, strict=True):
        credit.claim(np.eye(K)[claim])
        credit.check(fit * (np.eye(K)[ground] - 1.0))
    return credit


def test_a_right_source_keeps_its_credit_over_changes_of_ground() -> None:
    ground = [0] * 20 + [1] * 20 + [2] * 20
    assert checked(ground, ground, 3.0).value > 0.94
    late = [0] * 2 + ground[:-2]  # the window ends on the new ground while the label is still the old one
    assert checked(late, ground, 3.0).value > 0.9


def test_grounds_drawn_at_random_lose_it() -> None:
    drawn = np.repeat(np.random.default_rng(0).integers(0, 3, 40), 20).tolist()
    assert checked(drawn, [0] * len(drawn), 3.0).value < 0.01


def test_a_source_that_is_always_wrong_loses_it_within_seconds() -> None:
    assert checked([1] * 8, [0] * 8, 5.0).value < 0.01


def test_what_cannot_be_checked_costs_nothing() -> None:
    trusted = SourceCredit(PRIOR, UNKNOWN).value
    assert trusted == 1.0
    assert checked([UNKNOWN] * 20, [0] * 20, 5.0).value == trusted, "ground that no class describes"
    assert checked([1] * 20, [0] * 20, 0.0).value == trusted, "windows that fit every ground"
    silent = SourceCredit(PRIOR, UNKNOWN)
    silent.check(-np.arange(K, dtype=float))
    assert silent.value == trusted, "no claim"


def test_a_source_that_is_right_again_is_believed_again() -> None:
    wrong, right = [1] * 1000, [0] * 200
    assert checked([*wrong, *right], [0] * 1200, 3.0).value > 0.9


@given(
    st.lists(st.lists(st.floats(0.0, 1.0), min_size=K, max_size=K).filter(lambda q: sum(q) > 0.01)),
    st.lists(st.floats(-1e4, 1e4), min_size=K, max_size=K),
)
def test_it_is_a_share(claims: list[list[float]], log_likelihood: list[float]) -> None:
    credit = SourceCredit(PRIOR, UNKNOWN)
    for claim in claims:
        credit.claim(np.array(claim) / sum(claim))
        credit.check(np.array(log_likelihood))
    assert 0.0 <= credit.value <= 1.0
