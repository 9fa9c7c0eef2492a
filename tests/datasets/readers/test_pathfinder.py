"""Pathfinder workspaces: axes, signs, radius, lags and the fixes' clock, published and synthetic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.checks import run_checks
from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.lag import lag_between
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from tests.datasets.conftest import CatalogWith
from tests.datasets.pathfinder_files import (
    DATUM,
    RADIUS_M,
    SECONDS,
    START_S,
    TRACK_M,
    WEEK_START_S,
    fixes,
    save,
    workspace,
)

# --- physical checks ---------------------------------------------------------------------------------------


def seconds(t_ns: np.ndarray, recording: Recording) -> np.ndarray:
    return np.asarray((t_ns - recording.start_ns) * 1e-9)


def means(t_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Means over the intervals of a grid."""
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    return np.asarray(np.diff(np.interp(grid, t_s, area)) / np.diff(grid))


def checks(recording: Recording) -> dict[str, float]:
    """What physics says of signs and axes: correlations that are positive, and mean gravity."""
    imu, wheels = recording.imu, recording.wheels
    assert imu is not None
    assert wheels is not None
    t_imu, t = seconds(imu.t_ns, recording), seconds(wheels.t_ns, recording)
    grid = np.arange(max(t[0], t_imu[0]), min(t[-1], t_imu[-1]), 0.5)
    sides = wheels.side_speeds_mps(RADIUS_M)
    v, turn = means(t, sides.mean(axis=1), grid), means(t, sides[:, 1] - sides[:, 0], grid)
    x, y, rate = (
        means(t_imu, column, grid)
        for column in (imu.accel_mps2[:, 0], imu.accel_mps2[:, 1], imu.gyro_radps[:, 2])
    )
    return {
        "yaw": float(np.corrcoef(turn, rate)[0, 1]),
        "ahead": float(np.corrcoef(x, np.gradient(v, 0.5))[0, 1]),
        "across": float(np.corrcoef(y, v * rate)[0, 1]),
        "gravity": float(imu.accel_mps2[:, 2].mean()),
        "forward": float(v.mean()),
        "track": float((turn @ turn) / (turn @ rate)),
    }


def wheel_lag_s(recording: Recording) -> float:
    """Seconds by which the wheels' turning lags gyro z."""
    imu, wheels = recording.imu, recording.wheels
    assert imu is not None
    assert wheels is not None
    sides = wheels.side_speeds_mps(RADIUS_M)
    lag = lag_between(
        seconds(imu.t_ns, recording),
        imu.gyro_radps[:, 2],
        seconds(wheels.t_ns, recording),
        sides[:, 1] - sides[:, 0],
    )
    assert lag is not None
    return lag.seconds


def gnss_lag_s(recording: Recording) -> float:
    """Seconds by which the speed of the fixes lags that of the wheels."""
    gnss, wheels = recording.gnss, recording.wheels
    assert gnss is not None
    assert wheels is not None
    t = seconds(gnss.t_ns, recording)
    speed = np.hypot(*np.diff(gnss.enu_m[:, :2], axis=0).T) / np.diff(t)
    v = np.abs(wheels.side_speeds_mps(RADIUS_M).mean(axis=1))
    lag = lag_between(seconds(wheels.t_ns, recording), v, 0.5 * (t[1:] + t[:-1]), speed)
    assert lag is not None
    return lag.seconds


def chord_over_wheels(recording: Recording) -> float:
    """Distance between first and last fix over that of the wheels between their times."""
    gnss, wheels = recording.gnss, recording.wheels
    assert gnss is not None
    assert wheels is not None
    radius = recording.overrides.wheel_radius_m or 1.0
    t = seconds(wheels.t_ns, recording)
    v = wheels.side_speeds_mps(radius).mean(axis=1)
    rolled = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    at = seconds(gnss.t_ns[[0, -1]], recording)
    chord = np.linalg.norm(gnss.enu_m[-1, :2] - gnss.enu_m[0, :2])
    return float(chord / np.diff(np.interp(at, t, rolled))[0])


def codes(recording: Recording) -> set[str]:
    return {finding.code for finding in run_checks(recording)}


# --- the published files -----------------------------------------------------------------------------------


@pytest.fixture
def s5t1(published: Path) -> Path:
    return published / "wvu_pathfinder" / "s5t1.mat"


@pytest.fixture
def run17(published: Path) -> Path:
    return published / "wvu_pathfinder" / "test17run.mat"


def test_s5t1(s5t1: Path) -> None:
    r = open_recording(s5t1)
    assert {name: len(c) for name, c in r.channels().items()} == {"wheels": 1770, "imu": 44249, "gnss": 1770}
    found = checks(r)
    assert found["yaw"] > 0.95
    assert found["ahead"] > 0.6
    assert found["across"] > 0.3
    assert 9.7 < found["gravity"] < 9.9
    assert found["forward"] > 0.3
    assert abs(found["track"] - TRACK_M) < 0.05
    assert abs(wheel_lag_s(r)) < 0.02
    assert r.gnss is not None
    assert set(r.gnss.fix.tolist()) == {Fix.SINGLE}
    assert 1.5 < r.gnss.sigma_enu_m[:, 0].min() < r.gnss.sigma_enu_m[:, 1].max() < 3.4
    assert r.truth is None
    assert not codes(r) & {"yaw-sign", "imu-axes", "wheel-sign", "wheel-scale", "held-values"}
    assert any("dead reckoning" in note for note in r.notes)


def test_test17run(run17: Path) -> None:
    r = open_recording(run17)
    assert {name: len(c) for name, c in r.channels().items()} == {"wheels": 705, "imu": 17611, "gnss": 705}
    assert checks(r)["forward"] > 0.3
    assert abs(wheel_lag_s(r)) < 0.02
    assert r.gnss is not None
    assert set(r.gnss.fix.tolist()) == {Fix.FIXED}
    assert abs(chord_over_wheels(r) - 1.0) < 0.01
    assert any("20 epochs are missing" in note for note in r.notes)
    assert any("no sigmas in the file; taken for fixed" in note for note in r.notes)
    assert r.datum is not None
    assert abs(r.datum[0] - 39.64575) < 1e-5


def test_fixes_of_test17run_run_on_gps_time(run17: Path) -> None:
    """Their table's clock agrees with the wheels; row for row with the wheels they do not fit."""
    r = open_recording(run17)
    assert r.gnss is not None
    assert r.wheels is not None
    assert set(np.rint(np.diff(r.gnss.t_ns) * 1e-8).tolist()) == {1.0, 2.0, 3.0}
    assert abs(gnss_lag_s(r)) < 0.1
    driven = np.flatnonzero(np.abs(r.wheels.side_speeds_mps(RADIUS_M).mean(axis=1)) > 0.3)
    t = seconds(r.gnss.t_ns, r)
    moving = np.flatnonzero(np.hypot(*np.diff(r.gnss.enu_m[:, :2], axis=0).T) / np.diff(t) > 0.3)
    for row in (0, -1):
        assert abs(t[moving[row]] - seconds(r.wheels.t_ns, r)[driven[row]]) < 0.3
    assert driven[-1] - moving[-1] > 10, "by rows the fixes would stop more than 1 s before the wheels"
    assert abs(driven[0] - moving[0]) < 3, "though they start together"


FLIPS: dict[str, tuple[Any, str]] = {
    "imu_axes": (["+x", "+y", "+z"], "gravity"),
    "left_wheels_sign": (1.0, "forward"),
    "gyro_z_sign": (-1.0, "yaw"),
}


@pytest.mark.parametrize("name", FLIPS)
def test_a_flipped_convention_is_seen(name: str, s5t1: Path, catalog_with: CatalogWith) -> None:
    value, check = FLIPS[name]
    assert checks(open_recording(s5t1))[check] > 0.2
    catalog_with("wvu_pathfinder", **{name: value})
    flipped = open_recording(s5t1)
    assert checks(flipped)[check] < 0.1
    expected = {"imu_axes": "imu-axes", "left_wheels_sign": "wheel-sign", "gyro_z_sign": "yaw-sign"}
    assert expected[name] in codes(flipped)


def test_axes_turned_about_z_are_seen(s5t1: Path, catalog_with: CatalogWith) -> None:
    catalog_with("wvu_pathfinder", imu_axes=["-x", "+y", "-z"])
    turned = checks(open_recording(s5t1))
    assert turned["ahead"] < -0.6
    assert turned["across"] < -0.3


def test_another_radius_and_lag_are_seen(run17: Path, catalog_with: CatalogWith) -> None:
    catalog_with("wvu_pathfinder", wheel_radius_m=0.11, lag_s={"wheels": 0.0})
    r = open_recording(run17)
    assert 1.04 < chord_over_wheels(r) < 1.07, "the radius of the rover's odometry is 5 % short"
    assert 0.14 < wheel_lag_s(r) < 0.18


def test_angles_are_two_percent_short_of_the_rates(s5t1: Path) -> None:
    wheels = open_recording(s5t1).wheels
    assert wheels is not None
    assert wheels.angle_rad is not None
    t = (wheels.t_ns - wheels.t_ns[0]) * 1e-9
    ratio = (wheels.angle_rad[-1] - wheels.angle_rad[0]) / np.trapezoid(wheels.speed, t, axis=0)
    np.testing.assert_allclose(ratio, 0.9815, atol=0.001)


# --- synthetic files ---------------------------------------------------------------------------------------


def test_a_synthetic_workspace(tmp_path: Path) -> None:
    r = open_recording(save(tmp_path / "any.mat", workspace()))
    assert r.wheels is not None
    assert r.imu is not None
    assert r.gnss is None
    assert r.vehicle == "pathfinder"
    found = checks(r)
    assert min(found["yaw"], found["ahead"], found["across"]) > 0.7
    assert abs(found["track"] - TRACK_M) < 0.1
    assert found["gravity"] > 9.7
    assert r.imu.t_ns[1] - r.imu.t_ns[0] in range(3_999_000, 4_001_000)
    assert r.wheels.angle_rad is not None
    assert (r.wheels.angle_rad[-1] > 50.0).all()
    assert any("not in the catalogue" in note for note in r.notes)


def test_synthetic_conventions_flipped(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(tmp_path / "any.mat", workspace())
    for name, (value, check) in FLIPS.items():
        catalog_with("wvu_pathfinder", **{name: value})
        assert checks(open_recording(path))[check] < 0.1
    catalog_with("wvu_pathfinder", lag_s={"wheels": 0.4})
    assert -0.45 < wheel_lag_s(open_recording(path)) < -0.35


def test_times_of_a_table_with_gaps(tmp_path: Path) -> None:
    t = np.delete(np.arange(-0.2, 55.0, 0.1), [100, 101, 250, 251, 252, 400])
    week = START_S + 18 - WEEK_START_S + t
    r = open_recording(save(tmp_path / "any.mat", workspace() | fixes(t), np.round(week, 3)))
    assert r.gnss is not None
    assert abs(seconds(r.gnss.t_ns[:1], r)[0] + 0.2) < 0.002
    assert any("6 epochs are missing" in note and "-0.20 s" in note for note in r.notes)
    assert set(r.gnss.fix.tolist()) == {Fix.FIXED}
    assert r.datum is not None
    np.testing.assert_allclose(r.datum, DATUM, atol=1e-6)


def test_fixes_without_times_are_left_out(tmp_path: Path) -> None:
    r = open_recording(save(tmp_path / "any.mat", workspace() | fixes(np.arange(0.0, SECONDS, 0.1))))
    assert r.gnss is None
    assert any("no times in the file; left out" in note for note in r.notes)


def test_sigmas_and_times_of_receipt(tmp_path: Path) -> None:
    t = np.arange(0.0, SECONDS, 0.1) + 0.27
    for level, fix in ((2.0, Fix.SINGLE), (0.2, Fix.FLOAT), (0.02, Fix.FIXED)):
        sigmas = {
            f"{n}Sigma": np.full(len(t), level * k) for n, k in (("Lat", 1.3), ("Lon", 1.0), ("Height", 2))
        }
        table = workspace() | fixes(t) | sigmas | {"tTGPS": START_S + t}
        r = open_recording(save(tmp_path / "any.mat", table))
        assert r.gnss is not None
        assert set(r.gnss.fix.tolist()) == {fix}
        np.testing.assert_allclose(r.gnss.sigma_enu_m[0], [level, 1.3 * level, 2 * level])
        assert abs(seconds(r.gnss.t_ns[:1], r)[0] - 0.27) < 1e-6


def test_enu_that_is_not_llh_is_told(tmp_path: Path) -> None:
    t = np.arange(0.0, SECONDS, 0.1)
    table = workspace() | fixes(t) | {"tTGPS": START_S + t}
    right = open_recording(save(tmp_path / "a.mat", table)).gnss
    table["ENUGPS"] = table["ENUGPS"][:, [1, 0, 2]]
    r = open_recording(save(tmp_path / "b.mat", table))
    assert any("ENUGPS is up to" in note and "llhGPS is taken" in note for note in r.notes)
    assert r.gnss is not None
    assert right is not None
    np.testing.assert_array_equal(r.gnss.enu_m, right.enu_m)
