"""Slip of the grounds that a robot finds by itself: learned, recognised, carried to the next drive."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.grounds.ground import Ground, Tally
from terrafusion.fusion.weighting.adaptive import TerrainNoise
from terrafusion.fusion.weighting.ground_slip import GroundSlip
from terrafusion.twin.model.vehicle import load_vehicle

WHOLE = (0.05, 0.09, 0.4, 10.0)
"""Mean, 1 sigma, slope over the grade and correlation time (s) of the slip of a whole drive."""


def belief(ground: int, grounds: int = 3) -> np.ndarray:
    """Certain of one ground; 0 is one that was never met."""
    return np.eye(1 + grounds)[ground]


def driven(slips: dict[int, float], seconds: float = 60.0) -> GroundSlip:
    """After driving on each ground for so long, with its slip measured to .02."""
    slip = GroundSlip(*WHOLE)
    for ground, value in slips.items():
        slip.recognise(belief(ground))
        for _ in range(round(seconds / 0.5)):
            slip.learn(value, 0.02, 0.0, 0.5)
    return slip


def remembered(slip: float) -> Ground:
    """A ground of an earlier drive."""
    return dataclasses.replace(
        Ground.new("ground 1"), motion=Tally(np.full(2, 20.0), np.array([slip, 0.0]), np.full(2, 1e-4))
    )


def test_each_ground_has_its_own_slip_and_new_ground_that_of_the_drive() -> None:
    slip = driven({1: 0.0, 2: 0.2})
    for ground, expected in {1: 0.0, 2: 0.2}.items():
        slip.recognise(belief(ground))
        assert slip.mean == pytest.approx(expected, abs=0.04)
        assert slip.sigma < WHOLE[1]
    slip.recognise(belief(0))
    assert (slip.mean, slip.sigma) == WHOLE[:2]


def test_what_was_seen_of_a_ground_says_nothing_of_one_that_takes_its_place() -> None:
    slip = driven({1: 0.0, 2: 0.2})
    slip.clear(1)
    slip.recognise(belief(2))
    assert (slip.mean, slip.sigma) == WHOLE[:2]
    slip.recognise(belief(1))
    assert slip.mean == pytest.approx(0.0, abs=0.04)


def test_the_slip_of_a_grade_is_no_slip_of_the_ground() -> None:
    slip = GroundSlip(*WHOLE)
    slip.recognise(belief(1))
    for _ in range(200):
        slip.learn(0.1 + 0.4 * 0.25, 0.01, 0.25, 0.5)
    slip.recognise(belief(1))
    assert slip.mean == pytest.approx(0.1, abs=0.02)


@given(st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3).filter(lambda p: sum(p) > 0.01))
def test_a_doubtful_ground_has_the_moments_of_the_mixture(shares: list[float]) -> None:
    slip, p = driven({1: 0.0, 2: 0.2}, 20.0), np.array(shares) / sum(shares)
    means, sigmas = np.empty(3), np.empty(3)
    for ground in range(3):
        slip.recognise(belief(ground))
        means[ground], sigmas[ground] = slip.mean, slip.sigma
    slip.recognise(p)
    assert slip.mean == pytest.approx(p @ means, abs=1e-12)
    assert slip.sigma**2 == pytest.approx(p @ (sigmas**2 + (means - p @ means) ** 2), rel=1e-9)


def test_slip_is_renewed_until_it_follows_what_is_expected() -> None:
    slip = driven({1: 0.0, 2: 0.3})
    slip.recognise(belief(1))
    for _ in range(100):
        slip.take_switch()
    assert slip.take_switch() < 0.01
    slip.recognise(np.array([0.0, 0.95, 0.05]))
    assert 0.0 < slip.take_switch() < 0.1
    slip.recognise(belief(2))
    assert slip.take_switch() > 0.9
    assert slip.take_switch() < 0.1


def test_a_ground_of_an_earlier_drive_is_known_from_the_start() -> None:
    slip = GroundSlip(*WHOLE, known=[remembered(0.2)])
    slip.recognise(belief(1))
    assert slip.mean == pytest.approx(0.2)
    assert slip.sigma < WHOLE[1]


def test_a_memory_that_the_drive_contradicts_is_forgotten() -> None:
    """On the ground that was driven, and where other tyres would show, too."""
    slip = GroundSlip(*WHOLE, known=[remembered(0.6), remembered(0.5)])
    slip.recognise(belief(1))
    for _ in range(60):
        slip.learn(0.02, 0.02, 0.0, 0.5)
    slip.recognise(belief(1))
    assert slip.mean == pytest.approx(0.02, abs=0.03)
    slip.recognise(belief(2))
    assert (slip.mean, slip.sigma) == WHOLE[:2]


def test_grounds_that_slip_alike_are_named_together() -> None:
    config = EstimatorConfig(load_vehicle("husky").rig(), "husky")
    noise = TerrainNoise(config)
    assert noise.grounds is not None
    noise.grounds.memory.grounds = [Ground.new(f"ground {i}") for i in (1, 2, 3)]
    noise._ground_slip = driven({1: 0.05, 2: 0.2, 3: 0.06})
    assert noise.found_grounds() == ["ground 1 and ground 3 0.05", "ground 2 0.19"]
    noise._ground_slip = driven({1: 0.05, 3: 0.06})
    assert noise.found_grounds() == []
