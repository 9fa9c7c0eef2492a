"""The uncertainty of the gyro's scale in the noise of the heading."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from terrafusion.fusion.calibration.numbers import GNSS_DELAY, NUMBERS, TURN_SCALE, Knowledge
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.learned_numbers import TURN_TIME_S, with_turn_doubt
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.noise.policy import SensorNoise, load_policy
from terrafusion.twin.model.vehicle import load_vehicle

SCALE_SIGMA, RATE_RADPS, STEP_S = 0.02, 0.3, 0.1
IMU = load_vehicle("husky").rig().sensors.imu


def noise() -> SensorNoise:
    return dataclasses.replace(load_policy().fixed, gyro_yaw_inflation=1.0)


def known() -> Knowledge:
    variance = np.zeros(len(NUMBERS))
    variance[TURN_SCALE] = SCALE_SIGMA**2
    return Knowledge(np.zeros(len(NUMBERS)), np.diag(variance), 0.05)


def added_density(unaided_s: float, rate_radps: float = RATE_RADPS) -> float:
    """Density, rad/s/sqrt(Hz), by which the doubt widens the noise of the yaw rate."""
    segment = ImuSegment(STEP_S, np.array([0.0, 0.0, rate_radps]), np.zeros(3), False, False)
    widened = with_turn_doubt(noise(), known(), [segment], IMU, unaided_s).gyro_yaw_inflation
    return IMU.gyro_noise_radps_sqrthz * math.sqrt(widened**2 - 1.0)


@pytest.mark.parametrize("seconds", [1.0, 3.0, 5.0])
def test_the_variance_of_a_steady_turn_is_that_of_its_scale(seconds: float) -> None:
    times = STEP_S * np.arange(1, round(seconds / STEP_S) + 1)
    variance = sum(added_density(t - 0.5 * STEP_S) ** 2 * STEP_S for t in times)
    assert math.sqrt(variance) == pytest.approx(SCALE_SIGMA * RATE_RADPS * seconds, rel=0.02)


def test_there_is_no_doubt_at_a_fix_or_on_a_straight() -> None:
    assert added_density(0.0) == 0.0
    assert added_density(60.0, rate_radps=0.0) == 0.0


def test_the_doubt_is_bounded_where_no_fix_was_used() -> None:
    assert added_density(math.inf) == pytest.approx(SCALE_SIGMA * RATE_RADPS * math.sqrt(TURN_TIME_S))


@pytest.mark.parametrize(("sigma_s", "corrected_s"), [(0.15, 0.0), (0.1, 0.4)])
def test_a_delay_corrects_from_three_of_its_sigmas_on(sigma_s: float, corrected_s: float) -> None:
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, sigma = prior.mean.copy(), prior.sigma
    mean[GNSS_DELAY], sigma[GNSS_DELAY] = 0.4, sigma_s
    estimator.learned._apply(Knowledge(mean, np.diag(sigma**2), 0.03), 1)
    assert estimator.gnss.delay_s == pytest.approx(corrected_s)
