"""Slip, immobilisation and rest: on made-up motion with known answers, and on drives of the twin."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.datasets.core.sensors import Rig
from terrafusion.fusion.estimator.slip_monitor import SPINNING, STALLED, MotionMonitor
from terrafusion.fusion.estimator.stationarity import (
    CREEP_MPS,
    StationarityDetector,
    likelihood_ratio,
    shaking,
)
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.slip_trials import alarms, poisson_interval, spinning_hill, stuck_trial

RADIUS_M, DT_S = 0.175, 0.1
COARSE_RAD = 0.02


def rig(quantum_rad: float = 2.9e-5, rate_hz: float = 50.0) -> Rig:
    own = load_vehicle("elevate").rig()
    wheels = dataclasses.replace(own.sensors.wheels, quantum_rad=quantum_rad, rate_hz=rate_hz)
    return dataclasses.replace(own, sensors=dataclasses.replace(own.sensors, wheels=wheels))


def drive(monitor: MotionMonitor, wheel_mps: float, robot_mps: float, seconds: float, sigma: float = 0.01):
    """Keyframes of steady motion; the flags after each."""
    quantum, start = monitor.quantum_m, monitor_time(monitor)
    flags = []
    for i in range(1, round(seconds / DT_S) + 1):
        counted = [np.floor(wheel_mps * DT_S * j / quantum) * quantum for j in (i - 1, i)]
        monitor.update(start + round(i * DT_S * 1e9), counted[1] - counted[0], robot_mps, sigma)
        flags.append((monitor.slipping, monitor.cause))
    return flags


def monitor_time(monitor: MotionMonitor) -> int:
    return monitor._t_ns or 0


@settings(max_examples=30, deadline=None)
@given(speed=st.floats(-1.5, 1.5), quantum=st.floats(1e-5, COARSE_RAD))
def test_a_quantum_is_no_slip(speed: float, quantum: float) -> None:
    assert not any(slip or cause for slip, cause in drive(MotionMonitor(rig(quantum)), speed, speed, 20.0))


@pytest.mark.parametrize("quantum", [2.9e-5, COARSE_RAD])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slip_of_27_percent_is_told_within_two_seconds_both_ways(quantum: float, sign: float) -> None:
    flags = drive(MotionMonitor(rig(quantum)), sign, 0.73 * sign, 2.0)
    assert flags[-1] == (True, None)


def test_slip_is_not_told_where_the_estimate_does_not_know() -> None:
    assert not any(slip for slip, _ in drive(MotionMonitor(rig()), 1.0, 0.73, 10.0, sigma=0.3))


def test_slip_ends_once_the_travels_agree() -> None:
    monitor = MotionMonitor(rig())
    drive(monitor, 1.0, 0.7, 5.0)
    flags = drive(monitor, 1.0, 1.0, 10.0)
    assert flags[0][0]
    assert not flags[-1][0]


def test_wheels_that_spin_on_the_spot_are_told_and_told_off() -> None:
    monitor = MotionMonitor(rig())
    assert drive(monitor, 0.8, 0.0, 1.2)[-1] == (True, SPINNING)
    assert drive(monitor, 0.8, 0.8, 2.0)[-1][1] is None


@pytest.mark.parametrize(("commanded", "cause"), [(1.0, STALLED), (0.0, None)])
def test_a_stall_is_a_stop_that_nobody_commanded(commanded: float, cause: str | None) -> None:
    monitor = MotionMonitor(rig())
    for i in range(20):
        monitor.command(i * 100_000_000, commanded)
        monitor.update(i * 100_000_000, 0.0, 0.0, 0.01)
    assert monitor.cause == cause


def test_missing_wheels_tell_nothing() -> None:
    monitor = MotionMonitor(rig())
    for i in range(50):
        monitor.update(i * 100_000_000, None, 1.0, 0.01)
    assert not monitor.slipping
    assert not monitor.immobilised


def streams(quantum_rad: float, wheel_mps: float, gyro=None, accel=None, seed: int = 0):
    """Two seconds of wheels at 10 Hz in whole quanta, an IMU at 100 Hz with noise as of the data sheet."""
    rng, imu, wheels, q = np.random.default_rng(seed), ImuStream(), WheelStream(), quantum_rad * RADIUS_M
    for i in range(21):
        metres = np.floor(wheel_mps * i * 0.1 / q + rng.uniform(0, 1e-3)) * q
        wheels.add(i * 100_000_000, wheel_mps, wheel_mps, metres, metres)
    t = 0.01 * np.arange(1, 201)
    rates = rng.normal(0.0, 1.2e-3, (200, 3)) + (0.0 if gyro is None else gyro(t))
    forces = rng.normal(0.0, 6e-3, (200, 3)) + [0.0, 0.0, GRAVITY_MPS2] + (0.0 if accel is None else accel(t))
    for i in range(200):
        imu.add(round(t[i] * 1e9), rates[i], forces[i])
    return imu, wheels


def rests(imu: ImuStream, wheels: WheelStream, quantum_rad: float, **speed: float) -> bool:
    detector = StationarityDetector(rig(quantum_rad, 10.0))
    return detector.is_stationary(2_000_000_000, imu, wheels, np.zeros(3), np.zeros(3), **speed)


@pytest.mark.parametrize("quantum", [2.9e-5, 1e-3, COARSE_RAD])
@pytest.mark.parametrize("seed", range(5))
def test_rest_is_told_and_creeping_is_not_rest(quantum: float, seed: int) -> None:
    assert rests(*streams(quantum, 0.0, seed=seed), quantum)
    assert not rests(*streams(quantum, CREEP_MPS, seed=seed), quantum)
    assert not rests(*streams(quantum, -CREEP_MPS, seed=seed), quantum)


def test_an_idling_engine_does_not_hide_rest() -> None:
    rng = np.random.default_rng(1)
    assert rests(*streams(1e-3, 0.0, accel=lambda t: rng.normal(0.0, 0.08, (len(t), 3))), 1e-3)


def carried(t):
    """A robot carried by hand: swaying at 1 Hz."""
    return 0.3 * np.sin(2.0 * np.pi * t)[:, None] * [1.0, 0.5, 1.0]


def test_a_robot_that_is_carried_does_not_rest() -> None:
    assert not rests(*streams(1e-3, 0.0, accel=carried), 1e-3)
    assert not rests(*streams(1e-3, 0.0, gyro=lambda t: 0.2 * carried(t)), 1e-3)


def test_a_smooth_ride_is_told_by_the_estimates_speed_only() -> None:
    ride = streams(1e-3, 0.0)
    assert not rests(*ride, 1e-3, speed_mps=1.0, speed_sigma_mps=0.1)
    assert rests(*ride, 1e-3, speed_mps=0.1, speed_sigma_mps=0.1)


def test_the_gyro_alone_tells_rest_from_motion() -> None:
    rng = np.random.default_rng(0)
    none = np.full((50, 3), np.nan)
    gyro = rng.normal(0.0, 1e-3, (50, 3))
    assert likelihood_ratio(gyro, none, 1e-3, 1.0) == pytest.approx(1.0, abs=0.35)
    assert likelihood_ratio(gyro + 0.02, none, 1e-3, 1.0) > 100.0
    yaw_only = gyro * [np.nan, np.nan, 1.0]
    assert likelihood_ratio(yaw_only, none, 1e-3, 1.0) == pytest.approx(1.0, abs=0.6)


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
def test_the_statistic_is_one_at_rest_in_any_attitude(up: list[float]) -> None:
    rng = np.random.default_rng(2)
    gyro, accel = (
        rng.normal(0.0, 1e-3, (400, 3)),
        rng.normal(0.0, 0.05, (400, 3)) + GRAVITY_MPS2 * np.array(up),
    )
    assert likelihood_ratio(gyro, accel, 1e-3, 0.05) == pytest.approx(1.0, abs=0.1)


def test_shaking_sees_noise_and_not_motion() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(0.0, 0.1, (2000, 3))
    slow = np.sin(2.0 * np.pi * 0.01 * np.arange(2000))[:, None] * [1.0, 1.0, 1.0]
    assert shaking(noise) == pytest.approx(0.1, rel=0.05)
    assert shaking(noise + slow) == pytest.approx(0.1, rel=0.15)


def test_alarms_and_their_interval() -> None:
    assert alarms(np.array([True, True, False, True, False])) == 2
    low, high = poisson_interval(0, 3600.0)
    assert low == 0.0
    assert high == pytest.approx(3.689, abs=1e-3)


@pytest.mark.parametrize(
    "case", [("paper_profile", "mud"), (spinning_hill(), None)], ids=["stalled", "spinning"]
)
def test_a_stuck_robot_is_told_within_a_second(case) -> None:
    told = stuck_trial(*case, "elevate", seed=0, gnss=True)
    assert told.told_s is not None
    assert 0.0 <= told.told_s - told.onset_s <= 1.0


def test_a_command_that_is_no_number_is_refused() -> None:
    with pytest.raises(DataError, match="command"):
        MotionMonitor(rig()).command(0, float("nan"))
