"""RTKLIB solutions: written here from known positions, read back to the millimetre and nanosecond."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_to_geodetic, geodetic_to_enu
from terrafusion.datasets.core.gnss_time import LEAP_SECONDS, gps_to_unix_ns
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording

COLUMNS = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"  # fmt: skip  # noqa: E501
PREAMBLE = "% program   : RTKLIB ver.2.4.3\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single)\n"
DATUM = (-33.45, -70.66, 570.0)
N = 20


def track() -> np.ndarray:
    s = np.arange(N) * 0.2
    return np.stack([s * 1.1, -s * 0.7, 0.01 * s], axis=1)


def stamp(k: int) -> str:
    return f"2024/03/09 23:59:{57 + k // 5:02d}.{200 * (k % 5):03d}" if k < 15 else (
        f"2024/03/10 00:00:{(k - 15) // 5:02d}.{200 * (k % 5):03d}"
    )  # fmt: skip


def start_ns(system: str = "GPST") -> int:
    utc = int(np.datetime64("2024-03-09T23:59:57", "ns").astype(np.int64))
    return utc - {"GPST": 18, "UTC": 0, "JST": 9 * 3600}[system] * 10**9


def rows(llh: np.ndarray, q: str = "1", mark: str = "  ") -> str:
    tail = mark.join(["12", "0.0030", "0.0020", "0.0080", "0.0001", "0.0002", "-0.0003", "0.00", "4.5"])
    return "".join(
        mark.join([stamp(k), f"{lat:.9f}", f"{lon:.9f}", f"{h:.4f}", q, tail]) + "\n"
        for k, (lat, lon, h) in enumerate(llh)
    )


def write(tmp_path: Path, body: str, header: str = PREAMBLE + f"%  GPST  {COLUMNS}\n") -> Path:
    path = tmp_path / "rover.pos"
    path.write_text(header + body)
    return path


def assert_track(recording: Recording, datum: tuple[float, ...], tolerance: float = 1e-3) -> None:
    assert recording.gnss is not None
    assert recording.datum is not None
    llh = enu_to_geodetic(recording.gnss.enu_m, recording.datum)
    np.testing.assert_allclose(geodetic_to_enu(llh, datum), track(), atol=tolerance)


@pytest.mark.parametrize(
    "datum",
    [DATUM, (48.1, 11.5, 500.0), (-17.5, 179.99999, 3.0), (0.000001, -0.000001, 0.0), (89.99999, 10.0, 2.0)],
    ids=["southwest", "northeast", "across 180", "across 0", "at the pole"],
)
def test_positions_come_back_to_the_millimetre(tmp_path: Path, datum: tuple[float, float, float]) -> None:
    llh = enu_to_geodetic(track(), datum)
    recording = open_recording(write(tmp_path, rows(llh)))
    assert_track(recording, datum)
    gnss = recording.gnss
    assert gnss is not None
    np.testing.assert_array_equal(gnss.t_ns, start_ns() + np.arange(N) * 200_000_000)
    np.testing.assert_allclose(gnss.sigma_enu_m[0], [0.002, 0.003, 0.008])
    assert set(gnss.fix.tolist()) == {Fix.FIXED}
    assert any("18 leap seconds" in note for note in recording.notes)


def test_a_fix_on_a_pole_is_refused_with_the_name_of_the_file(tmp_path: Path) -> None:
    llh = np.tile([90.0, 10.0, 2.0], (N, 1))
    with pytest.raises(DataError, match=r"rover\.pos, gnss: the datum lies on a pole"):
        open_recording(write(tmp_path, rows(llh)))


@pytest.mark.parametrize("system", ["GPST", "UTC", "JST"])
def test_time_systems(tmp_path: Path, system: str) -> None:
    header = f"%  {system}                  {COLUMNS}\n"
    recording = open_recording(write(tmp_path, rows(enu_to_geodetic(track(), DATUM)), header))
    assert recording.start_ns == start_ns(system)


@pytest.mark.parametrize("mark", [",", "\t", ";"])
def test_separators(tmp_path: Path, mark: str) -> None:
    header = f"%  GPST{mark}" + mark.join(f"  {name}" for name in COLUMNS.split()) + "\n"
    body = rows(enu_to_geodetic(track(), DATUM), mark=mark)
    assert_track(open_recording(write(tmp_path, body, header.replace("  lat", "lat"))), DATUM)


def test_week_and_seconds_across_a_week(tmp_path: Path) -> None:
    llh = enu_to_geodetic(track()[:4], DATUM)
    times = ["2304 604799.500", "2304 604799.999999999", "2305 0.000", "2305 0.5"]
    body = "".join(
        f"{t} {lat:.9f} {lon:.9f} {h:.4f} 2 9 1 1 2 0 0 0 0 0\n"
        for t, (lat, lon, h) in zip(times, llh, strict=True)
    )
    recording = open_recording(write(tmp_path, body))
    assert recording.gnss is not None
    week = int(np.datetime64("2024-03-10T00:00:00", "ns").astype(np.int64)) - 18 * 10**9
    assert (recording.gnss.t_ns - week).tolist() == [-500_000_000, -1, 0, 500_000_000]
    assert set(recording.gnss.fix.tolist()) == {Fix.FLOAT}


def test_weeks_modulo_1024_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "256 100.0 48 11 500 1 9 1 1 2 0 0 0 0 0\n")
    with pytest.raises(DataError, match="modulo 1024"):
        open_recording(path)


@pytest.mark.parametrize("datum", [(-0.5, -0.25, 10.0), (-33.45, -70.66, 570.0), (48.1, 11.5, 500.0)])
def test_degrees_minutes_seconds(tmp_path: Path, datum: tuple[float, float, float]) -> None:
    def dms(angle: float) -> str:
        whole, rest = divmod(abs(angle), 1.0)
        minutes, rest = divmod(rest * 60.0, 1.0)
        sign = "-" if angle < 0 else ""
        return f"{sign}{whole:.0f} {minutes:02.0f} {rest * 60.0:08.5f}"

    header = "%  GPST  latitude(d'\") longitude(d'\")  height(m)   Q  ns  sdn(m) sde(m) sdu(m)\n"
    body = "".join(
        f"{stamp(k)} {dms(lat)} {dms(lon)} {h:.4f} 5 8 1.5 1.4 3.0\n"
        for k, (lat, lon, h) in enumerate(enu_to_geodetic(track(), datum))
    )
    assert_track(open_recording(write(tmp_path, body, header)), datum)


def test_ecef_with_velocity_and_covariance(tmp_path: Path) -> None:
    """Sigmas of east, north and up are told as ECEF covariances and come back as they were."""
    llh = enu_to_geodetic(track(), DATUM)
    xyz = np.stack(pymap3d.geodetic2ecef(*llh.T), axis=1)
    axes = np.array([pymap3d.enu2uvw(*axis, *DATUM[:2]) for axis in np.eye(3)], dtype=float)
    v = np.array(pymap3d.enu2uvw(1.1, -0.7, 0.01, *DATUM[:2])).reshape(3)
    P = axes.T @ np.diag([0.2**2, 0.1**2, 0.3**2]) @ axes
    root = np.sign(P) * np.sqrt(np.abs(P))
    spread = " ".join(f"{x:.9f}" for x in (*np.sqrt(P.diagonal()), root[0, 1], root[1, 2], root[2, 0]))
    header = "%  GPST x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio vx(m/s) vy(m/s) vz(m/s) sdvx sdvy sdvz sdvxy sdvyz sdvzx\n"  # noqa: E501
    body = "".join(
        f"{stamp(k)} {x:.4f} {y:.4f} {z:.4f} 4 8 {spread} 0 0 {v[0]:.6f} {v[1]:.6f} {v[2]:.6f} {spread}\n"
        for k, (x, y, z) in enumerate(xyz)
    )
    recording = open_recording(write(tmp_path, body, header))
    assert_track(recording, DATUM)
    gnss = recording.gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    assert gnss.sigma_v_mps is not None
    np.testing.assert_allclose(gnss.sigma_enu_m[0], [0.2, 0.1, 0.3], rtol=1e-5)
    np.testing.assert_allclose(gnss.velocity_enu_mps[0], [1.1, -0.7, 0.01], atol=1e-5)
    np.testing.assert_allclose(gnss.sigma_v_mps[0], np.sqrt((0.2**2 + 0.1**2) / 2.0), rtol=1e-5)
    assert set(gnss.fix.tolist()) == {Fix.DGPS}


def test_baseline_about_its_base(tmp_path: Path) -> None:
    header = (
        "% ref pos   :  -33.450000000  -70.660000000   570.0000\n"
        "%  GPST  e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)\n"
    )
    body = "".join(
        f"{stamp(k)} {e:.4f} {n:.4f} {u:.4f} 1 9 0.01 0.02 0.03\n" for k, (e, n, u) in enumerate(track())
    )
    recording = open_recording(write(tmp_path, body, header))
    assert recording.datum == DATUM
    assert recording.gnss is not None
    np.testing.assert_array_equal(recording.gnss.enu_m, np.round(track(), 4))
    np.testing.assert_allclose(recording.gnss.sigma_enu_m[3], [0.01, 0.02, 0.03])
    alone = open_recording(write(tmp_path, body, header.split("\n", 1)[1]))
    assert alone.datum is None
    assert any("base station" in note for note in alone.notes)


def test_velocity_of_degrees(tmp_path: Path) -> None:
    header = f"%  GPST  {COLUMNS} vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun\n"
    body = rows(enu_to_geodetic(track(), DATUM)).replace("4.5\n", "4.5 -0.7 1.1 0.01 0.03 0.04 0.1 0 0 0\n")
    gnss = open_recording(write(tmp_path, body, header)).gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    assert gnss.sigma_v_mps is not None
    np.testing.assert_array_equal(gnss.velocity_enu_mps[5], [1.1, -0.7, 0.01])
    assert gnss.sigma_v_mps[5] == pytest.approx(np.sqrt((0.03**2 + 0.04**2) / 2))


def test_leap_seconds_at_their_dates() -> None:
    """GPS time runs through; UTC falls behind by one more second from each date of the table on."""
    epoch = np.datetime64("1980-01-06", "s")
    for date, offset in LEAP_SECONDS:
        at = int((np.datetime64(date, "s") - epoch).astype(np.int64)) + offset
        before, on = gps_to_unix_ns(np.array([at - 2, at]) * 10**9)
        assert on == int(np.datetime64(date, "ns").astype(np.int64)), date
        assert on - before == 10**9, date  # two seconds of GPS time, one of Unix time


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2_000_000_000 * 10**9))
def test_gps_time_never_runs_backwards(gps_ns: int) -> None:
    first, second = gps_to_unix_ns(np.array([gps_ns, gps_ns + 10**9]))
    assert 0 <= second - first <= 10**9


def test_backward_times_are_refused_or_repaired(tmp_path: Path) -> None:
    tow = 100.0 + 0.2 * np.arange(200) - 3.0 * (np.arange(200) >= 100)
    path = write(tmp_path, "".join(f"2304 {t:.3f} 48.1 11.5 500 1 9 1 1 2 0 0 0 0 0\n" for t in tow))
    with pytest.raises(DataError, match=r"backwards by 2\.8"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert recording.gnss is not None
    np.testing.assert_array_equal(recording.gnss.t_ns - recording.start_ns, np.arange(200) * 200_000_000)
    assert [jump.step_s for jump in recording.clock_jumps] == [-3.0]


BAD = {
    "a header only": ("", "header but no rows"),
    "text in a number": (rows(np.array([DATUM])).replace("570.0000", "57O.0000"), "height.*57O.0000"),
    "a date that is none": (rows(np.array([DATUM])).replace("03/09", "13/09"), "2024/13/09"),
    "a year beyond any": (rows(np.array([DATUM])).replace("2024", "6024"), "6024/03/09"),
    "an unknown Q": (rows(np.array([DATUM]), q="9"), "'Q' is '9' at line"),
    "a short line": (rows(np.array([DATUM])) + "2024/03/10 00:00:00.000 48.1\n" * 2, "line 5 has 3 cells"),
    "a long line": (rows(np.array([DATUM])).replace("4.5", "4.5 1 2"), "cells for"),
    "not on Earth": (rows(np.array([(95.0, 10.0, 0.0)])), "not on Earth"),
    "infinite": (rows(np.array([DATUM])).replace("570.0000", "inf"), "inf"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_told_in_one_line(tmp_path: Path, case: str) -> None:
    body, match = BAD[case]
    with pytest.raises(DataError, match=match) as told:
        open_recording(write(tmp_path, body))
    assert "\n" not in str(told.value)


def test_rows_without_position_and_a_cut_last_line(tmp_path: Path) -> None:
    lines = rows(enu_to_geodetic(track(), DATUM)).splitlines(keepends=True)
    lines[3] = lines[3].replace(lines[3].split()[2], "nan")
    recording = open_recording(write(tmp_path, "".join(lines[:-1]) + lines[-1][:40]))
    assert recording.gnss is not None
    assert len(recording.gnss) == N - 2
    assert any("cut off and is left out" in note for note in recording.notes)
    assert any("1 of 19 rows hold no fix" in note for note in recording.notes)


def test_no_header(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="names the columns"):
        open_recording(write(tmp_path, rows(np.array([DATUM])), ""))


def test_random_bytes_and_one_long_line(tmp_path: Path) -> None:
    noise = random.Random(1).randbytes(100_000)
    path = tmp_path / "noise.pos"
    for data in (
        noise,
        f"%  GPST {COLUMNS}\n".encode() + noise,
        b"%  GPST latitude(deg)" + b" 1" * 5_000_000,
    ):
        path.write_bytes(data)
        with pytest.raises(DataError):
            open_recording(path)
