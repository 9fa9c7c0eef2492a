"""DRIVE of Norlab: drives and windows, published and synthetic; each convention has a check that can fail."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.doctor import examine
from terrafusion.datasets.errors import DataError
from terrafusion.datasets.lag import Lag, lag_between
from terrafusion.datasets.readers import open_recording, open_recordings
from terrafusion.datasets.recording import Imu, Recording, Wheels

from .conftest import CatalogWith

RADIUS_M, TRACK_M = 0.3, 1.08
START_NS = 1_722_278_749_529_941_023
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


# --- physical checks ---------------------------------------------------------------------------------------


def seconds(channel: object) -> np.ndarray:
    t_ns = channel.t_ns  # type: ignore[attr-defined]
    return np.asarray((t_ns - START_NS) * 1e-9)


def turn(recording: Recording) -> np.ndarray:
    """Right less left side speed, m/s."""
    assert recording.wheels is not None
    sides = recording.wheels.side_speeds_mps(RADIUS_M)
    return np.asarray(sides[:, 1] - sides[:, 0])


def means(t_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Means over the intervals of a grid."""
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t_s))])
    return np.asarray(np.diff(np.interp(grid, t_s, area)) / np.diff(grid))


def yaw_correlation(recordings: Sequence[Recording]) -> float:
    """Gyro z with the wheels' turning: half-second means of a drive, or means of windows."""
    if len(recordings) > 1:
        pairs = [(turn(r).mean(), r.imu.gyro_radps[:, 2].mean()) for r in recordings]  # type: ignore[union-attr]
        return float(np.corrcoef(np.array(pairs).T)[0, 1])
    (r,) = recordings
    assert r.imu is not None
    assert r.wheels is not None
    grid = np.arange(*(seconds(r.wheels)[[0, -1]]), 0.5)
    by_wheels = means(seconds(r.wheels), turn(r), grid)
    return float(np.corrcoef(by_wheels, means(seconds(r.imu), r.imu.gyro_radps[:, 2], grid))[0, 1])


def truth_rates(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mid-times, speed ahead and yaw rate between poses of the truth."""
    truth = recording.truth
    assert truth is not None
    t, yaw = seconds(truth), np.unwrap(truth.yaw_rad())
    dt, middle = np.diff(t), 0.5 * (yaw[1:] + yaw[:-1])
    step = np.diff(truth.position_m[:, :2], axis=0)
    ahead = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / dt
    return 0.5 * (t[1:] + t[:-1]), ahead, np.diff(yaw) / dt


def speeds(recording: Recording) -> tuple[float, float]:
    """Correlation, and ratio, of the speed ahead by the truth to that of the wheels: half-second means."""
    t, ahead, _ = truth_rates(recording)
    assert recording.wheels is not None
    sides = recording.wheels.side_speeds_mps(recording.overrides.wheel_radius_m or 1.0)
    grid = np.arange(max(t[0], seconds(recording.wheels)[0]), min(t[-1], seconds(recording.wheels)[-1]), 0.5)
    a, b = means(t, ahead, grid), means(seconds(recording.wheels), sides.mean(axis=1), grid)
    return float(np.corrcoef(a, b)[0, 1]), float(np.abs(a).sum() / np.abs(b).sum())


def lag_behind_gyro(recording: Recording, what: str) -> Lag:
    imu = recording.imu
    assert imu is not None
    t, _, rate = truth_rates(recording)
    other = (t, rate) if what == "truth" else (seconds(recording.wheels), turn(recording))
    lag = lag_between(seconds(imu), imu.gyro_radps[:, 2], *other)
    assert lag is not None
    return lag


def accelerations(recording: Recording) -> tuple[float, float]:
    """Correlations of accelerometer x with the change of speed, and of its y with speed times yaw rate."""
    imu, wheels = recording.imu, recording.wheels
    assert imu is not None
    assert wheels is not None
    grid = np.arange(*(seconds(wheels)[[0, -1]]), 0.5)
    v = means(seconds(wheels), wheels.side_speeds_mps(RADIUS_M).mean(axis=1), grid)
    x, y, rate = (
        means(seconds(imu), column, grid)
        for column in (imu.accel_mps2[:, 0], imu.accel_mps2[:, 1], imu.gyro_radps[:, 2])
    )
    ahead = np.corrcoef(x, np.gradient(v, 0.5))[0, 1]
    return float(ahead), float(np.corrcoef(y, v * rate)[0, 1])


def joined(recordings: Sequence[Recording]) -> Recording:
    """Windows one after the other as one recording, for checks that need more than 2 s."""
    imus, wheels = [], []
    for k, r in enumerate(recordings):
        assert r.imu is not None
        assert r.wheels is not None
        shift = k * 2_000_000_000 - r.start_ns
        imus.append((r.imu.t_ns + shift, r.imu.gyro_radps, r.imu.accel_mps2))
        wheels.append((r.wheels.t_ns + shift, r.wheels.speed))
    t, gyro, accel = (np.concatenate(part) for part in zip(*imus, strict=True))
    t_wheels, speed = (np.concatenate(part) for part in zip(*wheels, strict=True))
    order = np.argsort(t_wheels, kind="stable")
    return Recording(
        "joined",
        0,
        imu=Imu(t, gyro, accel),
        wheels=Wheels(t_wheels[order], speed[order], ("left", "right"), "radps"),
    )


def codes(recording: Recording) -> set[str]:
    return {finding.code for finding in examine(recording)}


# --- the published files -----------------------------------------------------------------------------------


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


def changing_share(recording: Recording, channel: str) -> float:
    """Share of rows that differ from the one before."""
    held = getattr(recording, channel)
    values = held.position_m if channel == "truth" else np.stack(list(held.columns().values()), axis=1)
    return float((np.diff(values, axis=0) != 0).any(axis=1).mean())


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


def yaw_errors(windows: Sequence[Recording]) -> np.ndarray:
    """Yaw over a window by the truth less that by the gyro at the same times."""
    gyro = joined(windows).imu
    assert gyro is not None
    yaw = np.concatenate([[0.0], np.cumsum(gyro.gyro_radps[1:, 2] * np.diff(gyro.t_ns) * 1e-9)])
    errors = []
    for k, w in enumerate(windows[1:], 1):
        assert w.truth is not None
        t = w.truth.t_ns[1:] + k * 2_000_000_000 - w.start_ns
        if len(t) > 2:
            by_gyro = np.diff(np.interp(t[[0, -1]].astype(float), gyro.t_ns.astype(float), yaw))[0]
            errors.append(np.diff(np.unwrap(w.truth.yaw_rad()[1:])[[0, -1]])[0] - by_gyro)
    return np.abs(np.array(errors))


def test_yaw_of_the_truth_is_not_scored_on_sand(published: Path) -> None:
    for name in ("sand_2024_9_25_14h13s47", "sand_2024_9_25_14h32s32"):
        windows = open_recordings(window_file(published, name))
        assert windows[0].truth_channels == ("position",)
        assert np.mean(yaw_errors(windows) > 0.3) > 0.2
    for name in ("ice_2024_7_30_16h30s21", "gravel_2024_8_6_11h37s32"):
        windows = open_recordings(window_file(published, name))
        assert "yaw" in windows[0].truth_channels
        assert np.mean(yaw_errors(windows) > 0.3) < 0.2


# --- synthetic files ---------------------------------------------------------------------------------------


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
        (lambda f: f.iloc[:0], "no row has a time"),
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
