"""Plain tables by a column map: units exact, times to the nanosecond, wrong maps told with the remedy."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import ConfigError, DataError, TerrafusionError
from terrafusion.datasets.core.frames import enu_to_geodetic, geodetic_to_enu
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import files_of, open_recording
from terrafusion.datasets.readers.text.column_map import FIELDS, UNITS, units_of
from terrafusion.datasets.readers.text.proposed_map import starter_map

START_NS = 1_700_000_000_123_456_789
GYRO_MAP = "time: {column: t}\nchannels: {imu: {gyro_z_radps: wz}}\n"


def table(tmp_path: Path, text: str, columns: str | None = GYRO_MAP, name: str = "drive.csv") -> Path:
    path = tmp_path / name
    path.write_text(text)
    if columns is not None:
        (tmp_path / f"{name}.columns.yaml").write_text(columns)
    return path


def ns(text: str) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


EXACT = {
    ("gyro_z_radps", "deg/s"): (180.0, np.pi),
    ("gyro_z_radps", "mdeg/s"): (180e3, np.pi),
    ("gyro_z_radps", "rpm"): (30.0, np.pi),
    ("gyro_z_radps", "rev/s"): (0.5, np.pi),
    ("accel_z_mps2", "g"): (1.0, 9.80665),
    ("accel_z_mps2", "mg"): (1000.0, 9.80665),
    ("accel_z_mps2", "mm/s2"): (1000.0, 1.0),
    ("accel_z_mps2", "cm/s2"): (100.0, 1.0),
    ("left_mps", "km/h"): (36.0, 10.0),
    ("left_mps", "mph"): (1.0, 0.44704),
    ("left_mps", "kn"): (3600.0, 1852.0),
    ("left_mps", "cm/s"): (250.0, 2.5),
    ("left_mps", "mm/s"): (2500.0, 2.5),
    ("x_m", "mm"): (1.0, 0.001),
    ("x_m", "cm"): (1.0, 0.01),
    ("x_m", "km"): (1.5, 1500.0),
    ("x_m", "ft"): (1.0, 0.3048),
    ("yaw_rad", "deg"): (180.0, np.pi),
    ("left_rad", "rev"): (1.0, 2.0 * np.pi),
    ("latitude_deg", "rad"): (np.pi, 180.0),
    ("latitude_deg", "1e-7 deg"): (481_234_567.0, 48.1234567),
    ("left_a", "mA"): (1.0, 0.001),
    ("left_v", "mV"): (1.0, 0.001),
    ("pressure_pa", "hPa"): (1013.25, 101_325.0),
    ("pressure_pa", "mbar"): (1000.0, 100_000.0),
    ("pressure_pa", "kPa"): (100.0, 100_000.0),
    ("field_x_t", "mT"): (1.0, 0.001),
    ("field_x_t", "uT"): (20.0, 20e-6),
    ("field_x_t", "nT"): (500.0, 500e-9),
    ("field_x_t", "G"): (0.5, 0.5e-4),
    ("field_x_t", "mG"): (10.0, 1e-6),
    ("p_mud", "%"): (50.0, 0.5),
}


def test_the_map_is_among_the_files_of_a_table(tmp_path: Path) -> None:
    path = table(tmp_path, "t,wz\n0,1\n")
    (tmp_path / "other.csv").write_text("t,wz\n0,1\n")
    assert files_of(path) == [path, tmp_path / "drive.csv.columns.yaml"]


def test_every_unit_is_checked() -> None:
    named = {(units[0], unit) for units in UNITS.items() for unit in list(units[1])[1:]}
    endings = {("" if f.startswith("p_") else f.rpartition("_")[2], unit) for f, unit in EXACT}
    assert endings == named


@pytest.mark.parametrize("case", EXACT, ids=" ".join)
def test_units(case: tuple[str, str]) -> None:
    """Known pairs, to the last digit of a double."""
    value, wanted = EXACT[case]
    assert value * units_of(case[0])[case[1]] == pytest.approx(wanted, rel=3e-16)


def test_the_unit_of_every_field_is_that_of_its_name() -> None:
    for fields in FIELDS.values():
        for name in fields:
            assert next(iter(units_of(name).values())) == 1.0


MIXED = """
time: {column: stamp, unit: ms}
vehicle: husky
wheel_radius_m: 0.165
antenna_m: [0.1, 0.0, 0.9]
terrain: mud
imu_axes: ["+x", "-y", "-z"]
channels:
  imu:
    gyro_z_radps: {column: "gyro z [dps]", unit: deg/s}
    accel_z_mps2: {column: az, unit: g}
  wheels:
    left_mps: {column: vl, unit: km/h, sign: "-"}
    right_mps: {column: vr, unit: km/h}
  gnss:
    latitude_deg: lat
    longitude_deg: lon
    height_m: h
    fix: {column: q, unit: nmea}
  terrain: {label: ground}
"""


def test_several_channels_of_one_table(tmp_path: Path) -> None:
    text = "stamp;gyro z [dps];az;vl;vr;lat;lon;h;q;ground;unused\n"
    text += "1700000000000.5;-90;-1;;;48.1;11.5;500;4;mud;x\n"
    text += "1700000000010.5;45;-1;-36;18;;;;;;y\n"
    text += "1700000000020.5;;;-36;36;48.1;11.5;500;0;;z\n"
    recording = open_recording(table(tmp_path, text, MIXED))
    first = 1_700_000_000_000_500_000
    assert {n: (c.t_ns - first).tolist() for n, c in recording.channels().items()} == {
        "wheels": [10_000_000, 20_000_000],
        "imu": [0, 10_000_000],
        "gnss": [0],
        "terrain": [0],
    }
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.gnss is not None
    np.testing.assert_allclose(recording.imu.gyro_radps[:, 2], [np.pi / 2, -np.pi / 4], rtol=1e-15)
    np.testing.assert_allclose(recording.imu.accel_mps2[:, 2], 9.80665, rtol=1e-15)
    np.testing.assert_allclose(recording.wheels.speed, [[10, 5], [10, 10]], rtol=1e-15)
    assert recording.gnss.fix.tolist() == [Fix.FIXED]
    assert (recording.vehicle, recording.terrain_name) == ("husky", "mud")
    assert recording.overrides.wheel_radius_m == 0.165
    assert recording.overrides.antenna_m == (0.1, 0.0, 0.9)
    assert any("brought to x forward" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("unit", "epoch", "cells", "wanted"),
    [
        ("s", "unix", ["1700000000.123456789", "1700000000.2"], [START_NS, START_NS + 76_543_211]),
        ("ms", "unix", ["1700000000123.456789"], [START_NS]),
        ("us", "unix", ["1700000000123456.789"], [START_NS]),
        ("ns", "unix", ["1700000000123456789"], [START_NS]),
        ("s", "none", ["-0.5", "1e1"], [-500_000_000, 10_000_000_000]),
        ("s", "gps", ["1388534418"], [ns("2024-01-06T00:00:00")]),
        ("s", "'2024-05-01T12:00:00Z'", ["0.25"], [ns("2024-05-01T12:00:00.25")]),
        ("s", "'2024-05-01T12:00:00+02:00'", ["0"], [ns("2024-05-01T10:00:00")]),
        ("iso8601", "unix", ["2024-05-01T12:00:00.123456789Z", "2024-05-01 14:00:01+01:00"],
         [ns("2024-05-01T12:00:00.123456789"), ns("2024-05-01T13:00:01")]),
        ("iso8601", "unix", ["2024-02-29T23:59:59.5"], [ns("2024-02-29T23:59:59.5")]),
    ],
)  # fmt: skip
def test_times(tmp_path: Path, unit: str, epoch: str, cells: list[str], wanted: list[int]) -> None:
    columns = f"time: {{column: t, unit: {unit}, epoch: {epoch}}}\nchannels: {{imu: {{gyro_z_radps: wz}}}}\n"
    path = table(tmp_path, "t,wz\n" + "".join(f"{cell},0.5\n" for cell in cells), columns)
    imu = open_recording(path).imu
    assert imu is not None
    assert imu.t_ns.tolist() == wanted


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.integers(0, 8 * 10**18), min_size=1, max_size=20).map(sorted),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=20, max_size=20),
)
def test_any_numbers_survive_to_the_bit(tmp_path: Path, times: list[int], values: list[float]) -> None:
    rows = "".join(f"{t // 10**9}.{t % 10**9:09d},{x!r}\n" for t, x in zip(times, values, strict=False))
    imu = open_recording(table(tmp_path, "t,wz\n" + rows)).imu
    assert imu is not None
    assert imu.t_ns.tolist() == times
    assert imu.gyro_radps[:, 2].tolist() == values[: len(times)]


@pytest.mark.parametrize(
    "datum", [(48.1, 11.5, 500.0), (-33.45, -70.66, 570.0), (-17.5, 179.99999, 3.0), (89.99999, 1.0, 0.0)]
)
@pytest.mark.parametrize("scale", [1.0, 1e7])
def test_latitude_and_longitude(tmp_path: Path, datum: tuple[float, float, float], scale: float) -> None:
    s = np.arange(50) * 0.1
    enu = np.stack([1.5 * s, -0.7 * s, 0.1 * s], axis=1)
    llh = enu_to_geodetic(enu, datum)
    unit = "deg" if scale == 1.0 else "1e-7 deg"
    columns = (
        "time: {column: t}\nchannels: {gnss: {latitude_deg: {column: lat, unit: UNIT}, "
        "longitude_deg: {column: lon, unit: UNIT}, height_m: {column: h, unit: mm}}}\n".replace("UNIT", unit)
    )
    rows = zip(s, llh, strict=True)
    text = "t,lat,lon,h\n" + "".join(
        f"{t:.3f},{a * scale:.10f},{b * scale:.10f},{h * 1e3:.3f}\n" for t, (a, b, h) in rows
    )
    recording = open_recording(table(tmp_path, text, columns))
    assert recording.gnss is not None
    assert recording.datum is not None
    back = geodetic_to_enu(enu_to_geodetic(recording.gnss.enu_m, recording.datum), datum)
    np.testing.assert_allclose(back, enu, atol=1e-3)
    assert any("have no sigma" in note for note in recording.notes)


def test_longitudes_beyond_180_are_refused(tmp_path: Path) -> None:
    columns = "time: {column: t}\nchannels: {gnss: {latitude_deg: lat, longitude_deg: lon}}\n"
    with pytest.raises(DataError, match="longitude 200 deg is not on Earth"):
        open_recording(table(tmp_path, "t,lat,lon\n0,48,200\n", columns))


def test_the_columns_of_the_log_folder_need_no_map(tmp_path: Path) -> None:
    text = "t_s,left_mps,right_mps,gyro_z_radps,east_m,north_m,sigma_e_m,sigma_n_m\n"
    text += "0,1,2,0.1,0,0,1,1\n0.5,1,2,,,,,\n"
    recording = open_recording(table(tmp_path, text, None))
    counts = {name: len(channel) for name, channel in recording.channels().items()}
    assert counts == {"wheels": 2, "imu": 1, "gnss": 1}
    assert any("log folder's names" in note for note in recording.notes)


def test_on_the_command_line(tmp_path: Path, terrafusion: Any) -> None:
    path = table(tmp_path, "t,wz\n0,0.5\n1,0.25\n", None)
    told = terrafusion("inspect", path)
    assert (told.status, told.err.count("\n")) == (1, 1)
    assert "nothing says what the columns" in told.err
    (tmp_path / "map.yaml").write_text(GYRO_MAP)
    assert "gyro_z_radps 0.25 to 0.5" in terrafusion("inspect", path, "--columns", tmp_path / "map.yaml").out


def test_held_values_are_dropped(tmp_path: Path) -> None:
    columns = "time: {column: t}\nheld: {wheels: 4}\nchannels: {wheels: {speed_mps: v}}\n"
    text = "t,v\n" + "".join(f"{0.1 * k:.1f},{k // 4}\n" for k in range(16))
    wheels = open_recording(table(tmp_path, text, columns)).wheels
    assert wheels is not None
    assert wheels.speed[:, 0].tolist() == [0, 1, 2, 3]


def test_truth_with_a_plain_yaw(tmp_path: Path) -> None:
    columns = "time: {column: t}\nchannels: {truth: {x_m: x, y_m: y, yaw_rad: {column: yaw, unit: deg}}}\n"
    recording = open_recording(table(tmp_path, "t x y yaw\n0 1 2 90\n1 2 3 -90\n", columns, "truth.txt"))
    assert recording.truth is not None
    np.testing.assert_allclose(recording.truth.yaw_rad(), [np.pi / 2, -np.pi / 2])
    assert recording.truth_channels == ("position", "yaw")


@pytest.mark.parametrize(
    "text",
    [
        "t\twz\n0\t0.5\n1\t0.25\n",
        "# t wz\n0 0.5\n1 0.25\n",
        "# made by x\n# t, wz\n0, 0.5\n1, 0.25\n",
        "\ufefft,wz\r\n0,0.5\r\n1,0.25\r\n",
        't,wz,"a, b"\n0,0.5,"x, y"\n1,0.25,z\n',
        "\n\nt;wz\n0;0.5\n\n1;0.25",
    ],
)
def test_ways_to_write_a_table(tmp_path: Path, text: str) -> None:
    imu = open_recording(table(tmp_path, text)).imu
    assert imu is not None
    assert imu.gyro_radps[:, 2].tolist() == [0.5, 0.25]


def test_no_header_at_all(tmp_path: Path) -> None:
    columns = "time: {column: 1}\nheader: none\nchannels: {imu: {gyro_z_radps: 3}}\n"
    imu = open_recording(table(tmp_path, "0,7,0.5\n1,8,0.25\n", columns)).imu
    assert imu is not None
    assert imu.gyro_radps[:, 2].tolist() == [0.5, 0.25]


def test_the_map_may_lie_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(GYRO_MAP)
    path = table(tmp_path, "t,wz\n0,0.5\n", None)
    assert open_recording(path, columns=tmp_path / "map.yaml").imu is not None


def test_a_map_makes_a_table_of_any_text(tmp_path: Path) -> None:
    """Also of one that another reader would take, in units that it does not have."""
    text = "PacketCounter,SampleTimeFine,Acc_X,Gyr_X\n1,1000000,0.5,90\n2,1016667,0.5,90\n"
    columns = "time: {column: SampleTimeFine, unit: us, epoch: none}\n"
    columns += "channels: {imu: {gyro_x_radps: {column: Gyr_X, unit: deg/s}}}\n"
    imu = open_recording(table(tmp_path, text, columns, "dot.log")).imu
    assert imu is not None
    assert imu.t_ns.tolist() == [1_000_000_000, 1_016_667_000]
    np.testing.assert_allclose(imu.gyro_radps[:, 0], np.pi / 2)


def test_without_a_map_the_error_is_one(tmp_path: Path) -> None:
    """What the error proposes is a valid map, and reads the file."""
    path = table(tmp_path, "time,gyro_x,gyro_y,gyro_z,acc_x,lat,lon,odd name\n0,1,2,3,4,48,11,9\n", None)
    with pytest.raises(DataError, match="nothing says what the columns") as told:
        open_recording(path)
    assert "\n" not in str(told.value)
    proposed = str(told.value).split(".columns.yaml: ", 1)[1]
    (tmp_path / "drive.csv.columns.yaml").write_text(proposed)
    recording = open_recording(path)
    assert recording.imu is not None
    assert recording.gnss is not None
    assert recording.imu.gyro_radps.tolist() == [[1, 2, 3]]
    assert "odd name" not in starter_map(["time", "odd name", "gyro_x"])


WRONG_MAPS = {
    "unknown key": (GYRO_MAP + "chanels: {}\n", "unknown key 'chanels'"),
    "no time": ("channels: {imu: {gyro_z_radps: wz}}\n", "'time' is missing"),
    "no channels": ("time: {column: t}\n", "'channels' is missing"),
    "empty channels": ("time: {column: t}\nchannels: {imu: {}}\n", "'channels' is empty"),
    "unknown channel": (GYRO_MAP.replace("imu", "inu"), "unknown channel 'inu'"),
    "unknown field": (GYRO_MAP.replace("gyro_z", "gyro_w"), "unknown field.*did you mean 'gyro_"),
    "unknown unit": (GYRO_MAP.replace("wz}", "{column: wz, unit: dps}}"), "'dps'; give one of rad/s, deg/s"),
    "no scale": (GYRO_MAP.replace("wz}", "{column: wz, scale: 1/0}}"), "scale.*quotient such as 1/1024"),
    "unknown sign": (GYRO_MAP.replace("wz}", "{column: wz, sign: -1}}"), "sign"),
    "unknown time unit": (GYRO_MAP.replace("t}", "t, unit: min}"), "time.unit.*one of s, ms, us, ns, iso"),
    "an epoch that is no date": (GYRO_MAP.replace("t}", "t, epoch: '2024-13-01'}"), "time.epoch"),
    "unknown epoch": (GYRO_MAP.replace("t}", "t, epoch: yesterday}"), "time.epoch"),
    "axes that are none": (GYRO_MAP + "imu_axes: ['+x', '+y', '-z']\n", "not a rotation"),
    "impossible radius": (GYRO_MAP + "wheel_radius_m: 165\n", "wheel_radius_m.*out of range"),
    "held of nothing": (GYRO_MAP + "held: {gyro: 3}\n", "'held'"),
    "held ground labels": (
        GYRO_MAP + "held: {terrain: 5}\n",
        "'held' names the channel 'terrain'; give comm",
    ),
    "both positions": (
        "time: {column: t}\nchannels: {gnss: {latitude_deg: t, longitude_deg: t, east_m: t, north_m: t}}",
        "one of: latitude_deg, longitude_deg \\| east_m, north_m \\| ecef_x_m",
    ),
    "no mapping": ("- a\n", "mapping"),
    "a list for a column": (GYRO_MAP.replace("wz}", "[wz]}"), "not a section"),
}


@pytest.mark.parametrize("case", WRONG_MAPS)
def test_wrong_maps_are_told_with_the_remedy(tmp_path: Path, case: str) -> None:
    columns, match = WRONG_MAPS[case]
    with pytest.raises(ConfigError, match=match) as told:
        open_recording(table(tmp_path, "t,wz\n0,0.5\n", columns))
    assert "\n" not in str(told.value)


BAD = {
    "no such column": ("t,wy\n0,1\n", "no column 'wz'; the file has t, wy"),
    "header only": ("t,wz\n", "header but no rows"),
    "text in a number": ("t,wz\n0,1\n1,O.5\n", "column 'wz' is 'O.5' at line 3"),
    "infinite": ("t,wz\n0,-inf\n", "column 'wz' is '-inf' at line 2"),
    "bad time": ("t,wz\n0,1\n\nx,2\n", "column 't' is 'x' at line 4"),
    "no time": ("t,wz\n0,1\n,2\n", "line 3 has no 't'"),
    "a time beyond 64 bits": ("t,wz\n1e99,1\n", "column 't' is '1e99'"),
    "a time beyond any date": ("t,wz\n9e9,1\n", "the time of row 1 is 9e"),
    "short line": ("t,wz\n0,1\n1\n2,3\n", "line 3 has 1 cells for 2 columns"),
    "long line": ("t,wz\n0,1\n1,2,3\n", "line 3 has 3 cells for 2 columns"),
    "a column twice": ("t,wz,wz\n0,1,2\n", "'wz' comes twice"),
    "only missing": ("t,wz\n0,\n1,nan\n", "no channel holds a sample"),
    "an open quote": ('t,wz\n0,"1\n', "cannot be read as a table"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_tables_are_told_in_one_line(tmp_path: Path, case: str) -> None:
    text, match = BAD[case]
    with pytest.raises(DataError, match=match) as told:
        open_recording(table(tmp_path, text))
    assert "\n" not in str(told.value)


def test_a_cut_last_line_is_left_out(tmp_path: Path) -> None:
    recording = open_recording(table(tmp_path, "t,wz\n0,1\n1,2\n2"))
    assert recording.imu is not None
    assert len(recording.imu) == 2
    assert any("cut off and is left out" in note for note in recording.notes)


def test_backward_times(tmp_path: Path) -> None:
    t = 0.1 * np.arange(200) - 3.0 * (np.arange(200) >= 100)
    path = table(tmp_path, "t,wz\n" + "".join(f"{x:.3f},0.5\n" for x in t))
    with pytest.raises(DataError, match=r"backwards by 2\.9"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert recording.imu is not None
    assert set(np.diff(recording.imu.t_ns).tolist()) == {100_000_000}
    assert [(jump.channel, jump.step_s) for jump in recording.clock_jumps] == [("imu", -3.0)]


def test_random_bytes_and_one_long_line(tmp_path: Path) -> None:
    path = table(tmp_path, "")
    noise = random.Random(6).randbytes(200_000).replace(b"\0", b"1")
    begun = time.process_time()
    for data in (
        b"t,wz\n" + noise,
        b"t," * 5_000_000,
        b"t,wz\n0" + b"1" * 10_000_000,
        b't,wz\n"' + b"1," * 5_000_000,
    ):
        path.write_bytes(data)
        with pytest.raises(TerrafusionError) as told:
            open_recording(path)
        assert len(str(told.value)) < 20_000
    assert time.process_time() - begun < 10.0


def test_a_quarter_of_a_million_rows_in_seconds(tmp_path: Path) -> None:
    """A tenth of the limit on an idle machine."""
    n = 250_000
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(rng.normal(size=(n, 6)).round(6), columns=list("abcdef"))
    frame.insert(0, "t", np.char.mod("%.6f", 1.7e9 + np.arange(n) * 0.01))
    path = tmp_path / "drive.csv"
    frame.to_csv(path, index=False)
    fields = [
        f"{kind}_{axis}_{unit}" for kind, unit in (("gyro", "radps"), ("accel", "mps2")) for axis in "xyz"
    ]
    told = ", ".join(f"{field}: {column}" for field, column in zip(fields, "abcdef", strict=True))
    (tmp_path / "drive.csv.columns.yaml").write_text(f"time: {{column: t}}\nchannels: {{imu: {{{told}}}}}\n")
    begun = time.process_time()
    recording: Recording = open_recording(path)
    assert time.process_time() - begun < 5.0
    assert recording.imu is not None
    assert len(recording.imu) == n


@pytest.mark.parametrize("text", ["hello\n", "Dear reader,\nthis is a note.\n", "one two\n", "\xfe\xfa\n"])
def test_notes_are_no_tables(tmp_path: Path, text: str) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match="unknown kind of file"):
        open_recording(path)


def test_a_comment_mark_inside_a_cell_is_no_comment(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="2#5"):
        open_recording(table(tmp_path, "t,wz\n0.0,1.0\n0.1,2#5\n"))
    read = open_recording(table(tmp_path, "# recorded on Monday\nt,wz\n# begin\n0.0,1.0\n0.1,2.0\n"))
    assert read.imu is not None
    assert read.imu.gyro_radps[:, 2].tolist() == [1.0, 2.0]


def test_half_a_position_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="only latitude_deg of latitude_deg, longitude_deg; give all"):
        open_recording(table(tmp_path, "t_s,latitude_deg,gyro_z_radps\n0,48.0,0.1\n1,48.0,0.1\n", None))
