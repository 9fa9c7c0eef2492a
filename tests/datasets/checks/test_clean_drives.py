"""Logs that are short, lack sensors, or show unusual motion have no finding."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.simulate import simulate
from tests.datasets.checks.test_physical_faults import (
    EFFECTIVE_TRACK_M,
    RADIUS_M,
    START_NS,
    Fault,
    after,
    body_speed,
    gnss_with,
    imu_with,
    lively_drive,
    times,
    wheels_with,
    without,
)


@pytest.mark.parametrize("rows_kept", [1, 2, 5, 30])
def test_short_recordings_are_taken(rows_kept: int) -> None:
    good = lively_drive()
    for name in ("wheels", "imu", "gnss", "command"):
        run_checks(dataclasses.replace(good, **{name: getattr(good, name).select(slice(0, rows_kept))}))
    assert good.truth is not None
    run_checks(dataclasses.replace(good, truth=good.truth.select(slice(0, rows_kept))))


BARE: dict[str, Fault] = {
    "gyro z alone": imu_with(
        gyro_radps=times(np.nan, np.nan, 1.0), accel_mps2=lambda a: np.full_like(a, np.nan)
    ),
    "no gyro": imu_with(gyro_radps=lambda g: np.full_like(g, np.nan)),
    "accelerometer lacks z": imu_with(accel_mps2=times(1.0, 1.0, np.nan)),
    "body speed": body_speed,
    "no wheels": lambda r: without(r, "wheels"),
    "wheels unknown": wheels_with(lambda s: np.full_like(s, np.nan)),
    "no fixes": lambda r: without(r, "gnss"),
    "positions unknown": gnss_with(enu_m=lambda e: np.full_like(e, np.nan)),
    "sigmas unknown, no height": gnss_with(enu_m=times(1.0, 1.0, np.nan)),
    "velocities unknown": gnss_with(velocity_enu_mps=lambda v: np.full_like(v, np.nan)),
    "wheels and fixes": lambda r: without(r, "imu", "command", "truth"),
    "imu alone": lambda r: without(r, "wheels", "gnss", "command", "truth"),
    "every tenth unknown": after(
        imu_with(gyro_radps=lambda g: np.where(np.arange(len(g))[:, None] % 10 == 3, np.nan, g)),
        wheels_with(lambda s: np.where(np.arange(len(s))[:, None] % 10 == 3, np.nan, s)),
    ),
}


@pytest.mark.parametrize("name", BARE)
def test_a_log_with_less_is_clean_too(name: str) -> None:
    found = {finding.code for finding in run_checks(BARE[name](lively_drive()))}
    assert found <= {"dead", "missing-values"}  # true of two of them


def test_a_robot_that_spins_on_the_spot_is_clean() -> None:
    good = lively_drive()
    assert good.wheels is not None
    assert good.imu is not None
    n = len(good.wheels)
    rate = 0.6 + 0.3 * np.sin(0.3 * np.arange(n) / 20.0)
    sides = np.stack([-rate, rate], axis=1) * EFFECTIVE_TRACK_M / 2 / RADIUS_M
    gyro = good.imu.gyro_radps.copy()
    t = (good.imu.t_ns - START_NS) * 1e-9
    gyro[:, 2] += np.interp(t, np.arange(n) / 20.0, rate) - motion_rate(good, t)
    imu = Imu(good.imu.t_ns, gyro, good.imu.accel_mps2 * [0.01, 0.01, 1.0])
    spinning = without(good, "gnss", "truth", "command")
    spinning = dataclasses.replace(spinning, imu=imu, wheels=dataclasses.replace(good.wheels, speed=sides))
    assert run_checks(spinning) == []
    stuck = dataclasses.replace(spinning, imu=None)
    assert [(f.code, f.severity, f.repair) for f in run_checks(stuck)] == [("wheel-sign", "warning", None)]
    assert run_checks(dataclasses.replace(stuck, terrain_name="snow")) == []


def test_a_straight_run_in_reverse_is_no_error() -> None:
    """Nothing but the wheels says which way the robot drove."""
    good = body_speed(without(lively_drive(), "truth", "command"))
    assert good.wheels is not None
    assert good.imu is not None
    even = np.full_like(good.wheels.speed, -1.0)
    imu = Imu(good.imu.t_ns, good.imu.gyro_radps * 0.0, good.imu.accel_mps2 * [0.01, 0.01, 1.0])
    reverse = dataclasses.replace(
        good, imu=imu, gnss=None, wheels=dataclasses.replace(good.wheels, speed=even)
    )
    found = [(f.code, f.severity, f.repair) for f in run_checks(reverse) if f.code == "wheel-reversed"]
    assert found == [("wheel-reversed", "warning", None)]


@pytest.mark.parametrize("stands_s", [0.0, 10.0])
def test_a_robot_that_circles_fast_is_clean(stands_s: float) -> None:
    """Its mean specific force is gravity and the force of the turn: 5 m/s times 1.5 rad/s."""
    good = body_speed(without(lively_drive(), "gnss", "truth", "command"))
    assert good.wheels is not None
    assert good.imu is not None
    t, moving = ((one.t_ns - START_NS) * 1e-9 for one in (good.imu, good.wheels))
    gyro, accel, noise = np.zeros((len(t), 3)), np.zeros((len(t), 3)), np.random.default_rng(0)
    gyro[:, 2] = np.where(t < stands_s, 0.0, 1.5)
    accel[:, 1], accel[:, 2] = 5.0 * gyro[:, 2], 9.81
    imu = Imu(good.imu.t_ns, *(x + noise.normal(0.0, 0.01, x.shape) for x in (gyro, accel)))
    speed = np.where(moving < stands_s, 0.0, 5.0 / RADIUS_M)[:, None] + noise.normal(
        0.0, 1e-3, good.wheels.speed.shape
    )
    circling = dataclasses.replace(good, imu=imu, wheels=dataclasses.replace(good.wheels, speed=speed))
    assert [f.code for f in run_checks(circling) if f.severity == "error"] == []


@pytest.mark.parametrize(("down", "height_m"), [(-1.0, 3.0), (1.0, 3.0), (-1.0, 0.0)])
def test_upward_velocities_of_a_receiver_that_counts_down(down: float, height_m: float) -> None:
    good = lively_drive(seconds=90.0)
    assert good.gnss is not None
    assert good.gnss.velocity_enu_mps is not None
    t = (good.gnss.t_ns - START_NS) * 1e-9
    enu, velocity = good.gnss.enu_m.copy(), good.gnss.velocity_enu_mps.copy()
    enu[:, 2] = height_m * np.sin(0.1 * t) + np.random.default_rng(0).normal(0.0, 0.03, len(t))
    velocity[:, 2] = down * 0.1 * height_m * np.cos(0.1 * t)
    gnss = dataclasses.replace(good.gnss, enu_m=enu, velocity_enu_mps=velocity)
    hilly = dataclasses.replace(good, gnss=gnss)
    wrong = [f for f in run_checks(hilly) if f.code == "gnss-velocity"]
    assert ["downwards" in f.what for f in wrong] == ([True] if down < 0.0 < height_m else [])
    for finding in wrong:
        assert finding.repair is not None
        assert "gnss-velocity" not in {f.code for f in run_checks(finding.repair(hilly))}


def motion_rate(r: Recording, t_s: np.ndarray) -> np.ndarray:
    """The yaw rate of the drive as commanded."""
    assert r.command is not None
    return np.interp(t_s, (r.command.t_ns - START_NS) * 1e-9, r.command.yaw_rate_radps)


def test_circles_on_a_slope_are_no_deflated_tyre() -> None:
    log = simulate("circle", vehicle="elevate", terrain="grass", slope_deg=12.0, seed=2)
    assert "wheel-sides" not in {finding.code for finding in run_checks(without(log, "truth", "command"))}
