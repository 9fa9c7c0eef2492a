"""DRIVE tables made here: what is read, dropped and told, and tables that are refused."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording, open_recordings
from tests.datasets.conftest import CatalogWith
from tests.datasets.norlab_checks import (
    RADIUS_M,
    START_NS,
    TRACK_M,
    changing_share,
    codes,
    lag_behind_gyro,
    yaw_correlation,
)


def drive_table(rows: int = 1200) -> pd.DataFrame:
    """60 s as the drives are published: texts, zeros before the first messages, held rows, a row of zeros."""
    t = np.arange(rows) * 0.05
    v, rate = 1.0 + 0.4 * np.sin(0.7 * t), 0.5 * np.sin(0.9 * t) + 0.2 * np.sin(2.3 * t)
    yaw = np.cumsum(rate) * 0.05
    x, y = np.cumsum(v * np.cos(yaw)) * 0.05, np.cumsum(v * np.sin(yaw)) * 0.05
    late = np.maximum(np.arange(rows) // 5 * 5 - 3, 0)  # new every 5 rows, of 0.15 s before
    scanned = np.maximum(np.arange(rows) // 2 * 2 - 7, 0)
    table = {
        "ros_time": START_NS + np.arange(rows) * 50_000_000,
        "calib_state": np.where(t < 10.0, "idle", "calib"),
        "meas_left_vel": ((v - rate * TRACK_M / 2) / RADIUS_M)[late],
        "meas_right_vel": ((v + rate * TRACK_M / 2) / RADIUS_M)[late],
        "cmd_vel_x": v,
        "cmd_vel_omega": rate,
        "icp_pos_x": x[scanned],
        "icp_pos_y": y[scanned],
        "icp_pos_z": 0.01 * t[scanned],
        "icp_quat_x": 0.0 * t,
        "icp_quat_y": 0.0 * t,
        "icp_quat_z": np.sin(yaw / 2)[scanned],
        "icp_quat_w": np.cos(yaw / 2)[scanned],
        "imu_x": 1e-3 * np.sin(31.0 * t),
        "imu_y": 1e-3 * np.cos(31.0 * t),
        "imu_z": rate,
        "imu_acceleration_x": np.gradient(v, 0.05),
        "imu_acceleration_y": v * rate,
        "imu_acceleration_z": 9.81 + 0.1 * np.sin(29.0 * t),
        "left_wheel_voltage": 48.0 + 0.0 * t,
        "right_wheel_voltage": 47.5 + 0.0 * t,
        "left_wheel_current": (5.0 + 0.1 * t)[np.arange(rows) // 20 * 20],
        "right_wheel_current": (4.0 + 0.1 * t)[np.arange(rows) // 20 * 20],
    }
    frame = pd.DataFrame({name: [str(cell) for cell in column.tolist()] for name, column in table.items()})
    frame.loc[:29, [c for c in frame if c.startswith(("left_", "right_", "meas_"))]] = "0.0"
    frame.loc[:3, [c for c in frame if c.startswith("imu_")]] = "0.0"
    frame.loc[:9, [c for c in frame if c.startswith("icp_")]] = "0.0"
    frame.loc[:9, "icp_quat_w"] = "1.0"
    frame.loc[0] = "0.0"
    return frame


def window_table(count: int = 30) -> pd.DataFrame:
    """Windows of 2 s: three a command step, left turns and right turns of several speeds."""
    rng = np.random.default_rng(3)
    rows: dict[str, list[float]] = {}
    for k in range(count):
        step = np.random.default_rng(k // 3)
        v, rate = step.uniform(-2.0, 2.0), step.uniform(-1.0, 1.0)
        t = np.arange(40) * 0.05
        signals = {
            "cmd_left": 0.0 * t + (v - rate * TRACK_M / 2) / RADIUS_M,
            "cmd_right": 0.0 * t + (v + rate * TRACK_M / 2) / RADIUS_M,
            "left_wheel_vel": np.repeat((v - rate * TRACK_M / 2) / RADIUS_M + rng.normal(0, 0.1, 8), 5),
            "right_wheel_vel": np.repeat((v + rate * TRACK_M / 2) / RADIUS_M + rng.normal(0, 0.1, 8), 5),
            "imu_yaw": rate + rng.normal(0.0, 0.01, 40),
            **{
                f"icp_{n}": np.repeat(f(t[::4]), 4)
                for n, f in (("x", lambda s, v=v: v * s), ("y", np.zeros_like))
            },
            **{f"icp_{n}": 0.0 * t for n in ("z", "roll", "pitch")},
            "icp_yaw": np.repeat(rate * t[::4], 4),
            **{
                f"imu_acceleration_{a}": g + rng.normal(0, 0.1, 40)
                for a, g in zip("xyz", (0, 0, 9.8), strict=True)
            },
        }
        for name, values in signals.items():
            for i, value in enumerate(values):
                rows.setdefault(f"{name}_{i}", []).append(float(value))
        rows.setdefault("calib_step", []).append(float(k // 3))
        rows.setdefault("transitory_state_mask", []).append(float(k % 3 == 0))
        rows.setdefault("steady_state_mask", []).append(float(k % 3 != 0))
    return pd.DataFrame(rows)


def save(frame: pd.DataFrame, tmp_path: Path, folder: str = "warthog_wheels_gravel_2025_1_1_1h1s1") -> Path:
    path = tmp_path / folder / "any_name.pkl"
    path.parent.mkdir(exist_ok=True)
    frame.to_pickle(path)
    return path


def test_an_unknown_hash_is_refused(tmp_path: Path) -> None:
    path = save(drive_table(), tmp_path)
    with pytest.raises(DataError, match=r"SHA-256 [0-9a-f]{64}\) is in no catalogue; .*TERRAFUSION_CATALOG"):
        open_recordings(path)


def test_a_huge_pickle_is_not_even_hashed(tmp_path: Path) -> None:
    path = tmp_path / "huge.pkl"
    with path.open("wb") as file:
        file.write(b"\x80\x04")
        file.truncate(40 << 30)
    with pytest.raises(DataError, match="40960 MiB"):
        open_recordings(path)


def test_a_synthetic_drive(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(drive_table(), tmp_path)
    catalog_with("norlab_drive", {path: "any/raw"}, held={}, lag_s={})
    drive = open_recording(path)
    assert drive.imu is not None
    assert drive.imu.t_ns[0] == START_NS + 4 * 50_000_000, "to the nanosecond"
    assert drive.start_ns == START_NS + 50_000_000
    assert drive.wheels is not None
    assert drive.wheels.t_ns[0] == START_NS + 30 * 50_000_000, "zeros before the motors were on"
    assert drive.command is not None
    assert drive.command.t_ns[0] == START_NS + 200 * 50_000_000, "a person drove before"
    assert drive.truth is not None
    assert drive.truth.t_ns[0] == START_NS + 10 * 50_000_000, "the identity before the first pose"
    assert drive.motor is not None
    assert drive.motor.voltage_v is not None
    np.testing.assert_array_equal(drive.motor.voltage_v[-1], [48.0, 47.5])
    assert drive.terrain_name == "gravel"
    for words in ("first 1 row,", "4? ?rows? of zeros before its first message", "calibration driver"):
        assert any(re.search(words, note) for note in drive.notes), words


def test_conventions_on_a_synthetic_drive(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(drive_table(), tmp_path)
    right = {
        "held": {"wheels": 5.0, "truth": 10000.0, "motor": 20.0},
        "lag_s": {"wheels": 0.15, "truth": 0.35},
    }
    catalog_with("norlab_drive", {path: "any/raw"}, **right)
    drive = open_recording(path)
    assert yaw_correlation([drive]) > 0.97
    assert abs(lag_behind_gyro(drive, "wheels").seconds) < 0.04
    assert abs(lag_behind_gyro(drive, "truth").seconds) < 0.04
    assert changing_share(drive, "wheels") == changing_share(drive, "truth") == 1.0
    catalog_with("norlab_drive", {path: "any/raw"}, **(right | {"lag_s": {"wheels": -0.15, "truth": -0.35}}))
    drive = open_recording(path)
    assert lag_behind_gyro(drive, "wheels").seconds > 0.25
    assert lag_behind_gyro(drive, "truth").seconds > 0.6
    catalog_with("norlab_drive", {path: "any/raw"}, **right, gyro_z_sign=-1.0)
    assert "yaw-sign" in codes(open_recording(path))


def test_synthetic_windows(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(window_table(), tmp_path)
    catalog_with("norlab_drive", {path: "any/windows"}, lag_s={})
    windows = open_recordings(path)
    assert len(windows) == 30
    third = open_recording(f"{path}#5")
    assert third.name.endswith("#5")
    assert third.description.startswith("step 2, window 3 of 3, steady")
    assert third.start_ns == 4_000_000_000
    assert third.imu is not None
    assert np.isnan(third.imu.gyro_radps[:, :2]).all()
    assert third.command is not None
    assert third.wheels is not None
    step = np.random.default_rng(1)
    v, rate = step.uniform(-2.0, 2.0), step.uniform(-1.0, 1.0)
    np.testing.assert_allclose(third.command.v_mps, v)
    np.testing.assert_allclose(third.command.yaw_rate_radps, rate)
    assert third.truth is not None
    assert len(third.truth) == (10 if rate else 1)
    np.testing.assert_allclose(third.truth.yaw_rad()[-1], rate * 1.8)
    assert yaw_correlation(windows) > 0.95
    assert not any("against" in note for note in third.notes)


def test_a_turned_gyro_in_windows_is_told(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(window_table(), tmp_path)
    catalog_with("norlab_drive", {path: "any/windows"}, gyro_z_sign=-1.0)
    notes = open_recordings(path)[0].notes
    assert any("over the 30 windows the yaw rate turns against the wheels (r -" in note for note in notes)


def test_a_drive_without_motors_and_states(tmp_path: Path, catalog_with: CatalogWith) -> None:
    frame = drive_table(400)
    zero = frame.assign(left_wheel_voltage="0.0", right_wheel_voltage="0.0")
    bare = frame.drop(columns=["left_wheel_current", "calib_state"])
    for table, words in ((zero, "zero throughout"), (bare, "no currents and voltages")):
        path = save(table, tmp_path)
        catalog_with("norlab_drive", {path: "any/raw"}, held={})
        drive = open_recording(path)
        assert drive.motor is None
        assert drive.wheels is not None
        assert len(drive.wheels) == 399
        assert any(words in note for note in drive.notes)
    assert drive.command is not None
    assert len(drive.command) == 399


def test_times_of_other_kinds(tmp_path: Path, catalog_with: CatalogWith) -> None:
    """Whole numbers stay exact; doubles are read, and said to be less so."""
    frame = drive_table(300)
    for kind, exact in ((np.int64, True), (float, False)):
        stamps = np.array([int(cell.split(".")[0]) for cell in frame["ros_time"]]).astype(kind)
        path = save(frame.assign(ros_time=stamps), tmp_path)
        catalog_with("norlab_drive", {path: "any/raw"})
        drive = open_recording(path)
        assert (drive.start_ns == START_NS + 50_000_000) == exact
        assert abs(drive.start_ns - START_NS - 50_000_000) < 300
        assert any("stored as doubles" in note for note in drive.notes) != exact


def test_poses_without_a_quaternion_are_left_out(tmp_path: Path, catalog_with: CatalogWith) -> None:
    frame = drive_table(200)
    frame.loc[50:52, ["icp_quat_z", "icp_quat_w"]] = "0.0"
    path = save(frame, tmp_path)
    catalog_with("norlab_drive", {path: "any/raw"}, held={})
    drive = open_recording(path)
    assert drive.truth is not None
    assert len(drive.truth) == 200 - 10 - 3
    assert any("3 poses without a unit quaternion" in note for note in drive.notes)


def test_another_robots_folder_is_told(tmp_path: Path, catalog_with: CatalogWith) -> None:
    path = save(drive_table(300), tmp_path, "husky_wheels_snow_2025_1_1")
    catalog_with("norlab_drive", {path: "any/raw"})
    assert any("another robot's" in note for note in open_recording(path).notes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.drop(columns="imu_z"), "'imu_z' is missing"),
        (lambda f: f.rename(columns={"ros_time": "time"}), "neither the columns of a drive"),
        (lambda f: f.assign(imu_z="fast"), "could not convert"),
        (lambda f: f.assign(ros_time="0.0"), "no row has a time"),
        (lambda f: f.assign(ros_time=["0.0", *f["ros_time"][:0:-1]]), "backwards"),
        (lambda f: f.assign(ros_time="9" * 30), "cannot be read"),
        (lambda f: f.assign(ros_time=[None] * len(f)), "cannot be read"),
        (lambda f: f.assign(imu_z="inf"), "a number beyond 1e"),
        (lambda f: window_table(9).assign(imu_yaw_3=1e200), "a number beyond 1e"),
        (lambda f: f.iloc[:0], "no row has a time"),
        (lambda f: window_table(3).iloc[:0], "holds no windows"),
        (lambda f: window_table(3).drop(columns="icp_x_7"), "'icp_x_7' is missing"),
    ],
)
def test_tables_that_are_no_drive(change, words: str, tmp_path: Path, catalog_with: CatalogWith) -> None:  # type: ignore[no-untyped-def]
    path = save(change(drive_table(100)), tmp_path)
    catalog_with("norlab_drive", {path: "any/raw"})
    with pytest.raises(DataError, match=words) as refusal:
        open_recordings(path)
    assert str(path) in str(refusal.value)


def test_fields_of_the_drive_survive_replace(tmp_path: Path, catalog_with: CatalogWith) -> None:
    """Readers give plain recordings: nothing hangs on the pickle."""
    path = save(drive_table(300), tmp_path)
    catalog_with("norlab_drive", {path: "any/raw"})
    drive = open_recording(path)
    path.unlink()
    assert dataclasses.replace(drive, name="x").channels().keys() == drive.channels().keys()
