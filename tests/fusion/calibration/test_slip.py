"""Spread and correlation time of slip, as the nodes of a drive with fixes show them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.calibration.motion import MotionSegment
from terrafusion.fusion.calibration.numbers import Knowledge, assumed
from terrafusion.fusion.calibration.online import SelfCalibration
from terrafusion.fusion.calibration.reduction import Noise
from terrafusion.fusion.calibration.slip import PRIOR_PAIRS, SlipMoments, slip_process
from tests.fusion.calibration.nodes import node_starts
from tests.fusion.calibration.test_online import driven

STEP_S, ASSUMED_S = 0.1, 300.0
NOISE = Noise(yaw_density_radps=1e-3, turn_share=0.0, drift_share=0.0, drift_time_s=60.0)
PRIOR = assumed(0.005, yaw_of_wheels=False, slip_spread=0.03, slip_time_s=ASSUMED_S)


def drive(
    time_s: float, spread: float, seed: int, fix_sigma_m: float = 0.01, seconds: float = 600.0
) -> MotionSegment:
    """Winding at 1 m/s, with slip as a Gauss-Markov process."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, STEP_S)
    keep = math.exp(-STEP_S / time_s)
    slip: Array = np.zeros(len(t) - 1)
    slip[0] = spread * rng.normal()
    for i in range(1, len(slip)):
        slip[i] = keep * slip[i - 1] + spread * math.sqrt(1.0 - keep**2) * rng.normal()
    turn = 0.4 * np.sin(0.17 * t[1:]) * STEP_S
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    z = np.concatenate([[0j], np.cumsum(STEP_S * np.exp(1j * 0.5 * (yaw[1:] + yaw[:-1])))])
    stamps = np.arange(1.0, seconds - 1.0, 0.5)
    fix = np.interp(stamps, t, z.real) + 1j * np.interp(stamps, t, z.imag)
    fix = fix + fix_sigma_m * (rng.normal(size=len(fix)) + 1j * rng.normal(size=len(fix)))
    distance = STEP_S / (1.0 + slip)
    sigma = np.full(len(fix), fix_sigma_m)
    return MotionSegment(t, distance, turn, stamps, fix, sigma, 0j, node_starts(t, distance, fix_sigma_m))


def learned(given: MotionSegment) -> Knowledge:
    return driven(given, SelfCalibration(PRIOR, NOISE, 0j))[-1]


@pytest.mark.parametrize(("time_s", "spread"), [(3.0, 0.1), (10.0, 0.08)])
def test_the_time_of_slip_that_comes_and_goes_is_found(time_s: float, spread: float) -> None:
    found = [learned(drive(time_s, spread, seed)) for seed in range(5)]
    assert np.median([one.slip_time_s for one in found]) == pytest.approx(time_s, rel=0.5)
    assert np.median([one.slip_spread for one in found]) == pytest.approx(spread, rel=0.3)


def test_where_fixes_hardly_tell_slip_it_lasts_longer_than_any_node() -> None:
    assert learned(drive(3.0, 0.01, 1, fix_sigma_m=1.0, seconds=200.0)).slip_time_s > 0.15 * ASSUMED_S


def test_without_neighbours_both_are_as_assumed() -> None:
    nothing = SlipMoments(0, 0.0, 0.0, 0.0, 0.0)
    assert slip_process([nothing], 0.05, ASSUMED_S) == (pytest.approx(0.05), ASSUMED_S)


def test_the_correlation_is_that_of_the_prior_and_of_what_is_told_by_hand() -> None:
    moments = SlipMoments(nodes=9, squares=9 * 0.04, products=8 * 0.02, known=8.0, apart_s=40.0)
    spread, time_s = slip_process([moments], 0.2, 50.0)
    assert spread == pytest.approx(0.2)
    expected = (PRIOR_PAIRS * math.exp(-5.0 / 50.0) + 8 * 0.02 / 0.04) / (PRIOR_PAIRS + 8.0)
    assert math.exp(-5.0 / time_s) == pytest.approx(expected)
    opposite = dataclasses.replace(moments, products=-2.0)
    assert slip_process([opposite], 0.2, 50.0)[1] == pytest.approx(2.5)
