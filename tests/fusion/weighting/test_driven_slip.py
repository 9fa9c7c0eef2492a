"""Slip by ground from the drive itself: the policy's without evidence, the drive's own with it."""

from __future__ import annotations

import numpy as np
import pytest

from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.weighting.driven_slip import DrivenSlip
from terrafusion.twin.model.vehicle import as_vehicle

POLICY = load_policy()
SAND = POLICY.names().index("loose_sand")
ON_SAND = np.eye(len(POLICY.names()))[SAND]
PRIOR, PRIOR_SIGMA, PER_GRADE, TIME_S = POLICY.slips()


def driven(seconds: float, slip: float, sigma: float = 0.01, grade: float = 0.0) -> DrivenSlip:
    """After `seconds` on loose sand with one slip on the level."""
    found = DrivenSlip.of_policy(POLICY)
    for _ in range(round(seconds / 0.5)):
        found.add(ON_SAND, slip + PER_GRADE[SAND] * grade, sigma, grade, 0.5)
    return found


def test_without_evidence_it_is_the_policys_to_the_last_bit() -> None:
    mean, sigma = DrivenSlip.of_policy(POLICY).posterior()
    assert mean.tolist() == PRIOR.tolist()
    assert sigma.tolist() == PRIOR_SIGMA.tolist()
    mixed = np.full(len(PRIOR), 1.0 / len(PRIOR))
    assert POLICY.blend(mixed, 0.1) == POLICY.blend(mixed, 0.1, (mean, sigma, PER_GRADE, TIME_S))


def test_the_longer_a_ground_is_driven_the_more_its_own_slip_counts() -> None:
    own = PRIOR[SAND] + 0.03
    off, spread = [], []
    for seconds in (0.0, 5.0, 20.0, 80.0, 320.0):
        mean, sigma = driven(seconds, own).posterior()
        off.append(own - mean[SAND])
        spread.append(sigma[SAND])
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.005
    assert spread[-1] < 0.4 * PRIOR_SIGMA[SAND]
    assert all(s > abs(o) for s, o in zip(spread, off, strict=True)), "the spread covers what is left"


def test_other_grounds_stay_and_the_grade_is_taken_out() -> None:
    level, uphill = driven(60.0, 0.2).posterior(), driven(60.0, 0.2, grade=0.05).posterior()
    assert level[0][SAND] == pytest.approx(uphill[0][SAND])
    others = np.arange(len(PRIOR)) != SAND
    assert level[0][others].tolist() == PRIOR[others].tolist()
    assert level[1][others].tolist() == PRIOR_SIGMA[others].tolist()


def test_slip_that_is_measured_badly_counts_little_and_slip_that_varies_stays_wide() -> None:
    own = PRIOR[SAND] + 0.06
    good, bad = (driven(5.0, own, sigma).posterior()[0][SAND] for sigma in (0.01, 0.5))
    assert abs(bad - PRIOR[SAND]) < 0.2 * abs(good - PRIOR[SAND])
    varying = DrivenSlip.of_policy(POLICY)
    for k in range(400):
        varying.add(ON_SAND, 0.13 + (0.15 if k % 20 < 10 else -0.15), 0.01, 0.0, 0.5)
    assert varying.posterior()[1][SAND] > 0.12


def test_a_ground_that_the_policy_lacks_shows_its_slip_within_a_minute() -> None:
    """Snow that looks like asphalt: 4 % slip where asphalt has .1 %, each second measured to 3 %."""
    asphalt, rng = POLICY.names().index("asphalt"), np.random.default_rng(3)
    looks_like = np.where(np.arange(len(PRIOR)) == asphalt, 0.9, 0.1 / (len(PRIOR) - 1))
    found = DrivenSlip.of_policy(POLICY)
    for _ in range(80):
        found.add(looks_like, 0.04 + rng.normal(0.0, 0.03), 0.03, 0.0, 0.5)
    mean, sigma = found.posterior()
    assert mean[asphalt] > 0.02
    assert abs(mean[asphalt] - 0.04) < 2.0 * sigma[asphalt]


@pytest.mark.parametrize("slip", [0.0, 0.06, 0.3])
def test_slip_of_half_a_minute_outweighs_that_of_the_class_it_looks_like(slip: float) -> None:
    """The policy's loose sand slips by .13: one that slips otherwise is another ground."""
    assert driven(35.0, slip, 0.02).posterior()[0][SAND] == pytest.approx(slip, abs=0.005)


def test_a_ground_that_is_less_likely_than_another_learns_nothing() -> None:
    found, halves = DrivenSlip.of_policy(POLICY), np.zeros(len(PRIOR))
    halves[:2] = 0.5
    found.add(halves, 0.3, 0.01, 0.0, 60.0)
    assert found.posterior()[0].tolist() == PRIOR.tolist()


@pytest.mark.parametrize("robot", ["elevate", "husky"])
def test_learned_slip_survives_a_dump(robot: str) -> None:
    """Of a robot that the terrain model knows, and the slip that self-calibration learns of another one."""
    config = EstimatorConfig(as_vehicle(robot).rig(), robot)
    estimator = Estimator(config)
    weights = estimator.weights
    if robot == "elevate":
        weights._driven.add(ON_SAND, 0.3, 0.01, 0.0, 200.0)
        weights._slips = weights._driven.posterior()
    else:
        weights.learn_grade_slip(0.1)
        weights.learn_slip(0.07, 0.05, 0.3, 0)
    restored = Estimator.restore(config, estimator.dump()).weights
    for one in (weights, restored):
        one.detector._filter.probabilities[:] = ON_SAND if robot == "elevate" else ON_SAND[::-1]
        one._reweight(0)
    assert restored.noise == weights.noise
    assert restored.noise.slip_mean != Estimator(config).weights.noise.slip_mean


def test_noise_of_an_unknown_ground_leaves_the_posterior_as_it_was() -> None:
    weights = Estimator(EstimatorConfig(as_vehicle("husky").rig(), "husky")).weights
    before = [values.tolist() for values in weights._slips]
    weights.learn_slip(0.3, 0.05, 0.3, 0)
    assert weights.noise.slip_mean == 0.3
    assert [values.tolist() for values in weights._slips] == before


def test_mean_and_spread_are_those_of_two_normals_by_hand() -> None:
    """Two windows of four correlation times, measured as badly as the policy's slip spreads."""
    found, sigma, driven_s = DrivenSlip.of_policy(POLICY), PRIOR_SIGMA[SAND], 8.0 * TIME_S[SAND]
    for off in (0.03, 0.09):
        found.add(ON_SAND, PRIOR[SAND] + off, sigma, 0.0, 0.5 * driven_s)
    mean, spread = (values[SAND] for values in found.posterior())
    between, within = POLICY.fixed.slip_sigma**2, sigma**2 * 2.0 / 3.0
    variance = (
        sigma**2 / driven_s + within * 2.0 / 10.0
    )  # of what was measured: its errors, slip's own changes
    share = between / (between + variance)
    assert mean == pytest.approx(PRIOR[SAND] + 0.06 * share)
    square = 2.0 * 0.03**2  # each window is one observation, half a one for its errors of two
    assert spread == pytest.approx(np.sqrt((4.0 * within + square) / (4.0 + 2.0) + share * variance))
