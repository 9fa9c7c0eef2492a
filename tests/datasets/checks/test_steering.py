"""Steering angles of another sign, unit or robot; encoders that do not count the direction; bursts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.checks.summary import clock
from terrafusion.datasets.core.channels import Imu, Steering, Wheels
from terrafusion.datasets.core.recording import Overrides, Recording

WHEELBASE_M, TRACK_M, IMU_HZ, HZ, SECONDS = 1.4, 0.6, 100, 20, 120.0


def drive(spins: bool = False, seed: int = 0) -> Recording:
    """Speed and steering angle, or both sides of a robot that turns on the spot and reverses, with a gyro."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS, 1.0 / IMU_HZ)
    v = 1.0 + 0.3 * np.sin(0.4 * t)
    rate = 0.4 * np.sin(0.23 * t) * v
    if spins:
        v, rate = np.where(np.sin(0.1 * t) > 0.6, 0.0, v), np.where(np.sin(0.1 * t) > 0.6, 0.6, 0.5 * rate)
    gyro = np.stack([0.0 * t, 0.0 * t, rate], axis=1) + rng.normal(0.0, 0.01, (len(t), 3))
    accel = np.stack([np.gradient(v, t) * (not spins), v * rate, 0.0 * t + 9.81], axis=1)
    t_ns = np.rint(t * 1e9).astype(np.int64)
    rows = slice(None, None, IMU_HZ // HZ)
    sides = np.stack([v - 0.5 * TRACK_M * rate, v + 0.5 * TRACK_M * rate], axis=1)[rows]
    angle = np.arctan(WHEELBASE_M * rate / np.where(v > 0.0, v, 1.0))[rows, None]
    return Recording(
        name="steered",
        start_ns=0,
        wheels=Wheels(t_ns[rows], sides, ("left", "right"), "mps")
        if spins
        else Wheels(t_ns[rows], v[rows, None], ("speed",), "mps"),
        imu=Imu(t_ns, gyro, accel + rng.normal(0.0, 0.2, (len(t), 3))),
        steering=None if spins else Steering(t_ns[rows], angle, ("angle",)),
        overrides=Overrides(wheelbase_m=WHEELBASE_M),
    )


def steered(change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    log = drive()
    assert log.steering is not None
    other = dataclasses.replace(log.steering, angle_rad=change(log.steering.angle_rad))
    return dataclasses.replace(log, steering=other)


def codes(log: Recording) -> set[str]:
    return {finding.code for finding in run_checks(log)}


WRONG: dict[str, tuple[Callable[[np.ndarray], np.ndarray], set[str]]] = {
    "right positive": (np.negative, {"steering-sign"}),
    "degrees": (np.degrees, {"steering-unit"}),
    "a steering wheel": (lambda a: 16.0 * a, {"steering-unit"}),
    "a steering wheel in degrees": (lambda a: np.degrees(14.0 * a), {"steering-unit"}),
    "degrees, right positive": (lambda a: -np.degrees(a), {"steering-unit", "steering-sign"}),
    "half of it": (lambda a: 0.5 * a, {"steering-scale"}),
    "no sensor": (lambda a: 0.0 * a, {"dead"}),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_angles_are_found_and_repaired(name: str) -> None:
    change, expected = WRONG[name]
    log = steered(change)
    assert codes(log) == expected
    repaired, _ = repair(log)
    assert codes(repaired) == set()
    if repaired.steering is None:
        assert name == "no sensor"
        return
    true = drive().steering
    assert true is not None
    largest = np.abs(true.angle_rad).max()
    np.testing.assert_allclose(repaired.steering.angle_rad, true.angle_rad, atol=0.1 * largest)


def test_angles_of_another_robot_are_named() -> None:
    log = steered(lambda a: np.random.default_rng(1).normal(0.0, 0.3, a.shape))
    assert codes(log) == {"steering-unrelated"}


def test_large_angles_that_turn_nothing_are_not_repaired() -> None:
    log = steered(lambda a: np.random.default_rng(1).normal(0.0, 30.0, a.shape))
    (found,) = run_checks(log)
    assert (found.code, found.repair) == ("steering-unit", None)
    assert "check their unit" in found.fix


def test_a_channel_without_rows_has_no_finding() -> None:
    log = drive()
    assert log.steering is not None
    empty = log.steering.select(np.zeros(len(log.steering), dtype=bool))
    assert codes(dataclasses.replace(log, steering=empty)) == set()


def test_without_a_wheelbase_angles_have_no_scale() -> None:
    assert codes(dataclasses.replace(steered(lambda a: 0.5 * a), overrides=Overrides())) == set()


@pytest.mark.parametrize("seed", range(3))
def test_a_steered_drive_has_no_finding(seed: int) -> None:
    assert codes(drive(seed=seed)) == set()


@pytest.mark.parametrize("seed", range(3))
def test_encoders_without_a_direction_are_named(seed: int) -> None:
    log = drive(spins=True, seed=seed)
    assert log.wheels is not None
    assert codes(log) == set()
    unsigned = dataclasses.replace(log.wheels, speed=np.abs(log.wheels.speed))
    assert "wheel-unsigned" in codes(dataclasses.replace(log, wheels=unsigned))
    forwards = dataclasses.replace(log.wheels, speed=log.wheels.speed + 1.0)
    assert "wheel-unsigned" not in codes(dataclasses.replace(log, wheels=forwards))


@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_front_wheels_may_roll_further_in_tight_curves_alone(gain: float) -> None:
    log = drive()
    assert log.wheels is not None
    assert log.steering is not None
    v, angle = log.wheels.speed[:, 0], log.steering.angle_rad[:, 0]
    tangent = np.where(np.abs(angle) > 0.2, np.sign(angle), 0.0)
    rate = v * tangent / WHEELBASE_M
    left, right = v - 0.5 * TRACK_M * rate, v + 0.5 * TRACK_M * rate
    front = (np.hypot(side, WHEELBASE_M * rate) for side in (left, right))
    names = ("front_left", "front_right", "rear_left", "rear_right")
    four = Wheels(log.wheels.t_ns, np.stack([*front, gain * left, right], axis=1), names, "mps")
    steering = Steering(log.steering.t_ns, np.arctan(tangent)[:, None], ("angle",))
    other = dataclasses.replace(log, wheels=four, steering=steering, imu=None)
    assert ("wheel-odd" in codes(other)) == (gain != 1.0)


def test_samples_that_come_in_bursts_are_spread_evenly() -> None:
    log, rng = drive(), np.random.default_rng(2)
    assert log.imu is not None
    k = np.arange(len(log.imu))
    burst = k // 5
    read_ns = (burst + 1) * 50_000_000 + 100_000 * (k % 5) + rng.integers(0, 200_000, burst[-1] + 1)[burst]
    bursts = dataclasses.replace(log, imu=dataclasses.replace(log.imu, t_ns=read_ns))
    assert codes(bursts) == {"uneven-sampling"}
    rates = [clock(0, one.imu.t_ns)["rate_hz"] for one in (bursts, log) if one.imu is not None]
    assert rates == pytest.approx([IMU_HZ, IMU_HZ], rel=0.01)  # not the 10 kHz inside a burst
    repaired, _ = repair(bursts)
    assert repaired.imu is not None
    assert codes(repaired) == set()
    np.testing.assert_allclose(np.diff(repaired.imu.t_ns) * 1e-9, 1.0 / IMU_HZ, rtol=0.01)


def test_zeros_for_missing_values_are_found_and_left_out() -> None:
    """A table at the rate of the IMU, merged with slower wheels: these drove a third as far, unnoticed."""
    log = drive(spins=True)
    assert log.wheels is not None
    filled = dataclasses.replace(
        log.wheels, speed=log.wheels.speed * (np.arange(len(log.wheels)) % 3 == 0)[:, None]
    )
    merged = dataclasses.replace(log, wheels=filled)
    assert "zero-filled" in codes(merged)
    repaired, _ = repair(merged)
    assert repaired.wheels is not None
    assert codes(repaired) == codes(log) == set()
    np.testing.assert_array_equal(repaired.wheels.speed[:800], log.wheels.speed[::3])
    slow = dataclasses.replace(log.wheels, speed=np.rint(2.0 * log.wheels.speed) / 2.0)  # one tick or two
    assert "zero-filled" not in codes(dataclasses.replace(log, wheels=slow))
