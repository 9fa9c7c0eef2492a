"""The study's post-processing and measures, on cases whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu
from terrafusion.twin.analysis.speeds import differenced_speed, imu_speed, low_pass, match
from terrafusion.twin.simulate import simulate
from tests.studies.source_study import measures
from tests.studies.source_study import profiles as processing
from tests.studies.source_study.cases import UNEVEN, CaseRun, run_case
from tests.studies.source_study.gnss_noise import NoiseFit, NoisyRun, fit_noise, mean_error, rate_for
from tests.studies.source_study.profiles import Profiles
from tests.studies.source_study.published import CASES, platform_figures
from tests.studies.source_study.spread import spread

MUD, LOOSE, MEDIUM = CASES


@pytest.fixture(scope="module")
def mud() -> CaseRun:
    return run_case(MUD, 0)


@pytest.fixture(scope="module")
def medium() -> CaseRun:
    return run_case(MEDIUM, 0)


def profiles(truth: np.ndarray, odometry: np.ndarray) -> Profiles:
    """Arrays at 50 Hz with nothing but the true and the odometry speed."""
    t_s = np.arange(len(truth)) * 0.02
    nothing = np.full(len(truth), np.nan)
    return Profiles(t_s, truth, truth, odometry, nothing, nothing, nothing, nothing, nothing)


def test_streams_are_matched_within_50_ms() -> None:
    found = match(np.array([0.0, 0.2]), np.array([1.0, 2.0]), np.array([0.0, 0.05, 0.06, 0.15, 0.251]))
    np.testing.assert_array_equal(found, [1.0, 1.0, np.nan, 2.0, np.nan])


def test_low_pass_keeps_the_profile_in_place_and_takes_vibration_away() -> None:
    t_s = np.arange(3000) / 100.0
    slow, fast = np.sin(2 * np.pi * 0.05 * t_s), np.sin(2 * np.pi * 10.0 * t_s)
    inner = slice(300, -300)
    np.testing.assert_allclose(low_pass(t_s, 1.0 + slow)[inner], 1.0 + slow[inner], atol=1e-3)
    assert np.abs(low_pass(t_s, fast)[inner]).max() < 1e-3


def test_slip_proxy_is_that_of_the_study_and_unknown_at_rest() -> None:
    slip = profiles(np.array([1.0, 0.05, 2.0]), np.array([1.25, 1.0, 1.0])).slip()
    np.testing.assert_array_equal(slip, [-0.25, np.nan, 0.5])


def test_imu_speed_is_the_integral_less_what_was_felt_at_rest() -> None:
    t_ns = np.arange(1, 1001, dtype=np.int64) * 10_000_000
    forward = 0.3 + np.where(t_ns > 4e9, 0.5, 0.0)
    accel = np.stack([forward, 0 * forward, 9.8 + 0 * forward], axis=1)
    speed = imu_speed(Imu(t_ns, np.zeros_like(accel), accel), 0)
    assert np.abs(speed[:300]).max() < 1e-12
    assert speed[900] == pytest.approx(0.5 * (9.01 - 4.0), abs=0.01)


def test_differenced_speed_of_even_motion_is_exact() -> None:
    t_s = np.arange(100) / 5.0
    middle, speed = differenced_speed(t_s, np.stack([0.6 * t_s, 0.8 * t_s], axis=1))
    np.testing.assert_allclose(speed, 1.0)
    np.testing.assert_allclose(middle, t_s[:-1] + 0.1)


def test_exact_sensors_have_small_speed_errors_on_firm_ground() -> None:
    recording = simulate("paper_profile", terrain="asphalt", noiseless=True)
    errors = processing.speed_errors(processing.profiles_of(recording, 0.175))
    assert errors.odometry < 1.0
    assert errors.imu < 5.0
    assert errors.gnss < 2.0


def test_odometry_error_is_the_slip() -> None:
    errors = run_case(LOOSE, 0).errors
    assert errors.odometry == pytest.approx(errors.slip)
    assert errors.slip > 10.0


def test_a_recording_without_truth_is_refused() -> None:
    recording = simulate("straight", terrain="asphalt")
    with pytest.raises(ValueError, match="truth"):
        processing.profiles_of(dataclasses.replace(recording, truth=None), 0.175)


def test_imu_speed_starts_at_rest_and_drifts(medium: CaseRun) -> None:
    p = medium.profiles
    assert np.abs(p.imu[p.t_s < 2.0]).max() < 0.02
    drift = measures.imu_drift_mps(medium)
    assert drift["last"] > drift["first"] > 0.0


def test_mud_follows_then_stops_for_good(mud: CaseRun) -> None:
    stop = measures.stopped_after_s(mud)
    assert 20.0 < stop < 200.0
    assert measures.follows_until_stop(mud)["odometry"] < 10.0
    assert measures.speed_after_stop_mps(mud)["truth"] < 0.05


def test_what_never_stops_has_no_time_of_it(medium: CaseRun) -> None:
    assert np.isnan(measures.stopped_after_s(medium))
    assert np.isnan(measures.speed_after_stop_mps(medium)["truth"])
    assert np.isnan(measures.slip_rise_s(medium))


def test_each_acceleration_of_the_profile_is_found(medium: CaseRun) -> None:
    lags = measures.lags_percent(medium)
    assert len(lags) >= 5
    assert 0.0 < max(lags) < 5.0
    assert measures.linearity(medium)["r2"] > 0.99


def test_rise_of_slip_is_timed_from_a_tenth_to_a_half(mud: CaseRun) -> None:
    t_s = mud.profiles.t_s
    rising = 0.02 + np.clip((t_s - 50.0) / 10.0, 0.0, 0.9)
    p = dataclasses.replace(mud.profiles, truth=np.ones_like(t_s), odometry=1.0 + rising)
    assert measures.slip_rise_s(dataclasses.replace(mud, profiles=p)) == pytest.approx(4.0, abs=0.05)


def test_slip_swings_count_turns_and_not_the_noise(mud: CaseRun) -> None:
    stop = measures.stopped_s(mud)
    t_s = mud.profiles.t_s
    wave = 0.2 * np.sin(2 * np.pi * 0.5 * (t_s - stop)) + 0.01 * np.sin(2 * np.pi * 5.0 * t_s)
    swinging = dataclasses.replace(mud.profiles, truth=np.ones_like(t_s), odometry=1.0 + wave)
    run = dataclasses.replace(mud, profiles=swinging)
    assert 19 <= measures.slip_swings(run) <= 21
    calm = dataclasses.replace(swinging, odometry=np.ones_like(t_s))
    assert measures.slip_swings(dataclasses.replace(mud, profiles=calm)) == 0


def test_yaw_is_zero_on_even_ground_and_busy_on_uneven(mud: CaseRun) -> None:
    even, uneven = measures.yaw_rates_radps(mud), measures.yaw_rates_radps(run_case(MUD, 0, UNEVEN))
    assert even["body"] < 1e-6
    assert uneven["body"] > 1e-3
    assert uneven["driving"] > 5.0 * uneven["after"]


def test_gnss_noise_that_was_added_is_found_again(medium: CaseRun) -> None:
    run = NoisyRun.of(medium, 5.0)
    assert run.error(1e-4) < run.error(0.05) < run.error(0.2)
    fit = fit_noise({"medium_sand": [run]}, {"medium_sand": mean_error([run], 0.08)}, 5.0)
    assert fit.alone_m["medium_sand"] == pytest.approx(0.08, rel=0.02)
    assert fit.common_m == pytest.approx(0.08, rel=0.02)
    assert fit.worst_factor({"medium_sand": fit.common_error["medium_sand"] / 2.0}) == pytest.approx(2.0)


def test_the_rate_for_a_noise_lies_between_the_fits() -> None:
    fits = [NoiseFit(rate, {"m": 0.4 / rate}, 0.0, {}, {}) for rate in (1.0, 10.0, 100.0)]
    assert rate_for(fits, "m", 0.02) == pytest.approx(20.0)
    assert np.isnan(rate_for(fits, "m", 5.0))


def test_an_error_that_no_noise_gives_has_no_size(medium: CaseRun) -> None:
    assert np.isnan(fit_noise({"m": [NoisyRun.of(medium, 5.0)]}, {"m": 1e-3}, 5.0).alone_m["m"])


def test_spread_is_students_interval() -> None:
    found = spread([1.0, 2.0, 3.0, float("nan")])
    assert (found.mean, found.low, found.high, found.runs) == (2.0, 1.0, 3.0, 3)
    assert found.half_width == pytest.approx(4.3027 / np.sqrt(3.0), rel=1e-4)
    assert spread([5.0]).text() == "5.0"
    assert spread([]).text() == "-"


def test_the_robot_is_that_of_the_study() -> None:
    figures = platform_figures()
    assert len({figure.name for figure in figures}) == 17
    assert [figure.name for figure in figures if not figure.same] == []
