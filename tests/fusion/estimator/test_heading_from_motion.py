"""The start's heading by dead reckoning laid on fixes: its value, and what its sigma has to cover."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from terrafusion.datasets.core.recording import Overrides
from terrafusion.fusion.calibration.numbers import ANTENNA_X, GNSS_DELAY, NUMBERS
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.alignment import Start, level_start
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.heading_from_motion import (
    EXACT,
    UNKNOWN_YAW_RAD,
    MotionDoubt,
    MotionStart,
    _decorrelated,
    heading_from_motion,
)
from terrafusion.fusion.inputs.steering import SteeringStream
from terrafusion.fusion.inputs.validation import GnssFix
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides

Complex = NDArray[np.complex128]
YAW_RAD, ORIGIN = 0.7, 10.0 + 5.0j
SIGMA_M, DRIFT_S, SHARE = 1.5, 60.0, 0.8
NO_NUMBERS = np.zeros((len(NUMBERS), len(NUMBERS)))
DRIFTING = MotionDoubt(NO_NUMBERS, SHARE, DRIFT_S)


@functools.lru_cache
def driven(
    speed_mps: float, turning_radps: float, seconds: float = 30.0
) -> tuple[Estimator, Start, NDArray[np.float64], Complex, NDArray[np.float64]]:
    """An estimator with samples at 50 Hz, its level start; times, places and yaw at 1 Hz. At rest for 2 s."""
    waiting = EstimatorConfig(load_vehicle("elevate").rig(), "elevate", start_without_gnss_s=2.0 * seconds)
    estimator, yaw, at = Estimator(waiting), YAW_RAD, ORIGIN
    times, places, yaws = [], [], []
    for i in range(round(50 * seconds)):
        t_ns, moves = i * 20_000_000, i >= 100
        wave = 1.0 + 0.3 * np.sin(0.02 * i)  # samples that never change are those of a stuck sensor
        v, r = (speed_mps, wave * turning_radps) if moves else (0.0, 0.0)
        yaw += 0.02 * r
        at += 0.02 * v * np.exp(1j * (yaw - 0.01 * r))
        estimator.add_imu(t_ns, [0.0, 0.0, r], [0.0, v * r, 9.81])
        estimator.add_wheels(t_ns, v, v)
        if i % 50 == 0:
            times.append(0.02 * i)
            places.append(at)
            yaws.append(yaw)
    level = dataclasses.replace(level_start(estimator.imu, estimator.wheels, 0), roll_rad=0.0, pitch_rad=0.0)
    return estimator, level, np.array(times), np.array(places), np.array(yaws)


def start_of(
    speed_mps: float,
    turning_radps: float,
    off: Complex | float,
    doubt: MotionDoubt,
    sigma_m: float = SIGMA_M,
) -> MotionStart:
    """The start by fixes that are `off` by so much."""
    estimator, level, times, places, _ = driven(speed_mps, turning_radps)
    fixes = [
        GnssFix(round(t * 1e9), np.array([at.real, at.imag, 0.0]), np.full(3, sigma_m))
        for t, at in zip(times.tolist(), (places + off).tolist(), strict=True)
    ]
    found = heading_from_motion(estimator.imu, estimator.wheels, fixes, level, np.zeros(3), doubt=doubt)
    assert found is not None
    return found


def noise(rng: np.random.Generator, times: NDArray[np.float64], white_share: float) -> Complex:
    """White noise and a Gauss-Markov process, `SIGMA_M` together."""

    def normal() -> Complex:
        return rng.normal(size=len(times)) + 1j * rng.normal(size=len(times))

    kept = np.exp(-np.diff(times, prepend=-np.inf) / DRIFT_S)
    drift = np.zeros(len(times), dtype=complex)
    for i, new in enumerate(normal()):
        drift[i] = kept[i] * drift[i - 1] + np.sqrt(1.0 - kept[i] ** 2) * new
    return SIGMA_M * (np.sqrt(white_share) * normal() + np.sqrt(1.0 - white_share) * drift)


def off_sigma(start: Start) -> float:
    error: float = np.angle(np.exp(1j * (start.yaw_rad - YAW_RAD)))
    return error / start.yaw_sigma_rad


def test_exact_fixes_give_the_heading_and_the_place() -> None:
    start = start_of(1.0, 0.1, 0.0, EXACT, 0.02).start
    assert start.yaw_rad == pytest.approx(YAW_RAD, abs=1e-4)
    assert start.position_m[:2] == pytest.approx([ORIGIN.real, ORIGIN.imag], abs=0.01)  # half a sample


@pytest.mark.parametrize("white_share", [1.0 - SHARE, 1.0], ids=["drift", "white"])
@pytest.mark.parametrize("speed_mps", [0.4, 1.0])
def test_sigma_holds_for_fixes_that_drift_and_for_white_ones(white_share: float, speed_mps: float) -> None:
    rng, times = np.random.default_rng(5), driven(speed_mps, 0.05)[2]
    starts = [start_of(speed_mps, 0.05, noise(rng, times, white_share), DRIFTING) for _ in range(300)]
    off = np.array([off_sigma(found.start) for found in starts])
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.15
    assert np.mean(np.abs(off) < 2.0) > 0.9


def test_drift_of_fixes_gives_a_robot_that_hardly_moves_no_heading() -> None:
    """White noise alone would claim a heading to 20 deg, and be wrong by more than 60 in a third of cases."""
    rng, times = np.random.default_rng(2), driven(0.03, 0.0)[2]
    starts = [start_of(0.03, 0.0, noise(rng, times, 1.0 - SHARE), DRIFTING) for _ in range(100)]
    assert min(found.start.yaw_sigma_rad for found in starts) > 0.8


def test_a_robot_that_is_stuck_has_an_unknown_heading() -> None:
    estimator, level, times, *_ = driven(1.0, 0.0)
    fixes = [GnssFix(round(t * 1e9), np.array([1.0, 2.0, 0.0]), np.full(3, 0.02)) for t in times.tolist()]
    found = heading_from_motion(estimator.imu, estimator.wheels, fixes, level, np.zeros(3))
    assert found is not None
    assert found.start.yaw_sigma_rad == found.random_rad == UNKNOWN_YAW_RAD


@pytest.mark.parametrize("turning_radps", [0.0, 0.15])
@pytest.mark.parametrize(("number", "size"), [(ANTENNA_X, 0.25), (GNSS_DELAY, 0.5)], ids=["antenna", "delay"])
def test_unknown_antenna_and_delay_widen_the_heading_of_a_turn_alone(
    number: int, size: float, turning_radps: float
) -> None:
    """As far as another antenna or later fixes turn the heading that is found."""
    covariance = NO_NUMBERS.copy()
    covariance[number, number] = size**2
    doubt = MotionDoubt(covariance, 0.0, 1.0)
    found = start_of(0.2, turning_radps, 0.0, doubt, 0.02)
    times, _, yaws = driven(0.2, turning_radps)[2:]
    moved = times >= 2.0
    off = size * np.exp(1j * yaws) if number == ANTENNA_X else -size * moved * 0.2 * np.exp(1j * yaws)
    turned = start_of(0.2, turning_radps, off, doubt, 0.02).start
    systematic = np.sqrt(max(found.start.yaw_sigma_rad**2 - found.random_rad**2, 0.0))
    assert systematic == pytest.approx(abs(turned.yaw_rad - YAW_RAD), rel=0.15, abs=2e-3)
    assert (systematic > 0.05) == (turning_radps > 0.0)
    assert found.fixes_decide() == (turning_radps == 0.0)


def test_weights_are_those_of_the_inverse_covariance() -> None:
    rng = np.random.default_rng(1)
    t_s = np.sort(rng.uniform(0.0, 100.0, 40))
    x = rng.normal(size=40) + 1j * rng.normal(size=40)
    together = (1.0 - SHARE) * np.eye(40) + SHARE * np.exp(-np.abs(t_s[:, None] - t_s) / DRIFT_S)
    assert _decorrelated(x, t_s, DRIFTING) == pytest.approx(np.linalg.solve(together, x), rel=1e-9)


def test_fixes_that_disagree_widen_the_start() -> None:
    rng = np.random.default_rng(3)
    times = driven(0.1, 0.02)[2]
    wild = start_of(
        0.1, 0.02, rng.normal(size=len(times)) + 1j * rng.normal(size=len(times)), EXACT, 0.02
    ).start
    honest = start_of(0.1, 0.02, 0.0, EXACT, 0.02).start
    assert honest.yaw_sigma_rad < 0.05
    assert wild.yaw_sigma_rad > 10.0 * honest.yaw_sigma_rad
    assert wild.position_sigma_m > 10.0 * honest.position_sigma_m


def test_a_robot_that_steers_starts_where_its_origin_is_and_not_its_rear_axle() -> None:
    ahead_m, antenna_m = 1.3, np.array([0.4, -0.2, 0.0])
    estimator, level, times, axle, yaws = driven(1.0, 0.2)
    at = axle + (ahead_m + complex(*antenna_m[:2])) * np.exp(1j * yaws)
    fixes = [
        GnssFix(round(t * 1e9), np.array([z.real, z.imag, 0.0]), np.full(3, 0.02))
        for t, z in zip(times.tolist(), at.tolist(), strict=True)
    ]
    found = heading_from_motion(estimator.imu, estimator.wheels, fixes, level, antenna_m, ahead_m)
    assert found is not None
    origin = ORIGIN + ahead_m * np.exp(1j * YAW_RAD)
    assert found.start.yaw_rad == pytest.approx(YAW_RAD, abs=0.02)
    assert found.start.position_m[:2] == pytest.approx([origin.real, origin.imag], abs=0.05)


def test_wheels_that_are_steered_to_one_side_do_not_turn_the_heading() -> None:
    """Front and rear wheels 0.3 rad to the left: the robot moves so far to the left of where it looks."""
    side_rad = 0.3
    estimator, level, times, places, _ = driven(1.0, 0.2)
    robot = with_overrides(load_vehicle("elevate"), Overrides(drive="four_wheel_steer"))
    steering = SteeringStream(robot.rig())
    for i in range(301):
        steering.add(i * 100_000_000, side_rad, side_rad)
    fixes = [
        GnssFix(round(t * 1e9), np.array([z.real, z.imag, 0.0]), np.full(3, 0.02))
        for t, z in zip(times.tolist(), places.tolist(), strict=True)
    ]
    start = heading_from_motion(estimator.imu, estimator.wheels, fixes, level, np.zeros(3), steering=steering)
    assert start is not None
    assert start.start.yaw_rad == pytest.approx(YAW_RAD - side_rad, abs=0.02)
