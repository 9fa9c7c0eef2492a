"""MT Manager exports: written here with known numbers, in the ways that versions and settings differ."""

from __future__ import annotations

import random
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_to_geodetic, geodetic_to_enu, rpy_to_quaternion
from terrafusion.datasets.readers import open_recording

N = 200
RATE_HZ = 100
START_NS = 1_709_251_198_123_456_700
"""2024-02-29 23:59:58.1234567: two seconds before a midnight that ends a leap day."""
DATUM = (-33.45, -70.66, 570.0)
HEADER = """// General information:
//  MT Manager version: 2022.2.0
// Device information:
//  DeviceId: 0080005BF5
//  ProductCode: MTi-680G-8A1G6
//  Firmware Version: 1.10.1
// Device settings:
//  Filter Profile: GeneralRTK
//  Update Rate: 100.0Hz
// Coordinate system: ENU
"""
SHORT_HEADER = "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: general (1.0)\n"
FIXED = 0x10000007


def times_ns() -> np.ndarray:
    return START_NS + np.arange(N, dtype=np.int64) * (10**9 // RATE_HZ)


def motion() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return rng.normal(0.0, 0.3, (N, 3)).round(6), rng.normal((0.0, 0.0, 9.81), 0.5, (N, 3)).round(6)


def track() -> np.ndarray:
    s = np.arange(N) / RATE_HZ
    return np.stack([1.5 * s, -0.4 * s, 0.1 * s], axis=1)


def utc_columns() -> dict[str, list[str]]:
    stamps = [str(np.datetime64(int(t), "ns")) for t in times_ns()]
    parts = {"Year": (0, 4), "Month": (5, 7), "Day": (8, 10), "Hour": (11, 13), "Minute": (14, 16)}
    columns = {f"UTC_{name}": [s[a:b] for s in stamps] for name, (a, b) in parts.items()}
    return {
        "UTC_Nano": [s[20:29] for s in stamps], **columns,
        "UTC_Second": [s[17:19] for s in stamps], "UTC_Valid": ["7"] * N,
    }  # fmt: skip


def imu_columns(scale: float = 1.0) -> dict[str, list[str]]:
    gyro, accel = motion()
    columns = {f"Acc_{a}": [f"{x:.6f}" for x in accel[:, i]] for i, a in enumerate("XYZ")}
    return columns | {f"Gyr_{a}": [f"{x * scale:.8f}" for x in gyro[:, i]] for i, a in enumerate("XYZ")}


def ticks(first: int = 1000) -> dict[str, list[str]]:
    counts = {"PacketCounter": [f"{(65500 + k) % 65536:05d}" for k in range(N)]}
    return counts | {"SampleTimeFine": [str((first + 100 * k) % 2**32) for k in range(N)]}


def gnss_columns(every: int = 25, status: str = "{:d}") -> dict[str, list[str]]:
    llh = enu_to_geodetic(track(), DATUM)
    rows = [k % every == 0 for k in range(N)]
    names = ("Latitude", "Longitude", "Altitude")
    columns = {n: [f"{x:.12f}" if r else "" for r, x in zip(rows, llh[:, i], strict=True)] for i, n in enumerate(names)}  # fmt: skip  # noqa: E501
    columns |= {f"Vel_{a}": [f"{v}" if r else "" for r in rows] for a, v in zip("XYZ", (1.5, -0.4, 0.1), strict=True)}  # fmt: skip  # noqa: E501
    return columns | {"StatusWord": [status.format(FIXED)] * N}


def export(
    tmp_path: Path, columns: dict[str, list[str]], header: str = HEADER, mark: str = "\t", bom: str = ""
) -> Path:
    path = tmp_path / "MT_0080005BF5-000.txt"
    rows = zip(*columns.values(), strict=True)
    path.write_text(bom + header + mark.join(columns) + "\n" + "".join(mark.join(row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("mark", ["\t", ";", ","])
@pytest.mark.parametrize("header", [HEADER, SHORT_HEADER, ""])
def test_utc_imu_and_gnss(tmp_path: Path, mark: str, header: str) -> None:
    columns = ticks() | utc_columns() | imu_columns() | gnss_columns()
    recording = open_recording(export(tmp_path, columns, header, mark))
    imu, gnss = recording.imu, recording.gnss
    assert imu is not None
    assert gnss is not None
    gyro, accel = motion()
    np.testing.assert_array_equal(imu.t_ns, times_ns())
    np.testing.assert_array_equal(imu.gyro_radps, gyro)
    np.testing.assert_array_equal(imu.accel_mps2, accel)
    np.testing.assert_array_equal(gnss.t_ns, times_ns()[::25])
    assert recording.datum is not None
    back = geodetic_to_enu(enu_to_geodetic(gnss.enu_m, recording.datum), DATUM)
    np.testing.assert_allclose(back, track()[::25], atol=1e-3)
    assert gnss.velocity_enu_mps is not None
    np.testing.assert_array_equal(gnss.velocity_enu_mps, np.tile([1.5, -0.4, 0.1], (8, 1)))
    assert set(gnss.fix.tolist()) == {Fix.FIXED}
    assert any("fused with its IMU" in note for note in recording.notes)


def test_blanks_as_separator_where_no_cell_is_empty(tmp_path: Path) -> None:
    imu = open_recording(export(tmp_path, ticks() | imu_columns(), mark=" ")).imu
    assert imu is not None
    np.testing.assert_array_equal(imu.gyro_radps, motion()[0])


def test_ticks_wrap_and_are_dated_by_the_rows_with_utc(tmp_path: Path) -> None:
    columns = ticks(2**32 - 5000) | utc_columns() | imu_columns()
    columns["UTC_Valid"] = ["7" if k > 150 else "0" for k in range(N)]
    recording = open_recording(export(tmp_path, columns))
    assert recording.imu is not None
    np.testing.assert_array_equal(recording.imu.t_ns, times_ns())
    assert any("set to UTC by 49 rows" in note for note in recording.notes)


def test_device_time_alone(tmp_path: Path) -> None:
    recording = open_recording(export(tmp_path, ticks() | imu_columns()))
    assert recording.start_ns == 100_000_000
    assert any("device's clock" in note for note in recording.notes)


@pytest.mark.parametrize("missing", ["", "NaN"])
def test_packets_at_the_update_rate(tmp_path: Path, missing: str) -> None:
    """The counter wraps at 65536, a lost packet leaves its gap, empty clocks are no clocks."""
    columns = ticks() | imu_columns()
    columns["SampleTimeFine"] = [missing] * N
    columns = {name: cells[:50] + cells[53:] for name, cells in columns.items()}
    recording = open_recording(export(tmp_path, columns, SHORT_HEADER))
    assert recording.imu is not None
    steps = np.diff(recording.imu.t_ns)
    assert steps[49] == 40_000_000
    assert set(np.delete(steps, 49).tolist()) == {10_000_000}
    assert any("update rate of 100 Hz" in note for note in recording.notes)
    with pytest.raises(DataError, match="Update Rate"):
        open_recording(export(tmp_path, columns, "// Start Time: Unknown\n"))


@pytest.mark.parametrize(
    ("status", "fix"),
    [(0x7, Fix.SINGLE), (0x08000007, Fix.FLOAT), (0x10000007, Fix.FIXED)],
)
@pytest.mark.parametrize("style", ["{:d}", "0x{:X}", "{:08x}", "{:032b}"])
def test_status_words(tmp_path: Path, status: int, fix: Fix, style: str) -> None:
    columns = ticks() | imu_columns() | gnss_columns()
    columns["StatusWord"] = [style.format(status)] * N
    gnss = open_recording(export(tmp_path, columns)).gnss
    assert gnss is not None
    assert set(gnss.fix.tolist()) == {fix}


def test_no_fix_no_gnss(tmp_path: Path) -> None:
    columns = ticks() | imu_columns() | gnss_columns()
    columns["StatusWord"] = ["3"] * N
    recording = open_recording(export(tmp_path, columns))
    assert recording.gnss is None
    assert any("the channel is absent" in note for note in recording.notes)


@pytest.mark.parametrize("frame", ["NED", "NWU", "ENU"])
def test_velocity_frames(tmp_path: Path, frame: str) -> None:
    columns = ticks() | imu_columns() | gnss_columns()
    header = HEADER.replace("system: ENU", f"system: {frame}")
    gnss = open_recording(export(tmp_path, columns, header)).gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    wanted = {"ENU": (1.5, -0.4, 0.1), "NED": (-0.4, 1.5, -0.1), "NWU": (0.4, 1.5, 0.1)}[frame]
    np.testing.assert_array_equal(gnss.velocity_enu_mps[0], wanted)


def attitude(gyro: np.ndarray) -> dict[str, list[str]]:
    """Yaw of a device that turns with `gyro` about z only."""
    yaw = np.concatenate([[0.0], np.cumsum(gyro[1:, 2]) / RATE_HZ])
    q = rpy_to_quaternion(np.stack([0 * yaw, 0 * yaw, yaw], axis=1))
    return {f"Quat_q{i}": [f"{x:.9f}" for x in q[:, k]] for i, k in enumerate((3, 0, 1, 2))}


@pytest.mark.parametrize("degrees", [False, True])
def test_the_attitude_tells_the_unit_of_the_rates(tmp_path: Path, degrees: bool) -> None:
    gyro = np.zeros((N, 3))
    gyro[:, 2] = 0.5 + 0.3 * np.sin(np.arange(N) / 20)
    columns = ticks() | imu_columns()
    for i, a in enumerate("XYZ"):
        columns[f"Gyr_{a}"] = [f"{np.degrees(x) if degrees else x:.9f}" for x in gyro[:, i]]
    recording = open_recording(export(tmp_path, columns | attitude(gyro)))
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.gyro_radps, gyro, atol=1e-9)
    assert any("taken as deg/s" in note for note in recording.notes) == degrees
    assert recording.truth is None


def test_units_in_the_header_and_rates_no_device_measures(tmp_path: Path) -> None:
    columns = ticks() | imu_columns(scale=180.0 / np.pi * 3)
    with pytest.raises(DataError, match="beyond what an MTi measures"):
        open_recording(export(tmp_path, columns))
    named = {f"{n} [deg/s]" if n.startswith("Gyr") else n: c for n, c in columns.items()}
    imu = open_recording(export(tmp_path, named)).imu
    assert imu is not None
    np.testing.assert_allclose(imu.gyro_radps, 3 * motion()[0], atol=1e-8)


def test_increments_where_there_are_no_rates(tmp_path: Path) -> None:
    gyro, accel = motion()
    angle = np.linalg.norm(gyro, axis=1) / RATE_HZ
    axis = np.sin(angle / 2)[:, None] * gyro / np.linalg.norm(gyro, axis=1)[:, None]
    q = np.column_stack([np.cos(angle / 2), axis])
    columns = ticks() | {f"VelInc_{a}": [f"{x:.12f}" for x in accel[:, i] / RATE_HZ] for i, a in enumerate("XYZ")}  # fmt: skip  # noqa: E501
    columns |= {f"OriInc_q{i}": [f"{x:.12f}" for x in q[:, i]] for i in range(4)}
    imu = open_recording(export(tmp_path, columns)).imu
    assert imu is not None
    np.testing.assert_allclose(imu.gyro_radps, gyro, atol=1e-8)
    np.testing.assert_allclose(imu.accel_mps2, accel, atol=1e-8)


def test_rows_that_end_with_a_separator(tmp_path: Path) -> None:
    path = export(tmp_path, ticks() | imu_columns())
    head, names, rows = path.read_text().partition("Gyr_Z\n")
    path.write_text(head + names + rows.replace("\n", "\t\n"))
    imu = open_recording(path).imu
    assert imu is not None
    np.testing.assert_array_equal(imu.gyro_radps, motion()[0])


def test_a_byte_order_mark(tmp_path: Path) -> None:
    recording = open_recording(export(tmp_path, ticks() | imu_columns(), bom="\ufeff"))
    assert recording.source.startswith("Xsens")


def test_another_device_is_not_taken_for_an_mti(tmp_path: Path) -> None:
    columns = ticks() | imu_columns()
    columns["SampleTimeFine"] = [str(10**6 + 16_667 * k) for k in range(N)]
    with pytest.raises(DataError, match="microseconds"):
        open_recording(export(tmp_path, columns))
    columns["Euler_X"] = ["1.0"] * N
    with pytest.raises(DataError, match="nothing says what the columns"):
        open_recording(export(tmp_path, columns, ""))


@pytest.mark.parametrize(
    ("part", "value"), [("Month", "13"), ("Day", "30"), ("Second", "61"), ("Hour", "1e300")]
)
def test_utc_that_is_no_date(tmp_path: Path, part: str, value: str) -> None:
    columns = ticks() | utc_columns() | imu_columns()
    columns[f"UTC_{part}"][5] = value  # the rows are of 29 February
    with pytest.raises(DataError, match="is no date, in data row 6"):
        open_recording(export(tmp_path, columns))


def test_backward_ticks(tmp_path: Path) -> None:
    columns = ticks() | imu_columns()
    columns["SampleTimeFine"] = [str(50_000 + 100 * k - 2000 * (k >= 100)) for k in range(N)]
    path = export(tmp_path, columns)
    with pytest.raises(DataError, match=r"backwards by 0\.19"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert recording.imu is not None
    assert set(np.diff(recording.imu.t_ns).tolist()) == {10_000_000}
    assert [jump.step_s for jump in recording.clock_jumps] == [-0.2]


def test_cells_that_are_missing_and_a_cut_last_line(tmp_path: Path) -> None:
    columns = ticks() | imu_columns()
    columns["Gyr_X"][3] = ""
    for name in ("Acc_X", "Acc_Y", "Acc_Z", "Gyr_X", "Gyr_Y", "Gyr_Z"):
        columns[name][7] = ""
    path = export(tmp_path, columns)
    path.write_text(path.read_text().rstrip("\n")[:-30])
    recording = open_recording(path)
    assert recording.imu is not None
    assert len(recording.imu) == N - 2
    assert np.isnan(recording.imu.gyro_radps[3, 0])
    assert any("cut off and is left out" in note for note in recording.notes)
    assert any("1 of 199 rows hold no sample" in note for note in recording.notes)


ROW = "1\t100\t0.1\t0.2\t9.8\t0.01\t0.02\t0.03\n"
NAMES = "PacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\n"
BAD = {
    "header only": ("", "header but no rows"),
    "text in a number": (ROW.replace("9.8", "9.8m"), "column 'Acc_Z' is '9.8m' at line 12"),
    "infinite": (ROW.replace("9.8", "inf"), "column 'Acc_Z' is 'inf'"),
    "short line": (ROW + "2\t200\t0.1\n" + ROW, "line 13 has 3 cells for 8 columns"),
    "long line": (ROW.replace("\n", "\t1\t2\n"), "cells for 8 columns"),
    "no sample": ("1\t100\t\t\t\t\t\t\n", "no row holds"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_told_in_one_line(tmp_path: Path, case: str) -> None:
    body, match = BAD[case]
    path = tmp_path / "bad.txt"
    path.write_text(HEADER + NAMES + body)
    with pytest.raises(DataError, match=match) as told:
        open_recording(path)
    assert "\n" not in str(told.value)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(["1", "-2.5", "", "NaN", "inf", "1e400", "0x7", "x", '"', "1_0"]), min_size=16, max_size=16))  # fmt: skip  # noqa: E501
def test_any_cells_are_read_or_told(tmp_path: Path, cells: list[str]) -> None:
    path = tmp_path / "any.txt"
    path.write_text(HEADER + NAMES + ROW + "\t".join(cells[:8]) + "\n" + "\t".join(cells[8:]) + "\n")
    told = ""
    try:
        open_recording(path)
    except DataError as error:
        told = str(error)
    assert "\n" not in told


def test_random_bytes_and_one_long_line(tmp_path: Path) -> None:
    noise = random.Random(2).randbytes(200_000)
    path = tmp_path / "noise.txt"
    begun = time.process_time()
    for data in (HEADER.encode() + NAMES.encode() + noise, HEADER.encode() + b"Acc_X\t" * 2_000_000):
        path.write_bytes(data)
        with pytest.raises(DataError):
            open_recording(path)
    assert time.process_time() - begun < 10.0
