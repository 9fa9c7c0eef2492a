"""Axes, signs, units, scales and frames: each fault is found by its physics, and repaired where it can be."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.checks import repair, run_checks
from terrafusion.datasets.core.channels import Command, Fix, Gnss, Imu, Wheels
from terrafusion.datasets.core.frames import enu_to_geodetic, rpy_to_quaternion
from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.datasets.core.sensors import Rig, axes_matrix
from terrafusion.datasets.core.trajectory import Trajectory

pytestmark = pytest.mark.usefixtures("checked_once")

START_NS = 1_700_000_000_000_000_000
SECONDS, REST_S = 64.0, 6.0
RADIUS_M, TRACK_M, EFFECTIVE_TRACK_M = 0.1651, 0.555, 0.9
DATUM = (48.1, 11.5, 520.0)
FOUR = ("front_left", "front_right", "rear_left", "rear_right")
Fault = Callable[[Recording], Recording]


def lively_drive(seed: int = 0, speed_mps: float = 1.0, seconds: float = SECONDS) -> Recording:
    """A rest, then a winding drive whose IMU feels what the wheels do; clean but for noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.002)
    going = np.clip((t - REST_S) / 2.0, 0.0, 1.0)
    v = speed_mps * going * (1.0 + 0.4 * np.sin(0.7 * t) + 0.2 * np.sin(0.23 * t))
    rate = going * (0.35 * np.sin(0.31 * t) + 0.2 * np.sin(0.83 * t))
    yaw = 0.3 + np.cumsum(rate) * 0.002
    place = np.cumsum(v * np.exp(1j * yaw)) * 0.002

    def at(hz: float, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
        rows = slice(None, None, round(500.0 / hz))
        return START_NS + np.rint(t[rows] * 1e9).astype(np.int64), *(column[rows] for column in columns)

    t_imu, along, across, turn = at(50.0, np.gradient(v, t), v * rate, rate)
    gyro = np.stack([0.0 * turn, 0.0 * turn, turn], axis=1) + rng.normal(0.0, 0.01, (len(turn), 3))
    accel = np.stack([along, across, 0.0 * turn + 9.81], axis=1) + rng.normal(0.0, 0.3, (len(turn), 3))
    t_wheels, v_w, rate_w = at(20.0, v, rate)
    sides = np.stack([v_w - rate_w * EFFECTIVE_TRACK_M / 2, v_w + rate_w * EFFECTIVE_TRACK_M / 2], axis=1)
    sides += rng.normal(0.0, 0.005, sides.shape) * (np.abs(v_w) > 0.0)[:, None]
    t_gnss, east, north, v_g, yaw_g = at(5.0, place.real, place.imag, v, yaw)
    n = len(t_gnss)
    velocity = np.stack([v_g * np.cos(yaw_g), v_g * np.sin(yaw_g), 0.0 * v_g], axis=1)
    t_true, x, y, yaw_t = at(20.0, place.real, place.imag, yaw)
    zero = 0.0 * x
    return Recording(
        name="lively",
        start_ns=START_NS,
        command=Command(t_wheels, v_w, rate_w),
        wheels=Wheels(t_wheels, sides / RADIUS_M, ("left", "right"), "radps"),
        imu=Imu(t_imu, gyro, accel),
        gnss=Gnss(
            t_gnss,
            np.stack([east, north, 0.0 * east], axis=1) + rng.normal(0.0, 0.05, (n, 3)),
            np.full((n, 3), 0.05),
            np.full(n, Fix.FIXED, dtype=np.uint8),
            velocity + rng.normal(0.0, 0.02, (n, 3)),
            np.full(n, 0.02),
        ),
        truth=Trajectory(
            t_true, np.stack([x, y, zero], axis=1), rpy_to_quaternion(np.stack([zero, zero, yaw_t], axis=1))
        ),
        datum=DATUM,
        truth_channels=("position", "yaw"),
        terrain_name="gravel",
        overrides=Overrides(wheel_radius_m=RADIUS_M),
    )


def four_wheels(r: Recording) -> Recording:
    assert r.wheels is not None
    noise = np.random.default_rng(5).normal(0.0, 0.02, (len(r.wheels), 4))
    speed = r.wheels.speed[:, [0, 1, 0, 1]] + noise * (r.wheels.speed[:, :1] != 0.0)
    return dataclasses.replace(r, wheels=Wheels(r.wheels.t_ns, speed, FOUR, "radps"))


def in_mps(r: Recording) -> Recording:
    assert r.wheels is not None
    metric = Wheels(r.wheels.t_ns, r.wheels.speed * RADIUS_M, r.wheels.names, "mps")
    return dataclasses.replace(r, wheels=metric, overrides=Overrides())


def without(r: Recording, *channels: str) -> Recording:
    return dataclasses.replace(r, **dict.fromkeys(channels))


def imu_with(**change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    """Another reading of the IMU's arrays."""

    def corrupted(r: Recording) -> Recording:
        assert r.imu is not None
        fields = {name: f(getattr(r.imu, name)) for name, f in change.items()}
        return dataclasses.replace(r, imu=dataclasses.replace(r.imu, **fields))

    return corrupted


def wheels_with(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def corrupted(r: Recording) -> Recording:
        assert r.wheels is not None
        return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, speed=change(r.wheels.speed)))

    return corrupted


def gnss_with(**change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def corrupted(r: Recording) -> Recording:
        assert r.gnss is not None
        fields = {name: f(getattr(r.gnss, name).copy()) for name, f in change.items()}
        return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, **fields))

    return corrupted


def mounted(*axes: str) -> Fault:
    """The IMU of which `axes` lie along body x, y, z."""
    R = axes_matrix(axes)
    return imu_with(gyro_radps=lambda g: g @ R, accel_mps2=lambda a: a @ R)


def after(*steps: Fault) -> Fault:
    def corrupted(r: Recording) -> Recording:
        for step in steps:
            r = step(r)
        return r

    return corrupted


def rad_for_metres(r: Recording) -> Recording:
    """Wheel rates (rad/s) given as speeds, in a log that gives the radius as well."""
    assert r.wheels is not None
    return dataclasses.replace(r, wheels=dataclasses.replace(r.wheels, unit="mps"))


def rows(first: int, last: int, offset: Any) -> Callable[[np.ndarray], np.ndarray]:
    def shifted(values: np.ndarray) -> np.ndarray:
        values[first:last] += offset
        return values

    return shifted


def radius(value: float) -> Fault:
    return lambda r: dataclasses.replace(r, overrides=Overrides(wheel_radius_m=value))


def latitude_longitude(order: list[int], scale: float = 1.0) -> Fault:
    def corrupted(r: Recording) -> Recording:
        assert r.gnss is not None
        place = enu_to_geodetic(r.gnss.enu_m, DATUM)
        place = np.column_stack([place[:, order] * scale, place[:, 2]])
        return dataclasses.replace(r, gnss=dataclasses.replace(r.gnss, enu_m=place), datum=None)

    return corrupted


def truth_yawed(r: Recording, degrees: float) -> Recording:
    assert r.truth is not None
    zero = np.zeros(len(r.truth))
    quaternion = rpy_to_quaternion(np.stack([zero, zero, r.truth.yaw_rad() + np.radians(degrees)], axis=1))
    return dataclasses.replace(r, truth=dataclasses.replace(r.truth, quaternion=quaternion))


def truth_scaled(r: Recording, factor: float) -> Recording:
    assert r.truth is not None
    return dataclasses.replace(r, truth=dataclasses.replace(r.truth, position_m=r.truth.position_m * factor))


def no_fix_at_first(fix: np.ndarray) -> np.ndarray:
    fix[:9] = Fix.NONE
    return fix


def frozen_fixes(r: Recording) -> Recording:
    def held(enu: np.ndarray) -> np.ndarray:
        enu[200:225] = enu[200]
        return enu

    return gnss_with(enu_m=held)(r)


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values * factor


def times(*factors: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values * np.array(factors)


def columns(*order: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values[:, list(order)]


def tilted(r: Recording) -> Recording:
    """The IMU pitched by 45 deg."""
    c = np.sqrt(0.5)
    R = np.array([[c, 0.0, c], [0.0, 1.0, 0.0], [-c, 0.0, c]])
    return imu_with(gyro_radps=lambda g: g @ R, accel_mps2=lambda a: a @ R)(r)


def other_gyro(r: Recording) -> Recording:
    """Gyro z of a run that turned otherwise; no other channel shows turns."""
    rng = np.random.default_rng(3)
    steps = np.repeat(rng.normal(0.0, 0.3, 46), 100)[: round(50 * SECONDS)]
    bare = without(r, "gnss", "truth", "command")
    return imu_with(gyro_radps=lambda g: np.stack([g[:, 0], g[:, 1], steps], axis=1))(bare)


def untold(fault: Fault, *channels: str) -> Fault:
    """The fault in a log without these channels."""
    return lambda r: without(fault(r), *channels)


MENDED: dict[str, tuple[Fault, str, str]] = {
    "accel in mg": (imu_with(accel_mps2=scaled(1e3 / 9.80665)), "accel-in-g", "error"),
    "accel in g": (imu_with(accel_mps2=scaled(1 / 9.80665)), "accel-in-g", "error"),
    "forward, right, down": (mounted("+x", "-y", "-z"), "imu-axes", "error"),
    "husky": (mounted("-z", "-x", "+y"), "imu-axes", "error"),
    "backward, left, down": (mounted("-x", "+y", "-z"), "imu-axes", "error"),
    "right, forward, down": (mounted("+y", "+x", "-z"), "imu-axes", "error"),
    "accelerometer alone on its side": (
        imu_with(accel_mps2=lambda a: a @ axes_matrix(("+x", "-z", "+y"))), "imu-axes", "error",
    ),
    "accelerometer negated": (imu_with(accel_mps2=scaled(-1.0)), "imu-axes", "error"),
    "turned left": (mounted("-y", "+x", "+z"), "imu-forward", "error"),
    "turned right": (mounted("+y", "-x", "+z"), "imu-forward", "error"),
    "backward": (mounted("-x", "-y", "+z"), "imu-forward", "error"),
    "on its side and in g": (
        after(mounted("-z", "-x", "+y"), imu_with(accel_mps2=scaled(1 / 9.80665))), "accel-in-g", "error",
    ),
    "gyro in deg/s": (imu_with(gyro_radps=np.degrees), "gyro-in-degrees", "error"),
    "gyro in deg/s beside the truth": (
        untold(imu_with(gyro_radps=np.degrees), "wheels", "command", "gnss"), "gyro-in-degrees", "error",
    ),
    "gyro in deg/s beside the fixes": (
        untold(imu_with(gyro_radps=np.degrees), "wheels", "command", "truth"), "gyro-in-degrees", "error",
    ),
    "gyro in deg/s alone": (
        untold(imu_with(gyro_radps=np.degrees), "wheels", "command", "truth", "gnss"),
        "gyro-in-degrees", "error",
    ),
    "gyro reversed": (imu_with(gyro_radps=times(1, 1, -1)), "yaw-sign", "error"),
    "gyro reversed, nothing but wheels and accelerometer": (
        untold(imu_with(gyro_radps=times(1, 1, -1)), "gnss", "truth", "command"), "yaw-sign", "error",
    ),
    "gyro bias": (imu_with(gyro_radps=lambda g: g + np.array([0.03, 0.0, -0.05])), "gyro-bias", "warning"),
    "sides swapped": (wheels_with(columns(1, 0)), "wheel-swap", "error"),
    "sides swapped, nothing but the IMU": (
        untold(wheels_with(columns(1, 0)), "gnss", "truth", "command"), "wheel-swap", "error",
    ),
    "four wheels swapped": (after(four_wheels, wheels_with(columns(1, 0, 3, 2))), "wheel-swap", "error"),
    "left negative": (wheels_with(times(-1, 1)), "wheel-sign", "error"),
    "right negative": (wheels_with(times(1, -1)), "wheel-sign", "error"),
    "left negative, nothing but the IMU": (
        untold(wheels_with(times(-1, 1)), "gnss", "truth", "command"), "wheel-sign", "error",
    ),
    "left negative, no IMU": (untold(wheels_with(times(-1, 1)), "imu", "command"), "wheel-sign", "error"),
    "pathfinder": (
        after(mounted("+x", "-y", "-z"), four_wheels, wheels_with(times(-1, 1, -1, 1))), "imu-axes", "error",
    ),
    "both negative": (wheels_with(scaled(-1.0)), "wheel-reversed", "error"),
    "both negative, nothing but the IMU": (
        untold(wheels_with(scaled(-1.0)), "gnss", "truth", "command"), "wheel-reversed", "error",
    ),
    "rev/min": (wheels_with(scaled(60 / (2 * np.pi))), "wheel-unit", "error"),
    "deg/s": (wheels_with(np.degrees), "wheel-unit", "error"),
    "rev/min, no command": (
        untold(wheels_with(scaled(60 / (2 * np.pi))), "command", "truth"), "wheel-unit", "error",
    ),
    "rad/s in a column of m/s": (rad_for_metres, "wheel-unit", "error"),
    "km/h": (after(in_mps, wheels_with(scaled(3.6))), "wheel-unit", "error"),
    "mm/s": (after(in_mps, wheels_with(scaled(1000.0))), "wheel-unit", "error"),
    "radius 7 % short": (radius(RADIUS_M / 1.07), "wheel-radius", "warning"),
    "radius 7 % short, by the truth": (untold(radius(RADIUS_M / 1.07), "gnss"), "wheel-radius", "warning"),
    "speed 7 % short": (after(in_mps, wheels_with(scaled(1 / 1.07))), "wheel-radius", "warning"),
    "front right dead": (after(four_wheels, wheels_with(times(1, 0, 1, 1))), "wheel-odd", "error"),
    "rear left reversed": (after(four_wheels, wheels_with(times(1, 1, -1, 1))), "wheel-odd", "error"),
    "rear right half": (after(four_wheels, wheels_with(times(1, 1, 1, 0.5))), "wheel-odd", "error"),
    "sigma zero": (gnss_with(sigma_enu_m=scaled(0.0)), "sigma-impossible", "error"),
    "one sigma negative": (gnss_with(sigma_enu_m=rows(7, 8, -1.0)), "sigma-impossible", "error"),
    "some sigma missing": (gnss_with(sigma_enu_m=rows(7, 80, np.nan)), "sigma-impossible", "warning"),
    "velocity sigma": (gnss_with(sigma_v_mps=rows(7, 80, -1.0)), "velocity-sigma-impossible", "warning"),
    "variance for sigma": (gnss_with(sigma_enu_m=np.square), "sigma-too-small", "warning"),
    "degrees": (latitude_longitude([1, 0]), "gnss-degrees", "error"),
    "degrees, latitude first": (latitude_longitude([0, 1]), "gnss-degrees", "error"),
    "radians": (latitude_longitude([1, 0], np.pi / 180), "gnss-degrees", "error"),
    "excursion": (gnss_with(enu_m=rows(200, 206, [6.0, 3.0, 0.0])), "gnss-jumps", "warning"),
    "frozen": (frozen_fixes, "gnss-frozen", "warning"),
    "some without fix": (gnss_with(fix=no_fix_at_first), "fix-none", "warning"),
    "east and north swapped": (gnss_with(enu_m=columns(1, 0, 2)), "gnss-course", "error"),
    "north negative": (gnss_with(enu_m=times(1, -1, 1)), "gnss-course", "error"),
    "east negative": (gnss_with(enu_m=times(-1, 1, 1)), "gnss-course", "error"),
    "truth turned": (lambda r: truth_yawed(r, 90.0), "truth-yaw", "warning"),
    "truth backward": (lambda r: truth_yawed(r, 180.0), "truth-yaw", "warning"),
    "truth askew": (lambda r: truth_yawed(r, -50.0), "truth-yaw", "warning"),
    "truth in mm": (lambda r: truth_scaled(r, 1000.0), "truth-unit", "error"),
    "positions in feet": (gnss_with(enu_m=scaled(1 / 0.3048)), "gnss-unit", "error"),
    "positions in mm": (gnss_with(enu_m=scaled(1e3), sigma_enu_m=scaled(1e3)), "gnss-unit", "error"),
    "velocity in knots": (gnss_with(velocity_enu_mps=scaled(1.943844)), "gnss-velocity", "warning"),
    "velocity swapped": (gnss_with(velocity_enu_mps=columns(1, 0, 2)), "gnss-velocity", "warning"),
    "velocity north negative": (gnss_with(velocity_enu_mps=times(1, -1, 1)), "gnss-velocity", "warning"),
    "velocity negative": (gnss_with(velocity_enu_mps=times(-1, -1, 1)), "gnss-velocity", "warning"),
    "command reversed": (
        lambda r: dataclasses.replace(
            r, command=dataclasses.replace(r.command, yaw_rate_radps=-r.command.yaw_rate_radps)
        ),
        "command-sign",
        "warning",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MENDED)
def test_fault_is_found_and_repaired(name: str) -> None:
    corrupt, code, severity = MENDED[name]
    good = lively_drive()
    corrupted = corrupt(good)
    found = {finding.code: finding for finding in run_checks(corrupted)}
    assert code in found, sorted(found)
    assert found[code].severity == severity
    assert found[code].evidence
    assert found[code].fix
    repaired, done = repair(corrupted)
    assert code in [finding.code for finding in done]
    assert {finding.code for finding in run_checks(repaired)} <= {"gaps"}  # where fixes were dropped
    assert_same(repaired, good)


def assert_same(repaired: Recording, good: Recording) -> None:
    """The numbers of the channels that are left are near those of the good drive."""
    if repaired.imu is not None:
        np.testing.assert_allclose(repaired.imu.gyro_radps, good.imu.gyro_radps, atol=0.005)
        np.testing.assert_allclose(repaired.imu.accel_mps2, good.imu.accel_mps2, atol=0.02)
    if repaired.wheels is not None:
        found = repaired.wheels.side_speeds_mps(repaired.overrides.wheel_radius_m or RADIUS_M)
        np.testing.assert_allclose(found, good.wheels.side_speeds_mps(RADIUS_M), rtol=0.01, atol=0.01)
    if repaired.gnss is not None:
        same = good.gnss.select(np.isin(good.gnss.t_ns, repaired.gnss.t_ns))
        assert len(repaired.gnss) > 0.9 * len(good.gnss)
        away = same.enu_m - same.enu_m[0]
        np.testing.assert_allclose(repaired.gnss.enu_m - repaired.gnss.enu_m[0], away, atol=0.01)
        kept = np.isfinite(repaired.gnss.velocity_enu_mps)
        found, expected = repaired.gnss.velocity_enu_mps[kept], same.velocity_enu_mps[kept]
        np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.02)
        assert (repaired.gnss.sigma_enu_m > 0.03).all()
        assert (repaired.gnss.sigma_enu_m < 0.25).all()
    if repaired.truth is not None:
        np.testing.assert_allclose(repaired.truth.position_m, good.truth.position_m, atol=1e-6)
        off = np.angle(np.exp(1j * (repaired.truth.yaw_rad() - good.truth.yaw_rad())))
        np.testing.assert_allclose(off, 0.0, atol=0.05)
    if repaired.command is not None:
        np.testing.assert_array_equal(repaired.command.yaw_rate_radps, good.command.yaw_rate_radps)


@pytest.mark.parametrize("speed_mps", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_lively_drive_has_no_finding(seed: int, speed_mps: float, husky_rig: Rig) -> None:
    good = lively_drive(seed, speed_mps)
    for drive in (good, four_wheels(good), in_mps(good)):
        assert run_checks(drive) == []
    assert (
        run_checks(good, dataclasses.replace(husky_rig, wheel_radius_m=RADIUS_M, sensors=level(husky_rig)))
        == []
    )


def level(rig: Rig) -> Any:
    """The sensors of a rig whose antenna is above the origin, as in the drives here."""
    gnss = dataclasses.replace(rig.sensors.gnss, antenna_m=(0.0, 0.0, 0.3))
    return dataclasses.replace(rig.sensors, gnss=gnss)


FOUND: dict[str, tuple[Fault, str, str]] = {
    "mounted at 45 deg": (tilted, "imu-axes", "error"),
    "left side of y": (imu_with(accel_mps2=times(1, -1, 1)), "accel-mirrored", "warning"),
    "gyro of another drive": (other_gyro, "yaw-unrelated", "warning"),
    "map shifted for good": (gnss_with(enu_m=rows(200, 10**6, [6.0, 3.0, 0.0])), "gnss-jumps", "warning"),
    "no fix has a class": (gnss_with(fix=np.zeros_like), "fix-none", "warning"),
    "slip, or a radius too large": (radius(1.5 * RADIUS_M), "wheel-scale", "warning"),
    "radius of another robot": (radius(RADIUS_M / 2.5), "wheel-radius", "warning"),
    "rev/s or m/s": (wheels_with(scaled(1 / 6.17)), "wheel-unit", "error"),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_the_data_leave_open_is_found_and_left(name: str) -> None:
    corrupt, code, severity = FOUND[name]
    corrupted = corrupt(lively_drive())
    found = {finding.code: finding for finding in run_checks(corrupted)}
    assert code in found, sorted(found)
    assert found[code].severity == severity
    assert found[code].repair is None
    _, done = repair(corrupted)
    assert code not in [finding.code for finding in done]


def test_slip_on_soft_ground_is_no_finding() -> None:
    slipping = dataclasses.replace(radius(1.5 * RADIUS_M)(lively_drive()), terrain_name="mud")
    assert run_checks(slipping) == []


def test_the_gyro_is_assumed_where_nothing_decides() -> None:
    bare = without(lively_drive(), "gnss", "truth", "command")
    assert bare.imu is not None
    gyro_only = imu_with(
        gyro_radps=times(np.nan, np.nan, -1.0), accel_mps2=lambda a: np.full_like(a, np.nan)
    )(bare)
    found = run_checks(gyro_only)
    assert [finding.code for finding in found] == ["yaw-sign"]
    assert "assumed" in found[0].fix
    repaired, _ = repair(gyro_only)
    assert any("assumed" in note for note in repaired.notes)


def test_two_faults_of_one_kind_are_both_repaired() -> None:
    """A second dead wheel must not be taken for a wrong radius."""
    good = four_wheels(lively_drive())
    assert good.wheels is not None
    dead = good.wheels.speed * [0.0, 0.0, 1.0, 1.0]
    corrupted = dataclasses.replace(good, wheels=dataclasses.replace(good.wheels, speed=dead))
    repaired, done = repair(corrupted)
    assert [finding.code for finding in done].count("wheel-odd") == 2
    assert repaired.overrides.wheel_radius_m == good.overrides.wheel_radius_m
    assert "wheel-odd" not in {finding.code for finding in run_checks(repaired)}


def test_one_reversed_speed_is_the_wheels_own() -> None:
    good = body_speed(lively_drive())
    assert good.wheels is not None
    corrupted = dataclasses.replace(good, wheels=dataclasses.replace(good.wheels, speed=-good.wheels.speed))
    repaired, done = repair(corrupted)
    assert [finding.code for finding in done] == ["wheel-reversed"]
    assert run_checks(repaired) == []
    assert repaired.wheels is not None
    np.testing.assert_allclose(repaired.wheels.speed, good.wheels.speed)


def body_speed(r: Recording) -> Recording:
    assert r.wheels is not None
    mean = r.wheels.speed.mean(axis=1, keepdims=True)
    return dataclasses.replace(r, wheels=Wheels(r.wheels.t_ns, mean, ("speed",), "radps"))
