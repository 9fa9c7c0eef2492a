"""DRIVE of Norlab as published: each convention has a check that fails where it is flipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.readers import open_recording, open_recordings
from tests.datasets.conftest import CatalogWith
from tests.datasets.norlab_checks import (
    accelerations,
    changing_share,
    codes,
    joined,
    lag_behind_gyro,
    speeds,
    yaw_correlation,
    yaw_errors,
)

DRIVES = (
    "asphalt_2024_9_20_8h13s12",
    "asphalt_2024_9_25_12h8s57",
    "grass_2024_7_29_14h46s15",
    "grass_2024_7_29_14h4s53",
    "grass_2024_8_8_15h56s39",
    "grass_2024_8_8_16h11s19",
)
WINDOWS = {
    "asphalt_2024_8_7_11h30s30": 300,
    "asphalt_2024_9_20_8h13s12": 12,
    "asphalt_2024_9_20_9h27s52": 300,
    "asphalt_2024_9_25_12h8s57": 30,
    "grass_2024_7_29_14h46s15": 60,
    "grass_2024_7_29_14h4s53": 9,
    "grass_2024_8_8_15h56s39": 30,
    "grass_2024_8_8_16h11s19": 30,
    "gravel_2024_8_6_11h37s32": 300,
    "ice_2024_7_30_16h30s21": 300,
    "sand_2024_9_25_14h13s47": 300,
    "sand_2024_9_25_14h32s32": 300,
}
TURNED = ("grass_2024_7_29_14h46s15", "gravel_2024_8_6_11h37s32", "ice_2024_7_30_16h30s21")


def drive_file(root: Path, name: str) -> Path:
    return root / "norlab_drive" / f"warthog_wheels_{name}" / "raw_dataframe.pkl"


def window_file(root: Path, name: str) -> Path:
    return root / "norlab_drive" / f"warthog_wheels_{name}" / "slip_dataset_all.pkl"


@pytest.mark.parametrize("name", DRIVES)
def test_a_drive(published: Path, name: str) -> None:
    drive = open_recording(drive_file(published, name))
    assert drive.vehicle == "warthog"
    assert drive.terrain_name == name.split("_")[0]
    assert drive.licence == "BSD-3-Clause"
    assert drive.truth_channels == ("position", "yaw", "orientation")
    assert set(drive.channels()) == {"command", "wheels", "imu", "motor", "terrain"}
    assert yaw_correlation([drive]) > 0.97
    r, ratio = speeds(drive)
    assert r > 0.9
    assert 0.9 < ratio < 1.15
    ahead, across = accelerations(drive)
    assert ahead > 0.3
    assert across > 0.3
    assert not codes(drive) & {"yaw-sign", "imu-axes", "wheel-sign", "held-values"}


@pytest.mark.parametrize("name", DRIVES)
def test_lags_of_a_drive_are_taken_off(published: Path, name: str) -> None:
    drive = open_recording(drive_file(published, name))
    assert abs(lag_behind_gyro(drive, "wheels").seconds) < 0.03
    assert abs(lag_behind_gyro(drive, "truth").seconds) < 0.06


@pytest.mark.parametrize("what", ["wheels", "truth"])
def test_a_wrong_lag_is_seen(published: Path, catalog_with: CatalogWith, what: str) -> None:
    catalog_with("norlab_drive", lag_s={"wheels": 0.0, "truth": 0.0})
    lag = lag_behind_gyro(open_recording(drive_file(published, DRIVES[3])), what)
    assert lag.low_s > 0.05
    assert lag.seconds > 0.12


def test_signs_and_axes_the_other_way_are_seen(published: Path, catalog_with: CatalogWith) -> None:
    path = drive_file(published, DRIVES[2])
    catalog_with("norlab_drive", gyro_z_sign=-1.0)
    drive = open_recording(path)
    assert yaw_correlation([drive]) < -0.97
    assert "yaw-sign" in codes(drive)
    catalog_with("norlab_drive", imu_axes=["+x", "-y", "-z"])
    assert "imu-axes" in codes(open_recording(path))
    catalog_with("norlab_drive", imu_axes=["-x", "-y", "+z"])
    ahead, across = accelerations(open_recording(path))
    assert ahead < -0.3
    assert across < -0.3
    for side in ("left_wheels_sign", "right_wheels_sign"):
        catalog_with("norlab_drive", **{side: -1.0})
        assert abs(speeds(open_recording(path))[0]) < 0.7
    catalog_with("norlab_drive", wheel_radius_m=0.15)
    assert speeds(open_recording(path))[1] > 1.8


def test_held_rows_are_seen_where_they_are_kept(published: Path, catalog_with: CatalogWith) -> None:
    path = drive_file(published, DRIVES[1])
    drive = open_recording(path)
    assert changing_share(drive, "imu") == changing_share(drive, "truth") == 1.0
    assert changing_share(drive, "wheels") > 0.8
    assert changing_share(drive, "motor") > 0.8
    catalog_with("norlab_drive", held={})
    held = open_recording(path)
    assert changing_share(held, "wheels") < 0.4
    assert changing_share(held, "truth") < 0.55
    assert changing_share(held, "motor") < 0.1
    assert "held-values" in codes(held)


@pytest.mark.parametrize("name", DRIVES)
def test_runs_of_rows_are_as_the_catalogue_has_them(
    published: Path, name: str, catalog_with: CatalogWith
) -> None:
    catalog_with("norlab_drive", held={})
    drive = open_recording(drive_file(published, name))
    assert drive.wheels is not None
    assert drive.motor is not None
    runs = [np.diff(np.flatnonzero(np.diff(side) != 0)) for side in drive.wheels.speed.T]
    assert all(np.mean((run == 5) | (run == 6)) > 0.9 for run in runs)
    left, right = (np.flatnonzero(np.diff(side) != 0) for side in drive.wheels.speed.T)
    later = right[np.minimum(np.searchsorted(right, left), len(right) - 1)] - left
    assert np.mean(later == 2) > 0.85
    for current in drive.motor.current_a.T:
        run = np.diff(np.flatnonzero(np.diff(current) != 0))
        assert np.mean(np.abs(run % 20 - 10) >= 9) > 0.9


@pytest.mark.parametrize("name", WINDOWS)
def test_windows(published: Path, name: str) -> None:
    windows = open_recordings(window_file(published, name))
    assert len(windows) == WINDOWS[name]
    ground = name.split("_")[0]
    assert {w.terrain_name for w in windows} == {"loose_sand" if ground == "sand" else ground}
    assert not any("against the wheels" in note for note in windows[0].notes)
    assert yaw_correlation(windows) > 0.85
    assert all(w.wheels is not None and 8 <= len(w.wheels) <= 20 for w in windows)
    whole = joined(windows)
    assert not codes(whole) & {"yaw-sign", "imu-axes", "wheel-sign"}


@pytest.mark.parametrize("name", TURNED)
def test_windows_that_turn_the_other_way(published: Path, name: str, catalog_with: CatalogWith) -> None:
    catalog_with("norlab_drive", gyro_z_sign=1.0)
    windows = open_recordings(window_file(published, name))
    assert yaw_correlation(windows) < -0.85
    assert any("against the wheels" in note for note in windows[0].notes)
    assert "yaw-sign" in codes(joined(windows))


def test_yaw_of_the_truth_is_not_scored_on_sand(published: Path) -> None:
    for name in ("sand_2024_9_25_14h13s47", "sand_2024_9_25_14h32s32"):
        windows = open_recordings(window_file(published, name))
        assert windows[0].truth_channels == ("position",)
        assert windows[0].truth is not None
        assert windows[0].truth.quaternion is None
    for name in ("ice_2024_7_30_16h30s21", "gravel_2024_8_6_11h37s32"):
        windows = open_recordings(window_file(published, name))
        assert "yaw" in windows[0].truth_channels
        assert np.mean(yaw_errors(windows) > 0.3) < 0.2
