"""Sensor models: exact when noiseless, of the stated statistics when not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.frames import GRAVITY_MPS2, quaternion_to_matrix
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.scenario.scenario import DriveSegment, Interval, RouteLeg, Scenario
from terrafusion.twin.sensors.noise import rows_at_rate
from terrafusion.twin.simulate import simulate

PARKED = Scenario("parked", 400.0, drive=(DriveSegment(400.0),), route=(RouteLeg("asphalt"),))


def strapdown(truth: Trajectory, gyro: np.ndarray, accel: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """Positions (N, 3) of the IMU by dead reckoning from the truth's first pose, trapezoid in position."""
    R = quaternion_to_matrix(truth.quaternion[0])
    dt = np.diff(truth.t_ns) * 1e-9
    twist = truth.twist_body[0]
    v = R @ (twist[:3] + np.cross(twist[3:], lever))
    p = truth.position_m[0] + R @ lever
    out = [p]
    for w, f, h in zip(gyro, accel, dt, strict=True):
        a = R @ f + np.array([0.0, 0.0, -GRAVITY_MPS2])
        p, v = p + v * h + 0.5 * a * h * h, v + a * h
        c, s = np.cos(w[2] * h), np.sin(w[2] * h)
        R = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        out.append(p)
    return np.array(out)


@pytest.mark.parametrize("slope_deg", [0.0, 8.0])
def test_noiseless_imu_reproduces_the_path_by_dead_reckoning(slope_deg) -> None:
    husky = load_vehicle("husky")
    imu_spec = dataclasses.replace(husky.sensors.imu, rate_hz=100.0)
    husky = dataclasses.replace(husky, sensors=dataclasses.replace(husky.sensors, imu=imu_spec))
    recording = simulate("figure_eight", vehicle=husky, slope_deg=slope_deg, noiseless=True)
    lever = np.array(imu_spec.position_m)
    path = strapdown(recording.truth, recording.imu.gyro_radps, recording.imu.accel_mps2, lever)
    actual = recording.truth.position_m + quaternion_to_matrix(recording.truth.quaternion) @ lever
    assert np.abs(path - actual).max() < 5e-3


def test_imu_at_rest_feels_gravity_only() -> None:
    recording = simulate(PARKED, slope_deg=10.0, noiseless=True)
    expected = GRAVITY_MPS2 * np.array([np.sin(np.radians(10.0)), 0.0, np.cos(np.radians(10.0))])
    assert np.abs(recording.imu.accel_mps2[500:] - expected).max() < 1e-4
    assert np.abs(recording.imu.gyro_radps).max() < 1e-9


def test_a_sensor_that_cannot_be_as_fast_as_declared_is_noted() -> None:
    elevate = load_vehicle("elevate")
    slow = dataclasses.replace(elevate.sensors.imu, rate_hz=20.0)
    slow_imu = dataclasses.replace(elevate, sensors=dataclasses.replace(elevate.sensors, imu=slow))
    short = dataclasses.replace(PARKED, duration_s=5.0)
    notes, usual = (simulate(short, vehicle=v).notes for v in (slow_imu, elevate))
    assert "wheels at 20 Hz, not 50: the twin samples no sensor faster than the IMU" in notes
    assert not any("faster than the IMU" in note for note in usual)


def test_imu_noise_has_the_stated_density_and_walk() -> None:
    spec = load_vehicle("elevate").sensors.imu
    imu = simulate(PARKED, seed=5).imu
    for values, density, bias in (
        (imu.gyro_radps, spec.gyro_noise_radps_sqrthz, spec.gyro_bias_sigma_radps),
        (imu.accel_mps2, spec.accel_noise_mps2_sqrthz, spec.accel_bias_sigma_mps2),
    ):
        white = np.diff(values, axis=0).std(axis=0) / np.sqrt(2.0)
        np.testing.assert_allclose(white, density * 10.0, rtol=0.05)
        rest = np.array([0.0, 0.0, GRAVITY_MPS2]) if values is imu.accel_mps2 else 0.0
        assert (np.abs(values.mean(axis=0) - rest) < 5.0 * bias).all()


def test_vibration_grows_with_speed_and_differs_by_ground() -> None:
    def shake(terrain: str, v_mps: float) -> np.ndarray:
        scenario = Scenario("s", 60.0, drive=(DriveSegment(60.0, v_mps=v_mps),))
        return simulate(scenario, terrain=terrain).imu.accel_mps2[1000:].std(axis=0)

    slow, fast = shake("asphalt", 0.5), shake("asphalt", 1.0)
    np.testing.assert_allclose(fast / slow, 2.0, rtol=0.1)
    assert fast[2] == pytest.approx(1.3, rel=0.1)
    assert shake("mud", 1.0)[2] < 0.8 * fast[2] < shake("loose_sand", 1.0)[2]


def test_vibration_lies_in_the_band_of_the_soil() -> None:
    from scipy.signal import welch

    imu = simulate("straight", terrain="loose_sand").imu
    f, power = welch(imu.accel_mps2[500:5500, 2], 100.0, nperseg=512)
    inside = (f > 1.5) & (f < 20.0)
    assert power[inside].sum() > 0.85 * power[1:].sum()


def test_encoders_count_in_quanta_and_speed_is_their_difference() -> None:
    elevate = load_vehicle("elevate")
    coarse = dataclasses.replace(elevate.sensors.wheels, quantum_rad=0.01)
    elevate = dataclasses.replace(elevate, sensors=dataclasses.replace(elevate.sensors, wheels=coarse))
    noisy = simulate("straight", vehicle=elevate).wheels
    exact = simulate("straight", vehicle=elevate, noiseless=True).wheels
    counts = noisy.angle_rad / 0.01
    assert np.abs(counts - np.round(counts)).max() < 1e-6
    error = noisy.angle_rad - exact.angle_rad
    assert np.ptp(error, axis=0).max() < 0.0101
    dt = np.diff(noisy.t_ns) * 1e-9
    np.testing.assert_allclose(noisy.speed[1:], np.diff(noisy.angle_rad, axis=0) / dt[:, None], atol=1e-9)


def test_gnss_noise_has_the_stated_sigma_and_correlation() -> None:
    elevate = load_vehicle("elevate")
    short = dataclasses.replace(elevate.sensors.gnss, correlation_time_s=2.0)
    elevate = dataclasses.replace(elevate, sensors=dataclasses.replace(elevate.sensors, gnss=short))
    gnss = simulate(PARKED, vehicle=elevate, seed=2).gnss
    error = gnss.enu_m - np.array([0.0, 0.0, 0.35])
    np.testing.assert_allclose(error.std(axis=0), [0.02, 0.02, 0.04], rtol=0.15)
    assert np.array_equal(gnss.sigma_enu_m[0], [0.02, 0.02, 0.04])
    lagged = [np.mean(error[5:, i] * error[:-5, i]) / np.var(error[:, i]) for i in range(3)]
    assert np.mean(lagged) == pytest.approx(0.7 * np.exp(-0.5), abs=0.12)
    np.testing.assert_allclose(gnss.velocity_enu_mps.std(axis=0), 0.05, rtol=0.1)


def test_gnss_reports_the_antenna_and_its_swing() -> None:
    elevate = load_vehicle("elevate")
    ahead = dataclasses.replace(elevate.sensors.gnss, antenna_m=(0.3, 0.1, 0.5))
    elevate = dataclasses.replace(elevate, sensors=dataclasses.replace(elevate.sensors, gnss=ahead))
    recording = simulate("spin", vehicle=elevate, noiseless=True)
    arm = np.hypot(*recording.gnss.enu_m[:, :2].T)
    np.testing.assert_allclose(arm, np.hypot(0.3, 0.1), atol=1e-6)
    truth = recording.truth.points_at(recording.gnss.t_ns, (0.3, 0.1, 0.5))
    np.testing.assert_allclose(recording.gnss.enu_m, truth, atol=1e-9)
    speed = np.hypot(*recording.gnss.velocity_enu_mps[:, :2].T)
    assert speed.max() == pytest.approx(np.hypot(0.3, 0.1) * recording.truth.twist_body[:, 5].max(), rel=1e-6)


def test_fix_class_sets_the_sigma_and_latency_shifts_the_stamp() -> None:
    elevate = load_vehicle("elevate")
    single = simulate(dataclasses.replace(load_scenario("straight"), gnss_fix=Fix.SINGLE)).gnss
    assert set(single.fix) == {int(Fix.SINGLE)}
    np.testing.assert_allclose(single.sigma_enu_m[0], [1.5, 1.5, 3.0])
    late = dataclasses.replace(elevate.realism, gnss_latency_s=0.12)
    delayed = simulate("straight", vehicle=dataclasses.replace(elevate, realism=late)).gnss
    prompt = simulate("straight").gnss
    assert set(delayed.t_ns - prompt.t_ns) == {120_000_000}
    assert np.array_equal(delayed.enu_m, prompt.enu_m)
    assert set(prompt.fix) == {int(Fix.FIXED)}
    assert set(simulate("straight", vehicle="husky").gnss.fix) == {int(Fix.SINGLE)}


def test_a_sensor_change_leaves_the_other_sensors_noise_alone() -> None:
    elevate = load_vehicle("elevate")
    other = dataclasses.replace(elevate.sensors.imu, gyro_noise_radps_sqrthz=0.01)
    noisy = dataclasses.replace(elevate, sensors=dataclasses.replace(elevate.sensors, imu=other))
    a, b = simulate("straight"), simulate("straight", vehicle=noisy)
    assert np.array_equal(a.imu.accel_mps2, b.imu.accel_mps2)
    assert np.array_equal(a.gnss.enu_m, b.gnss.enu_m)
    assert np.array_equal(a.wheels.angle_rad, b.wheels.angle_rad)
    assert not np.array_equal(a.imu.gyro_radps, b.imu.gyro_radps)


def test_motor_current_and_voltage_follow_the_load() -> None:
    flat, steep = simulate("straight").motor, simulate("straight", slope_deg=15.0).motor
    mid = slice(1000, 2000)
    assert steep.current_a[mid].mean() > 5.0 * flat.current_a[mid].mean()
    assert 0.0 < flat.voltage_v[mid].mean() < 24.0


def test_an_outage_that_covers_the_run_leaves_an_empty_channel() -> None:
    scenario = dataclasses.replace(load_scenario("spin"), gnss_outages=(Interval(0.0, 1000.0),))
    assert "gnss" not in simulate(scenario).channels()


@pytest.mark.parametrize(
    ("count", "rate", "last"), [(101, 50.0, 100), (101, 30.0, 100), (101, 200.0, 100), (2, 1.0, 0)]
)
def test_sensor_ticks_lie_on_the_grid(count, rate, last) -> None:
    rows = rows_at_rate(count, 100.0, rate)
    assert rows[0] == 0
    assert rows[-1] == last
    assert (np.diff(rows) > 0).all()
