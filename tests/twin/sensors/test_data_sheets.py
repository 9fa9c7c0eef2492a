"""Sensor errors of data sheets: each is recovered from what the sensor reports."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.sensor_realism import GnssRealism
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle
from terrafusion.twin.physics.layout import state_slice
from terrafusion.twin.scenario.scenario import (
    CanopyInterval,
    CanopyStretch,
    DriveSegment,
    Interval,
    RouteLeg,
    Scenario,
)
from terrafusion.twin.sensors.drive import counted
from terrafusion.twin.sensors.gnss import FIX_LEVELS, Sky, fix_classes
from terrafusion.twin.sensors.imu import triad
from terrafusion.twin.sensors.noise import NoiseStreams, gauss_markov
from terrafusion.twin.simulate import simulate, simulate_run

ELEVATE = load_vehicle("elevate")
ARCMIN = np.pi / 180.0 / 60.0


def realistic(section: str, **changes: Any) -> VehicleParams:
    part = dataclasses.replace(getattr(ELEVATE.realism, section), **changes)
    return dataclasses.replace(ELEVATE, realism=dataclasses.replace(ELEVATE.realism, **{section: part}))


def parked(seconds: float, **fields: Any) -> Scenario:
    return Scenario("parked", seconds, drive=(DriveSegment(seconds),), route=(RouteLeg("asphalt"),), **fields)


def straight(seconds: float, **fields: Any) -> Scenario:
    return Scenario("straight", seconds, drive=(DriveSegment(seconds, v_mps=1.0),), **fields)


# ---- encoders


def test_counts_err_evenly_within_a_quantum() -> None:
    """Uniform over one quantum: its mean error is half of it, its deviation a twelfth root."""
    quantum = 0.02
    plain = dataclasses.replace(ELEVATE.sensors.wheels, quantum_rad=quantum)
    vehicle = dataclasses.replace(
        realistic("encoder", position_error_rad=0.0),
        sensors=dataclasses.replace(ELEVATE.sensors, wheels=plain),
    )
    angle = np.cumsum(np.random.default_rng(0).uniform(0.0, 0.3, (20_000, 4)), axis=0)
    error = counted(angle, vehicle, NoiseStreams(3)) - angle
    assert np.ptp(error, axis=0).max() < quantum
    np.testing.assert_allclose(error.std(axis=0), quantum / np.sqrt(12.0), rtol=0.03)
    speed_error = np.diff(error, axis=0)
    np.testing.assert_allclose(speed_error.std(axis=0), quantum / np.sqrt(6.0), rtol=0.03)


def test_an_eccentric_code_wheel_errs_once_a_turn_of_its_shaft() -> None:
    fine = dataclasses.replace(ELEVATE.sensors.wheels, quantum_rad=0.0)
    vehicle = dataclasses.replace(
        realistic("encoder", position_error_rad=40.0 * ARCMIN, shaft_turns=10.0),
        sensors=dataclasses.replace(ELEVATE.sensors, wheels=fine),
    )
    turn = np.linspace(0.0, 2.0 * np.pi, 2001)[:, None] * np.ones(4)
    error = counted(turn, vehicle, NoiseStreams(1)) - turn
    np.testing.assert_allclose(0.5 * np.ptp(error, axis=0), 4.0 * ARCMIN, rtol=1e-3)
    np.testing.assert_allclose(error[::200], 0.0, atol=1e-12)  # ten periods a turn of the wheel
    spectrum = np.abs(np.fft.rfft(error[:-1, 0] - error[:-1, 0].mean()))
    assert spectrum.argmax() == 10


def test_late_stamps_keep_their_order_and_the_controllers_speed() -> None:
    late = simulate(straight(20.0), vehicle=realistic("encoder", stamp_jitter_s=0.015)).wheels
    prompt = simulate(straight(20.0)).wheels
    delay = (late.t_ns - prompt.t_ns) * 1e-9
    assert delay.min() >= 0.0
    assert 0.012 < delay.max() <= 0.0151
    assert delay.mean() == pytest.approx(0.0075, abs=0.0006)
    assert (np.diff(late.t_ns) >= 0).all()
    assert np.array_equal(late.speed, prompt.speed)


# ---- IMU


def test_scale_and_misalignment_are_found_by_regression() -> None:
    """Of the gyro about z over a drive with turns, and of the accelerometers over three attitudes."""
    vehicle = realistic("imu", gyro_scale_sigma=0.02, accel_scale_sigma=0.02, misalignment_sigma_rad=0.01)
    wanted = triad(NoiseStreams(7).stream("gyro triad"), 0.02, 0.01)
    exact, made = simulate("spin", noiseless=True).imu, simulate("spin", vehicle=vehicle, seed=7).imu
    design = np.stack([exact.gyro_radps[:, 2], np.ones(len(exact))], axis=1)
    for axis in range(3):
        gain, _ = np.linalg.lstsq(design, made.gyro_radps[:, axis], rcond=None)[0]
        assert gain == pytest.approx(wanted[axis, 2], abs=2e-3)
    wanted = triad(NoiseStreams(7).stream("accel triad"), 0.02, 0.01)
    tilts = [
        {},
        {"slope_deg": 20.0},
        {"cross_slope_deg": 20.0},
        {"slope_deg": 15.0, "cross_slope_deg": -15.0},
    ]
    rest = [simulate(parked(20.0), noiseless=True, **t).imu.accel_mps2[500:].mean(axis=0) for t in tilts]
    felt = [
        simulate(parked(20.0), vehicle=vehicle, seed=7, **t).imu.accel_mps2[500:].mean(axis=0) for t in tilts
    ]
    fitted = np.linalg.lstsq(np.hstack([rest, np.ones((4, 1))]), np.array(felt), rcond=None)[0][:3].T
    np.testing.assert_allclose(fitted, wanted, atol=2e-3)


@pytest.mark.parametrize("name", known_names("soils"))
def test_vibration_rises_with_speed_to_the_level_of_the_soil(name) -> None:
    level = load_soil(name).vibration.accel_mps2_at_1mps * ELEVATE.realism.vibration_gain
    for speed in (0.4, 0.8):
        scenario = Scenario("s", 25.0, drive=(DriveSegment(25.0, v_mps=speed),))
        run = simulate_run(scenario, terrain=name)
        driving = slice(500, None)
        rim = np.abs(run.states[1:][driving, state_slice("wheel_speed")]).mean() * ELEVATE.wheel.radius_m
        felt = run.recording.imu.accel_mps2[driving, 2].std()
        assert felt == pytest.approx(level * rim, rel=0.12)


def test_a_sensor_saturates_at_its_range_and_counts_in_its_quantum() -> None:
    vehicle = realistic("imu", gyro_range_radps=0.3, accel_range_mps2=10.0, gyro_quantum_radps=0.01)
    imu = simulate("spin", vehicle=vehicle).imu
    assert imu.gyro_radps.max() == pytest.approx(0.3)
    assert imu.accel_mps2.max() == pytest.approx(10.0)
    steps = imu.gyro_radps / 0.01
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_a_new_error_leaves_the_other_errors_as_they_were() -> None:
    plain = realistic("imu", accel_bias_instability_mps2=0.0, accel_quantum_mps2=0.0, gyro_quantum_radps=0.0)
    more = realistic("imu", accel_bias_instability_mps2=0.1, accel_quantum_mps2=0.0, gyro_quantum_radps=0.0)
    a, b = (simulate(parked(10.0), vehicle=v).imu for v in (plain, more))
    assert np.array_equal(a.gyro_radps, b.gyro_radps)
    difference = b.accel_mps2 - a.accel_mps2
    assert difference.std() > 0.01
    assert np.abs(np.diff(difference, axis=0)).max() < 0.1 * np.abs(difference).max()  # bias moves slowly


# ---- GNSS


def fixed_share(density: float, real: GnssRealism, seconds: float = 40_000.0) -> np.ndarray:
    """Share of each step of the ladder of an RTK receiver under an even canopy."""
    count = round(seconds / 0.2)
    sky = Sky(np.full(count, density), np.ones(count, dtype=bool))
    fixes = fix_classes(sky, Fix.FIXED, 0.2, real, np.random.default_rng(0))
    return np.array([np.mean(fixes == step) for step in FIX_LEVELS[Fix.FIXED]])


@pytest.mark.parametrize("density", [0.2, 0.5, 0.8])
def test_classes_of_fix_settle_where_losses_and_gains_balance(density) -> None:
    """Detailed balance of a birth-death chain: p(k + 1) loss = p(k) gain(k)."""
    real = ELEVATE.realism.gnss
    loss = real.canopy_loss_per_s * density
    gains = (1.0 - density) / np.array([real.reacquire_s, real.refix_s / 2.0, real.refix_s / 2.0])
    steady = np.cumprod([1.0, *(gains / loss)])
    np.testing.assert_allclose(fixed_share(density, real), steady / steady.sum(), atol=0.03)


def test_open_sky_keeps_the_best_fix_and_a_closed_one_none() -> None:
    real = ELEVATE.realism.gnss
    assert fixed_share(0.0, real, 100.0)[-1] == 1.0
    assert fixed_share(1.0, real, 10_000.0)[0] > 0.99


def test_after_an_outage_the_receiver_climbs_back_to_its_best() -> None:
    real, count = ELEVATE.realism.gnss, 1000
    seconds = 0.2 * np.arange(count)
    visible = ~((seconds >= 20.0) & (seconds < 30.0))
    times = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        fixes = fix_classes(Sky(np.zeros(count), visible), Fix.FIXED, 0.2, real, rng)
        assert set(fixes[seconds < 20.0]) == {int(Fix.FIXED)}
        assert set(fixes[~visible]) == {int(Fix.NONE)}
        assert (np.diff(fixes[seconds >= 30.0].astype(int)) >= 0).all()
        times.append(seconds[(seconds > 30.0) & (fixes == int(Fix.FIXED))][0] - 30.0)
    mean = real.reacquire_s + real.refix_s
    assert np.mean(times) == pytest.approx(mean, abs=4.0 * np.std(times) / np.sqrt(len(times)))


def test_a_receiver_without_a_fix_reports_nothing() -> None:
    gnss = simulate(parked(60.0, gnss_outages=(Interval(20.0, 10.0),))).gnss
    seconds = (gnss.t_ns - gnss.t_ns[0]) * 1e-9
    assert not ((seconds >= 20.0) & (seconds < 30.0)).any()
    assert int(Fix.NONE) not in gnss.fix
    sigmas = {int(f): gnss.sigma_enu_m[gnss.fix == f][0, 0] for f in set(gnss.fix)}
    assert sigmas[int(Fix.SINGLE)] == pytest.approx(1.5)
    assert sigmas[int(Fix.FIXED)] == pytest.approx(0.02)


def test_trees_degrade_the_fix_and_the_receiver_does_not_know_all_of_it() -> None:
    """Within a stretch of the way: lower classes, gaps, larger errors than the sigma says."""
    steady = realistic("gnss", reacquire_s=0.0, canopy_multipath_m=4.0)
    scenario = straight(300.0, canopy=(CanopyStretch(100.0, 100.0, 0.6),))
    errors: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for seed in range(8):
        run = simulate(scenario, vehicle=steady, seed=seed)
        under = (run.gnss.enu_m[:, 0] > 105.0) & (run.gnss.enu_m[:, 0] < 195.0)
        truth = run.truth.points_at(run.gnss.t_ns, ELEVATE.sensors.gnss.antenna_m)
        scaled = (run.gnss.enu_m - truth) / run.gnss.sigma_enu_m
        for where in (True, False):
            errors[where].append(scaled[under == where].ravel())
        assert np.mean(run.gnss.fix[under] == int(Fix.FIXED)) < 0.4
        assert run.gnss.fix[~under].max() == Fix.FIXED
    open_sky, trees = (float(np.std(np.concatenate(errors[where]))) for where in (False, True))
    assert open_sky == pytest.approx(1.0, abs=0.15)
    assert trees > 1.4


def test_multipath_belongs_to_the_place() -> None:
    """Twice through the same stretch: the same displacement; elsewhere another. All else is switched off."""
    quiet = realistic("gnss", canopy_loss_per_s=0.0, canopy_attenuation_db=0.0, canopy_multipath_m=3.0)
    spec = dataclasses.replace(ELEVATE.sensors.gnss, sigma_horizontal_m=1.5, sigma_vertical_m=1.5)
    quiet = dataclasses.replace(quiet, sensors=dataclasses.replace(ELEVATE.sensors, gnss=spec))
    way = (DriveSegment(40.0, v_mps=1.0), DriveSegment(5.0), DriveSegment(40.0, v_mps=-1.0))
    trees = (CanopyInterval(0.0, 100.0, 1.0),)
    there_and_back = Scenario("return", 85.0, drive=way, canopy=trees)
    bare = dataclasses.replace(there_and_back, canopy=())
    with_trees, without = (simulate(s, vehicle=quiet, seed=4).gnss for s in (there_and_back, bare))
    bias = with_trees.enu_m - without.enu_m
    out, back = bias[:200], bias[-200:][::-1]
    assert out.std() == pytest.approx(3.0, rel=0.4)
    assert np.corrcoef(out[50:150].ravel(), back[50:150].ravel())[0, 1] > 0.95
    assert abs(np.corrcoef(out[:100].ravel(), out[100:].ravel())[0, 1]) < 0.7


def test_gauss_markov_noise_has_its_variance_and_correlation_time() -> None:
    """Over 2 000 correlation times; the lag-one estimate is within its standard error times four."""
    interval_s, tau_s, count = 0.2, 5.0, 50_000
    series = gauss_markov(np.random.default_rng(5), count, interval_s, tau_s)
    assert series.std() == pytest.approx(1.0, abs=4.0 * np.sqrt(tau_s / (3 * count * interval_s)))
    keep = np.sum(series[1:] * series[:-1]) / np.sum(series[:-1] ** 2)
    expected = np.exp(-interval_s / tau_s)
    assert keep == pytest.approx(expected, abs=4.0 * np.sqrt((1.0 - expected**2) / (3 * count)))
    assert -interval_s / np.log(keep) == pytest.approx(tau_s, rel=0.1)


def test_an_optimistic_receiver_reports_less_than_it_errs() -> None:
    short = dataclasses.replace(ELEVATE.sensors.gnss, correlation_time_s=1.0)
    vehicle = realistic("gnss", reported_share=0.5)
    vehicle = dataclasses.replace(vehicle, sensors=dataclasses.replace(ELEVATE.sensors, gnss=short))
    gnss = simulate(parked(400.0), vehicle=vehicle).gnss
    error = (gnss.enu_m - [0.0, 0.0, 0.35]) / gnss.sigma_enu_m
    assert error.std() == pytest.approx(2.0, rel=0.1)
    assert gnss.velocity_enu_mps.std() / gnss.sigma_v_mps[0] == pytest.approx(2.0, rel=0.1)


# ---- motor current


def test_a_current_sensor_has_gain_offset_and_steps() -> None:
    vehicle = realistic("current", gain_sigma=0.1, offset_sigma_a=2.0, quantum_a=0.25)
    made, exact = (simulate(straight(60.0), vehicle=vehicle, noiseless=n).motor for n in (False, True))
    steps = made.current_a / 0.25
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    gain, offset = NoiseStreams(0).stream("current sensor").normal(size=(2, 2))
    for side in range(2):
        slope, at_zero = np.polyfit(exact.current_a[:, side], made.current_a[:, side], 1)
        assert slope == pytest.approx(1.0 + 0.1 * gain[side], abs=0.02)
        assert at_zero == pytest.approx(2.0 * offset[side], abs=0.05)


def test_an_exact_run_knows_no_error_of_any_sensor() -> None:
    scenario = straight(20.0, canopy=(CanopyInterval(0.0, 20.0, 0.9),))
    a: Recording = simulate(scenario, noiseless=True, seed=1)
    b: Recording = simulate(scenario, noiseless=True, seed=2)
    assert np.array_equal(a.imu.gyro_radps, b.imu.gyro_radps)
    assert np.array_equal(a.gnss.enu_m, b.gnss.enu_m)
    assert set(a.gnss.fix) == {int(Fix.FIXED)}
    truth = a.truth.points_at(a.gnss.t_ns, ELEVATE.sensors.gnss.antenna_m)
    np.testing.assert_allclose(a.gnss.enu_m, truth, atol=1e-9)
    assert np.array_equal(a.motor.current_a, b.motor.current_a)
