"""The uncertainty of the gyro's scale in the noise of the heading."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest

from terrafusion.fusion.calibration.numbers import (
    ANTENNA_X,
    COURSE_LAG,
    GNSS_DELAY,
    IMITATED,
    NUMBERS,
    SKIDDING_LAG_SIGMA_S,
    TURN_SCALE,
    WHEEL_DELAY,
    WHEEL_SCALE,
    Knowledge,
    assumed,
)
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.learned_numbers import (
    SKID_DETECTION_NS,
    TURN_TIME_S,
    KnownBeforeSkid,
    _doubt_place,
    with_turn_doubt,
)
from terrafusion.fusion.estimator.mean_motion import MeanMotion
from terrafusion.fusion.inputs.streams import ImuSegment
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.fusion.noise.policy import SensorNoise, load_policy
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.simulate import simulate

SCALE_SIGMA, RATE_RADPS, STEP_S = 0.02, 0.3, 0.1
IMU = load_vehicle("husky").rig().sensors.imu


def noise() -> SensorNoise:
    return dataclasses.replace(load_policy().fixed, gyro_yaw_inflation=1.0)


def added_density(unaided_s: float, rate_radps: float = RATE_RADPS) -> float:
    """Density, rad/s/sqrt(Hz), by which the doubt widens the noise of the yaw rate."""
    segment = ImuSegment(STEP_S, np.array([0.0, 0.0, rate_radps]), np.zeros(3), False, False)
    widened = with_turn_doubt(noise(), SCALE_SIGMA, [segment], IMU, unaided_s).gyro_yaw_inflation
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


def test_a_scale_that_seems_wrong_and_is_not_corrected_is_doubted_by_as_much() -> None:
    learned = Estimator.for_vehicle("husky", "fixed").learned
    segments = [ImuSegment(STEP_S, np.array([0.0, 0.0, RATE_RADPS]), np.zeros(3), False, False)]
    mean, variance = np.zeros(len(NUMBERS)), np.full(len(NUMBERS), 1e-12)
    mean[TURN_SCALE], variance[TURN_SCALE] = 0.04, 0.03**2
    learned._known = Knowledge(mean, np.diag(variance), 0.05, 300.0)
    doubt = with_turn_doubt(noise(), 0.05, segments, IMU, math.inf)
    assert learned.with_doubt(noise(), 0, segments).gyro_yaw_inflation == doubt.gyro_yaw_inflation


@pytest.mark.parametrize(("sigma_s", "corrected_s"), [(0.12, 0.0), (0.09, 0.4)])
def test_a_delay_corrects_from_four_of_its_sigmas_on(sigma_s: float, corrected_s: float) -> None:
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, sigma = prior.mean.copy(), prior.sigma.copy()
    mean[GNSS_DELAY], sigma[GNSS_DELAY] = 0.4, sigma_s
    estimator.learned._apply(Knowledge(mean, np.diag(sigma**2), 0.03, 300.0), 1)
    assert estimator.gnss.delay_s == pytest.approx(corrected_s)


@pytest.mark.parametrize(("misfit", "corrected_s"), [(1.0, 0.5), (3.0, 0.5), (5.0, 0.0)])
def test_a_delay_of_wheels_that_skid_is_corrected_beyond_what_their_slip_imitates(
    misfit: float, corrected_s: float
) -> None:
    """Fixes that lie far from a path by rolling wheels show slip, which looks like a delay."""
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, sigma = prior.mean.copy(), prior.sigma.copy()
    mean[GNSS_DELAY], sigma[GNSS_DELAY] = 0.5, 0.02
    estimator.learned._apply(Knowledge(mean, np.diag(sigma**2), 0.03, 300.0, misfit), 1)
    assert estimator.gnss.delay_s == pytest.approx(corrected_s)


def test_a_delay_is_not_corrected_by_what_the_antenna_explains() -> None:
    """Given an antenna at its nominal place, the fixes would be .35 s late; by both together they are not."""
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, covariance = prior.mean.copy(), prior.covariance.copy()
    mean[ANTENNA_X], mean[GNSS_DELAY] = -0.12, 0.1
    covariance[ANTENNA_X, ANTENNA_X], covariance[GNSS_DELAY, GNSS_DELAY] = 0.02**2, 0.05**2
    covariance[ANTENNA_X, GNSS_DELAY] = covariance[GNSS_DELAY, ANTENNA_X] = 0.9 * 0.02 * 0.05
    estimator.learned._apply(Knowledge(mean, covariance, 0.03, 300.0), 1)
    assert estimator.gnss.delay_s == 0.0


def test_a_delay_is_not_made_larger_by_wheels_that_slip_less_than_they_seem_to() -> None:
    """Wheels that slip while they accelerate are early: that they do not is no assumption of a delay."""
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, covariance = prior.mean.copy(), prior.covariance.copy()
    mean[GNSS_DELAY], mean[WHEEL_DELAY] = 0.3, -0.15
    covariance[GNSS_DELAY, GNSS_DELAY] = covariance[WHEEL_DELAY, WHEEL_DELAY] = 0.05**2
    covariance[GNSS_DELAY, WHEEL_DELAY] = covariance[WHEEL_DELAY, GNSS_DELAY] = 0.8 * 0.05**2
    estimator.learned._apply(Knowledge(mean, covariance, 0.03, 300.0), 1)
    assert estimator.gnss.delay_s == pytest.approx(0.3)


def test_a_stated_sigma_holds_what_slip_imitates_but_no_more_than_was_known() -> None:
    before = assumed(0.0, False, 0.05, 300.0)
    exact = Knowledge(before.mean, 1e-12 * np.eye(len(NUMBERS)), 0.05, 300.0)
    assert exact.stated_sigma(before) == pytest.approx(np.minimum(IMITATED, before.sigma), abs=1e-5)
    told = Knowledge(before.mean, np.diag(np.full(len(NUMBERS), 1e-3) ** 2), 0.05, 300.0)
    assert (exact.stated_sigma(told) <= told.sigma).all()


@pytest.fixture(scope="module")
def driving() -> Estimator:
    """An estimator in the middle of a drive."""
    run, estimator = (
        simulate("figure_eight", terrain="asphalt", seed=4),
        Estimator.for_vehicle("elevate", "fixed"),
    )
    for message in run.messages():
        if message.t_ns > run.start_ns + 20_000_000_000:
            break
        estimator.add(message)
    return estimator


def test_fixes_may_move_the_place_by_what_a_new_delay_and_antenna_shift_them(driving: Estimator) -> None:
    before = driving.chain.covariance[3:5, 3:5]
    _doubt_place(driving.chain, 0.5)
    assert driving.chain.covariance[3:5, 3:5] - before == pytest.approx(0.25 * np.eye(2), abs=1e-6)


def test_a_slide_takes_back_only_what_was_learned_since_it_began(driving: Estimator) -> None:
    learned, now_ns = driving.learned, driving.chain.nodes[-1].t_ns
    assert learned.calibration is not None
    assert learned._untouched(driving.chain, learned.calibration) is learned.calibration.before
    sure, late = (dataclasses.replace(learned.calibration.before, slip_spread=s) for s in (0.01, 0.02))
    for t_ns, known in ((now_ns - SKID_DETECTION_NS, sure), (now_ns, late)):
        learned._before_skid.learned(t_ns, known)
    assert learned._untouched(driving.chain, learned.calibration) is sure


@pytest.mark.parametrize("by_rejection", [False, True])
def test_learning_goes_on_where_only_the_drift_moves_as_in_a_skid(
    driving: Estimator, monkeypatch: pytest.MonkeyPatch, by_rejection: bool
) -> None:
    """Late fixes look like that: learning explains them, if it is not stopped."""
    learned, skid = driving.learned, driving.gnss.skid
    assert learned.calibration is not None
    monkeypatch.setattr(learned.calibration, "drive", lambda *_: None)
    monkeypatch.setattr(learned, "_before_skid", KnownBeforeSkid())
    monkeypatch.setattr(skid, "rate_m2ps", 0.5)
    monkeypatch.setattr(skid, "by_rejection", by_rejection)
    learned._drive(learned.calibration, driving.chain, MeanMotion(0.1, 0.1, 0.0, np.zeros(3), np.zeros(3)))
    assert (learned._before_skid.held is not None) == by_rejection


def test_learning_begins_again_from_what_was_known_before_a_wrong_heading(
    driving: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned, begun = driving.learned, list[Knowledge | None]()
    assert learned.calibration is not None
    monkeypatch.setattr(learned.calibration, "restart", begun.append)
    monkeypatch.setattr(learned, "_known", dataclasses.replace(learned._known, slip_spread=0.3))
    monkeypatch.setattr(learned, "_before_skid", KnownBeforeSkid())
    learned._before_skid.learned(0, learned._known)
    learned.heading_turned()
    assert begun == [learned.calibration.before]
    assert learned._known is learned.calibration.before
    assert learned._before_skid.at(2 * SKID_DETECTION_NS, learned.calibration.before) is begun[0]


def test_the_height_of_a_fix_says_nothing_of_its_place(
    driving: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = list[float]()
    monkeypatch.setattr(
        driving.learned.calibration, "fix", lambda t_ns, enu_m, sigma_m: taken.append(sigma_m)
    )
    driving.learned.fix(GnssFix(1, np.zeros(3), np.array([0.02, 0.03, 5.0])))
    assert taken == [0.03]


def test_numbers_known_before_the_drive_explain_no_slide(
    driving: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned, mean = driving.learned, driving.learned._rule.before.mean.copy()
    mean[ANTENNA_X] += 0.5
    known = Knowledge(mean, 1e-6 * np.eye(len(NUMBERS)), 0.03, 300.0, misfit=2.0)
    assert learned.calibration is not None
    for holder, name in ((learned._rule, "before"), (learned.calibration, "known")):
        monkeypatch.setattr(holder, name, known)
    assert not learned._explained(learned.calibration)


@pytest.mark.parametrize(
    ("number", "off", "misfit", "turned_rad", "explained"),
    [
        (ANTENNA_X, 0.25, 2.0, 0.0, True),
        (TURN_SCALE, 0.02, 2.0, 0.0, True),
        (GNSS_DELAY, 0.35, 2.0, 0.0, True),
        (ANTENNA_X, 0.1, 2.0, 6.0, False),  # as slip in turns
        (GNSS_DELAY, 0.25, 2.0, 0.0, False),  # as wheels that spin on ice
        (GNSS_DELAY, 0.25, 2.0, 6.0, True),  # which are no later in turns
        (GNSS_DELAY, 0.1, 2.0, 6.0, False),
        (ANTENNA_X, 0.25, 100.0, 6.0, False),  # the fixes lie elsewhere
        (WHEEL_SCALE, 0.2, 2.0, 6.0, False),  # corrects nothing that looks like a slide
    ],
)
def test_numbers_that_the_drive_shows_explain_what_looks_like_a_slide(
    driving: Estimator, number: int, off: float, misfit: float, turned_rad: float, explained: bool
) -> None:
    """A slide takes back what was learned, numbers of a robot with rolling wheels do not."""
    learned, before = driving.learned, driving.learned._rule.before
    mean = before.mean.copy()
    mean[number] += off
    learning = driving.learned.calibration
    assert learning is not None
    was = learning.known, learning.turned_rad
    learning.known = Knowledge(mean, 1e-6 * np.eye(len(NUMBERS)), 0.03, 300.0, misfit)
    learning.turned_rad = turned_rad
    assert learned._explained(learning) is explained
    learning.known = dataclasses.replace(learning.known, slip_spread=0.2)
    assert not learned._explained(learning)
    learning.known, learning.turned_rad = was


@pytest.mark.parametrize(("lag_s", "spread", "taken_s"), [(0.2, 0.03, 0.2), (0.2, 0.3, 0.0)])
def test_the_course_of_wheels_that_slip_is_not_taken_to_lag(
    driving: Estimator, monkeypatch: pytest.MonkeyPatch, lag_s: float, spread: float, taken_s: float
) -> None:
    mean = driving.learned._rule.before.mean.copy()
    mean[COURSE_LAG] = lag_s
    known = Knowledge(mean, 1e-6 * np.eye(len(NUMBERS)), spread, 300.0)
    monkeypatch.setattr(driving.learned, "_known", known)
    assert driving.learned.course_lag_s()[0] == taken_s


def test_only_robots_that_skid_have_a_course_lag_that_changes_with_the_ground() -> None:
    husky = load_vehicle("husky")
    for drive, skids in (
        ("skid_steer", True),
        ("tracked", True),
        ("differential", False),
        ("ackermann", False),
    ):
        config = EstimatorConfig(dataclasses.replace(husky.rig(), drive=drive), husky.name)
        assert (Estimator(config).learned.course_lag_s()[1] > 0.0) is skids


@pytest.mark.parametrize(("spread", "off_s"), [(0.03, 0.0), (0.3, 0.2)])
def test_a_course_lag_is_doubted_by_its_sigma_and_by_what_is_not_corrected(
    spread: float, off_s: float
) -> None:
    learned = Estimator.for_vehicle("husky").learned
    mean, covariance = learned._rule.before.mean.copy(), learned._rule.before.covariance
    mean[COURSE_LAG] = 0.2
    learned._known = Knowledge(mean, covariance, spread, 300.0)
    assert np.sqrt(learned.place_moments()[-1]) == pytest.approx(np.hypot(SKIDDING_LAG_SIGMA_S, off_s))


def test_the_doubt_of_a_place_is_computed_only_where_a_number_has_changed() -> None:
    learned = Estimator.for_vehicle("husky").learned
    moments = [learned.place_moments()]
    assert learned.place_moments() is moments[0]
    learned._gnss.correct(0, np.array([0.1, 0.0]), 0.0)
    moments.append(learned.place_moments())
    learned._gnss.correct(0, np.array([0.1, 0.0]), 0.2)
    moments.append(learned.place_moments())
    learned._known = dataclasses.replace(learned._known, covariance=2.0 * learned._known.covariance)
    moments.append(learned.place_moments())
    for before, after in itertools.pairwise(moments):
        assert (before != after).any()


def test_an_estimator_that_learns_nothing_of_its_sensors_takes_them_for_exact() -> None:
    config = EstimatorConfig(load_vehicle("husky").rig(), "husky", self_calibrate=False)
    assert not Estimator(config).learned.place_moments().any()


@pytest.mark.parametrize(("misfit", "likely"), [(1.0, True), (8.0, False)])
def test_a_delay_that_skidding_wheels_may_imitate_is_not_likely(misfit: float, likely: bool) -> None:
    """The verdict doubts fixes that are late by two sigma and more."""
    estimator = Estimator.for_vehicle("elevate", "fixed")
    prior = estimator.learned.calibration.prior  # type: ignore[union-attr]
    mean, sigma = prior.mean.copy(), prior.sigma.copy()
    mean[GNSS_DELAY], sigma[GNSS_DELAY] = -0.16, 0.06
    estimator.learned._known = Knowledge(mean, np.diag(sigma**2), 0.03, 300.0, misfit)
    late = estimator.learned.corrections().uncorrected_delay_s
    assert late is not None
    assert late[0] == pytest.approx(-0.16)
    assert (abs(late[0]) > 2.0 * late[1]) == likely
