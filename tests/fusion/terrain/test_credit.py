"""Credit of an external source: lost where wheels and IMU contradict it, kept where they bear it out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.terrain.classifier import load_terrain_model
from terrafusion.fusion.terrain.detector import SourceCredit, TerrainDetector, Window

K = 4
UNKNOWN = K - 1


def checked(claims: list[int], seen: list[int], fit: float = 1.0) -> SourceCredit:
    """After a window on ground `seen` a claim; other grounds are `fit` less likely in logarithm."""
    credit = SourceCredit(K, UNKNOWN)
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
    trusted = SourceCredit(K, UNKNOWN).value
    assert trusted == 1.0
    assert checked([UNKNOWN] * 20, [0] * 20, 5.0).value == trusted, "ground that no class describes"
    assert checked([1] * 20, [0] * 20, 0.0).value == trusted, "windows that fit every ground"
    silent = SourceCredit(K, UNKNOWN)
    silent.check(-np.arange(K, dtype=float))
    assert silent.value == trusted, "no claim"


def test_a_source_that_is_right_again_is_believed_again() -> None:
    wrong, right = [1] * 1000, [0] * 200
    assert checked([*wrong, *right], [0] * 1200, 3.0).value > 0.9


@pytest.mark.parametrize(
    ("claim", "slip", "believed"),
    [
        ("asphalt", 0.0, True),
        ("asphalt", 0.04, True),
        ("asphalt", 0.15, False),
        ("medium_sand", 0.15, False),
        ("loose_sand", 0.15, True),
        ("loose_sand", 0.0, False),
        ("mud", 0.5, True),
    ],
)
def test_slip_checks_claims_of_any_ground_on_a_robot_that_no_model_knows(
    claim: str, slip: float, believed: bool
) -> None:
    """Ten seconds of one slip, +- 0.02; wheels 4 % too small look like slip on asphalt."""
    names = load_policy().names()
    detector = TerrainDetector(load_terrain_model().for_vehicle("husky"), names)
    none = np.zeros((0, 3))
    window = Window(0.5, none[:, 0], none, none, 1.0, 0.0, 1.0 - slip, None, 0.0, slip, 0.02)
    for _ in range(20):
        detector.credit.claim(np.eye(len(names))[names.index(claim)])
        detector.update(window)
    assert (detector.credit.value > 0.9) == believed
    assert believed or detector.credit.value < 0.15


@given(
    st.lists(st.lists(st.floats(0.0, 1.0), min_size=K, max_size=K).filter(lambda q: sum(q) > 0.01)),
    st.lists(st.floats(-1e4, 1e4), min_size=K, max_size=K),
)
def test_it_is_a_share(claims: list[list[float]], log_likelihood: list[float]) -> None:
    credit = SourceCredit(K, UNKNOWN)
    for claim in claims:
        credit.claim(np.array(claim) / sum(claim))
        credit.check(np.array(log_likelihood))
    assert 0.0 <= credit.value <= 1.0
