"""Allan deviation against series of known noise, and the simulated IMU against its own parameters."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Imu, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.analysis.allan import (
    ImuAtRest,
    allan_deviation,
    expected_deviation,
    inertial_noise,
    recording_at_rest,
)
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.sensors.imu import at_rest
from terrafusion.twin.sensors.noise import NoiseStreams, flicker, white_and_walk

RATE_HZ = 100.0


def white(count: int, seed: int, density: float = 1.0) -> np.ndarray:
    return white_and_walk(NoiseStreams(seed).stream("white"), count, RATE_HZ, density, 0.0, 0.0)


def test_white_noise_falls_with_the_root_of_the_cluster_time() -> None:
    curve = allan_deviation(white(200_000, 1)[:, 0], RATE_HZ)
    at_1s = np.interp(1.0, curve.tau_s, curve.deviation)
    assert at_1s == pytest.approx(1.0, rel=0.05)  # the density, by definition
    slope = np.polyfit(np.log(curve.tau_s[:12]), np.log(curve.deviation[:12]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.01)


def test_a_random_walk_rises_with_the_root_of_the_cluster_time() -> None:
    walk = white_and_walk(NoiseStreams(2).stream("walk"), 400_000, RATE_HZ, 0.0, 1.0, 0.0)
    curves = [allan_deviation(column, RATE_HZ) for column in walk.T]
    mean = np.sqrt(np.mean([c.deviation**2 for c in curves], axis=0))
    tau = curves[0].tau_s
    early = (tau > 0.1) & (tau < 40.0)
    np.testing.assert_allclose(mean[early], np.sqrt(tau[early] / 3.0), rtol=0.12)


def test_a_ramp_has_the_deviation_of_a_ramp() -> None:
    """sigma = R tau / sqrt(2) for rates R t (IEEE Std 952-1997, rate ramp)."""
    curve = allan_deviation(0.3 * np.arange(5000) / RATE_HZ, RATE_HZ)
    np.testing.assert_allclose(curve.deviation, 0.3 * curve.tau_s / np.sqrt(2.0), rtol=1e-9)


def test_bias_instability_is_a_flat_floor() -> None:
    floors = []
    for seed in range(6):
        series = flicker(NoiseStreams(seed).stream("flicker"), 720_000, RATE_HZ, 1.0)
        floors += [allan_deviation(column, RATE_HZ, 1) for column in series.T]
    tau = floors[0].tau_s
    mean = np.sqrt(np.mean([c.deviation**2 for c in floors], axis=0))
    flat = (tau > 3.0) & (tau < 1000.0)
    np.testing.assert_allclose(mean[flat], 1.0, atol=0.15)
    slope = np.polyfit(np.log(tau[flat]), np.log(mean[flat]), 1)[0]
    assert abs(slope) < 0.05


def test_the_simulated_imu_has_the_noise_of_its_data_sheet() -> None:
    """Two hours at rest, three axes, two units: each coefficient within 4 standard errors or 6 %."""
    elevate = load_vehicle("elevate")
    spec, real = elevate.sensors.imu, elevate.realism.imu
    runs = [at_rest(elevate, 720_000, seed) for seed in (1, 2)]
    specified = (
        (spec.gyro_noise_radps_sqrthz, spec.gyro_bias_walk_radps2_sqrthz, real.gyro_bias_instability_radps),
        (spec.accel_noise_mps2_sqrthz, spec.accel_bias_walk_mps3_sqrthz, real.accel_bias_instability_mps2),
    )
    for sensor, (density, walk, floor) in enumerate(specified):
        curves = [allan_deviation(column, spec.rate_hz, 1) for run in runs for column in run[sensor].T]
        found = inertial_noise(curves)
        assert found.density == pytest.approx(density, rel=0.005)
        assert abs(found.floor - floor) < max(4.0 * found.floor_error, 0.06 * floor)
        assert abs(found.walk - walk) < max(4.0 * found.walk_error, 0.06 * walk)
        mean = np.sqrt(np.mean([c.deviation**2 for c in curves], axis=0))
        tau = curves[0].tau_s
        np.testing.assert_allclose(
            mean[tau < 200.0], expected_deviation(tau, density, walk, floor)[tau < 200.0], rtol=0.1
        )


def test_too_short_a_series_is_refused() -> None:
    with pytest.raises(ValueError, match="9 values are too few"):
        allan_deviation(np.zeros(9), RATE_HZ)


def test_a_recorded_imu_is_taken_between_gaps_and_a_drive_is_said() -> None:
    count = 20_000
    t_ns = (np.arange(count) * 10_000_000).astype(np.int64)
    t_ns[count // 4 :] += 300 * 10**9  # a logger that paused
    noise = white(count, 3, 1e-3)
    log = Recording("parked", 0, imu=Imu(t_ns, noise, noise), wheels=wheels_at(t_ns, 0.0))
    rest = recording_at_rest(log)
    assert "150 s at 100.0 Hz" in rest.title
    assert "wheels" not in rest.title
    assert inertial_noise(rest.curves["gyro"]).density == pytest.approx(1e-3, rel=0.05)
    driven = recording_at_rest(dataclasses.replace(log, wheels=wheels_at(t_ns, 3.0)))
    assert "the wheels turn in 100 % of it: this is no noise at rest" in driven.title


def test_axes_that_a_log_holds_constant_are_left_out_and_a_slow_imu_is_refused() -> None:
    t_ns = (np.arange(6000) * 10_000_000).astype(np.int64)
    gyro = white(6000, 3, 1e-3)
    gyro[:, :2] = 0.0
    rest = recording_at_rest(Recording("parked", 0, imu=Imu(t_ns, gyro, np.full((6000, 3), 9.81))))
    assert (len(rest.curves["gyro"]), rest.curves["accel"]) == (1, [])
    assert inertial_noise(rest.curves["gyro"]).density == pytest.approx(1e-3, rel=0.1)
    with pytest.raises(DataError, match=r"0\.5 IMU samples a second are too few"):
        recording_at_rest(Recording("slow", 0, imu=Imu(t_ns * 200, gyro, gyro)))


def wheels_at(t_ns: np.ndarray, speed: float) -> Wheels:
    return Wheels(t_ns, np.full((len(t_ns), 2), speed), ("left", "right"), "radps")


def test_text_and_json_tell_the_same_numbers() -> None:
    curve = allan_deviation(white(20_000, 1)[:, 0], RATE_HZ)
    rest = ImuAtRest("a log", {"gyro": [curve], "accel": []}, {"gyro": (1e-3, 0.0, 0.0)})
    found = json.loads(json.dumps(rest.to_json(), allow_nan=False))
    assert found["accel"] is None
    assert "accel: not in the log, constant, or with gaps" in rest.lines()
    assert found["gyro"]["deviation"] == pytest.approx(curve.deviation)
    assert found["gyro"]["specified"] == [1e-3, 0.0, 0.0]
    assert f"estimated {found['gyro']['density']:.3e}" in "\n".join(rest.lines())
