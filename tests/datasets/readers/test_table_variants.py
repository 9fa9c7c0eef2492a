"""Tables and sentences as loggers write them: blanks, other encodings, repeated times, codes of one maker."""

from __future__ import annotations

from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pymap3d
import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording


def table(folder: Path, text: str, channels: str = "") -> Path:
    path = folder / "log.csv"
    path.write_text(text, encoding="utf-8")
    if channels:
        columns = f"time: {{column: t, epoch: none}}\nchannels: {{{channels}}}\n"
        path.with_name("log.csv.columns.yaml").write_text(columns, encoding="utf-8")
    return path


def test_missing_values_between_blanks(tmp_path: Path) -> None:
    text = "t , gz , a\n0.0 , nan , 2\n1.0 , 1.0 , 2\n2.0 , 1.5 , nan \n"
    imu = open_recording(table(tmp_path, text, "imu: {gyro_z_radps: gz, accel_x_mps2: a}")).imu
    assert imu is not None
    np.testing.assert_array_equal(imu.gyro_radps[:, 2], [np.nan, 1.0, 1.5])
    np.testing.assert_array_equal(imu.accel_mps2[:, 0], [2.0, 2.0, np.nan])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_header_that_comes_again_is_left_out(end: str, tmp_path: Path) -> None:
    """Loggers that begin anew write it again; Excel is told the separator in front of it."""
    lines = ["sep=;", "t;gz", "0,0;1", "t;gz", "t;gz", "1,0;1,5", "2,0;2", ""]
    recording = open_recording(table(tmp_path, end.join(lines), "imu: {gyro_z_radps: gz}"))
    assert recording.imu is not None
    assert recording.imu.gyro_radps[:, 2].tolist() == [1.0, 1.5, 2.0]
    assert any("the header comes 2 more times" in note for note in recording.notes)


@pytest.mark.parametrize("field", ["p_radps", "q_radps"])
def test_roll_and_pitch_rates_have_units(field: str, tmp_path: Path) -> None:
    channels = f"truth: {{x_m: x, y_m: y, u_mps: x, v_mps: y, {field}: {{column: p, unit: deg/s}}}}"
    truth = open_recording(table(tmp_path, "t,x,y,p\n0,1,2,180\n1,2,3,180\n", channels)).truth
    assert truth is not None
    assert truth.twist_body is not None
    assert np.nanmax(truth.twist_body[:, 3:]) == pytest.approx(np.pi)


def test_poses_with_a_repeated_time_are_left_out_and_counted(tmp_path: Path) -> None:
    found = open_recording(table(tmp_path, "t,x,y\n0,1,2\n0,1,2\n1,2,3\n", "truth: {x_m: x, y_m: y}"))
    assert found.truth is not None
    assert len(found.truth) == 2
    assert any("1 poses with a repeated time" in note for note in found.notes)


@pytest.mark.parametrize("names", ["left_v,right_v,gyro_z", "front_rad,left_mps,right_mps"])
def test_a_proposed_map_opens(names: str, tmp_path: Path) -> None:
    path = table(tmp_path, f"t,{names}\n0,1,1,0\n0.1,1,1,0\n")
    with pytest.raises(DataError) as refused:
        open_recording(path)
    proposed = "{" + str(refused.value).rpartition("columns.yaml: {")[2]
    path.with_name("log.csv.columns.yaml").write_text(proposed, encoding="utf-8")
    open_recording(path)


def test_fixes_aided_by_satellites_of_one_maker(tmp_path: Path) -> None:
    """GGA quality 9 (NovAtel OEM)."""

    def sentence(k: int) -> str:
        body = f"GPGGA,1200{k:02d}.00,4807.{k:04d},N,01131.0000,E,9,08,0.9,545.4,M,46.9,M,,"
        return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n"

    path = tmp_path / "log.nmea"
    path.write_text("".join(sentence(k) for k in range(20)), encoding="utf-8")
    gnss = open_recording(path).gnss
    assert gnss is not None
    assert len(gnss) == 20


@pytest.mark.parametrize(("offset", "said"), [("+02", False), ("+0200", False), ("Z", False), ("", True)])
def test_times_with_an_offset_are_not_said_to_have_none(offset: str, said: bool, tmp_path: Path) -> None:
    rows = "".join(f"2024-05-01 12:00:0{k}{offset},{k}\n" for k in range(3))
    path = table(tmp_path, f"t,gz\n{rows}")
    columns = "time: {column: t, unit: iso8601}\nchannels: {imu: {gyro_z_radps: gz}}\n"
    path.with_name("log.csv.columns.yaml").write_text(columns, encoding="utf-8")
    notes = open_recording(path).notes
    assert any("without an offset" in note for note in notes) == said


EXPORTS = {
    "rostopic echo -p": (
        "%time,field.header.stamp,field.orientation.x,field.angular_velocity.z,field.linear_acceleration.x\n"
        "1700000000900000000,1700000000500000000,0,0.25,9\n",
        ("imu", 1_700_000_000_500_000_000, 0.25),
    ),
    "times split into seconds and nanoseconds": (
        "header.stamp.secs,header.stamp.nsecs,angular_velocity.z\n1700000000,500000000,0.25\n",
        ("imu", 1_700_000_000_500_000_000, 0.25),
    ),
    "of ROS 2": (
        "header.stamp.sec,header.stamp.nanosec,angular_velocity.z\n1700000000,500000000,0.25\n",
        ("imu", 1_700_000_000_500_000_000, 0.25),
    ),
    "paths of topics": (
        "__time,/imu/data/angular_velocity/z,/cmd_vel/linear/x\n1700000000.5,0.25,3\n",
        ("imu", 1_700_000_000_500_000_000, 0.25),
    ),
}


@pytest.mark.parametrize("kind", EXPORTS)
def test_exports_of_ros_messages_are_proposed(kind: str, tmp_path: Path) -> None:
    text, (channel, t_ns, rate) = EXPORTS[kind]
    recording = opened_as_proposed(tmp_path, text)
    assert list(recording.channels()) == [channel]
    assert recording.imu is not None
    assert recording.imu.t_ns.tolist() == [t_ns]
    assert recording.imu.gyro_radps[0, 2] == rate


MIDNIGHT_NS = 1_600_041_600 * 10**9
"""2020-09-14, in GPS week 2123 at 86418 s."""
CLOCKS = {
    "date and time of day": ("Date,Time", "2020-09-13,23:59:59.75", "2020-09-14,00:00:00.25"),
    "with points and commas": ("Datum;Uhrzeit", "13.9.2020;23:59:59,75", "14.9.2020;0:00:00,25"),
    "day first": ("id;time", "7;13.09.2020 23:59:59,75", "8;14.09.2020 00:00:00,25"),
    "United States": ("time", "9/13/2020 11:59:59.75 PM", "9/14/2020 12:00:00.25 am"),
    "slashes, day first": ("time", "13/09/2020 23:59:59.75 UTC", "14/09/2020 00:00:00.25 UTC"),
    "MATLAB": ("Time", "13-Sep-2020 23:59:59.75", "14-Sep-2020 00:00:00.25"),
    "offset behind a blank": ("time", "2020-09-14 01:59:59.75 +0200", "2020-09-14 02:00:00.25 +0200"),
    "GPS week and seconds": ("GPS Week,TOW [s]", "2123,86417.75", "2123,86418.25"),
    "GPS week and milliseconds": ("week,iTOW", "2123,86417750", "2123,86418250"),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_times_in_two_columns_or_of_a_day_are_proposed(kind: str, tmp_path: Path) -> None:
    separator = ";" if ";" in CLOCKS[kind][0] else ","
    ends = ("gyro_z", "0.5", "0.25") if separator == "," else ("gyro_z", "0,5", "0,25")
    text = "".join(f"{line}{separator}{end}\n" for line, end in zip(CLOCKS[kind], ends, strict=True))
    imu = opened_as_proposed(tmp_path, text).imu
    assert imu is not None
    assert imu.t_ns.tolist() == [MIDNIGHT_NS - 250_000_000, MIDNIGHT_NS + 250_000_000]
    assert imu.gyro_radps[:, 2].tolist() == [0.5, 0.25]


@pytest.mark.parametrize("date", ["05/01/2020 12:00:00", "13/13/2020 12:00:00", "1-Foo-2020 12:00:00"])
def test_a_date_that_is_not_clear_is_refused(date: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"column 'time' is '{date}' in row 1.*nothing tells day and month"):
        opened_as_proposed(tmp_path, f"time,gyro_z\n{date},1\n")


@pytest.mark.parametrize("date", ["05/01/2024 12:00:00.5 PM", "5/1/2024 12:00 pm", "4/30/2024 12:00:00.5 PM"])
def test_the_month_is_first_beside_am_and_pm_and_that_is_said(date: str, tmp_path: Path) -> None:
    found = opened_as_proposed(tmp_path, f"time,gyro_z\n{date},1\n")
    clear = "30" in date
    day = "2024-04-30" if clear else "2024-05-01"
    assert found.start_ns // 10**9 == np.datetime64(f"{day}T12:00:00").astype(int)
    assert any(f"the month is taken first in dates such as {date}" in note for note in found.notes) != clear


def test_a_column_that_gives_all_rows_one_time_is_refused(tmp_path: Path) -> None:
    path = table(tmp_path, "t,day,gyro_z\n" + "2020-09-13,5,1\n" * 60)
    path.with_name("log.csv.columns.yaml").write_text(
        "time: {column: t, unit: iso8601}\nchannels: {imu: {gyro_z_radps: gyro_z}}\n", encoding="utf-8"
    )
    with pytest.raises(
        DataError, match=r"all 60 rows have the same time by column 't'; map 'time' to another"
    ):
        open_recording(path)


def test_the_speed_of_a_receiver_is_not_proposed_as_that_of_wheels(tmp_path: Path) -> None:
    text = "t,gps_speed,speed,gps_lat,gps_lon,imu_yaw,x,y\n0,9,1,48,11,0,1,2\n1,9,1,48,11,0,1,2\n"
    recording = opened_as_proposed(tmp_path, text)
    assert recording.wheels is not None
    assert recording.wheels.speed.tolist() == [[1.0], [1.0]]
    assert recording.truth is not None
    assert recording.truth.quaternion is None


@pytest.mark.parametrize("end", ["0", "_0", "[0]"])
def test_variances_of_fixes_are_proposed(end: str, tmp_path: Path) -> None:
    names = [f"/fix/position_covariance{end.replace('0', i)}" for i in "048"]
    text = f"t,/fix/latitude,/fix/longitude,{','.join(names)}\n0,48.1,11.5,0.25,0.25,4\n1,48.1,11.5,-1,0,4\n"
    gnss = opened_as_proposed(tmp_path, text).gnss
    assert gnss is not None
    np.testing.assert_allclose(gnss.sigma_enu_m[0], [0.5, 0.5, 2.0])
    assert (gnss.sigma_enu_m[1] >= 0.5).all()  # nothing is known of it


@pytest.mark.parametrize(
    "names",
    ["t,v,w", "t,field.twist.twist.linear.x,field.twist.twist.angular.z", "t,speed_mps,yaw_rate_radps"],
)
def test_speed_and_yaw_rate_are_the_sides_of_the_odometrys_track(names: str, tmp_path: Path) -> None:
    text = f"{names}\n0,1.0,0.5\n1,2.0,-0.5\n"
    wheels = opened_as_proposed(tmp_path, text).wheels
    assert wheels is not None
    np.testing.assert_allclose(wheels.speed, [[0.75, 1.25], [2.25, 1.75]])
    columns = tmp_path / "drive.csv.columns.yaml"
    columns.write_text((proposed := columns.read_text()).replace("track_m: 1,", "track_m: 0.6,"))
    wheels = open_recording(tmp_path / "drive.csv").wheels
    assert wheels is not None
    np.testing.assert_allclose(wheels.speed, [[0.85, 1.15], [2.15, 1.85]])
    columns.write_text(proposed.replace("track_m: 1,", ""))
    with pytest.raises(DataError, match=r"wheels: speed and yaw rate need the track; give track_m"):
        open_recording(tmp_path / "drive.csv")


def test_a_first_line_of_numbers_is_no_header(tmp_path: Path) -> None:
    (path := tmp_path / "gps.csv").write_text(
        "1700000000000000000,48.1,11.5\n1700000001000000000,48.1,11.6\n"
    )
    with pytest.raises(DataError, match=r"columns 1, 2, 3 \(first row: 1700.*header: none.*unit: ns"):
        open_recording(path)


def test_nanoseconds_beyond_a_second_are_refused(tmp_path: Path) -> None:
    text = "secs,nsecs,wz\n1700000000,1500000000,0.1\n"
    with pytest.raises(DataError, match="no nanoseconds below a second"):
        opened_as_proposed(tmp_path, text)


@pytest.mark.parametrize(
    "names", ["delta_left_ticks,delta_right_ticks", "dEncL,dEncR", "l_enc_inc,r_enc_inc"]
)
def test_ticks_of_each_row_are_added_up(names: str, tmp_path: Path) -> None:
    wheels = opened_as_proposed(tmp_path, f"t,{names}\n0,7,7\n0.1,512,256\n0.2,,\n0.3,512,256\n").wheels
    assert wheels is not None
    assert wheels.angle_rad is not None
    np.testing.assert_allclose(np.diff(wheels.angle_rad, axis=0), [[np.pi, np.pi / 2]])


def test_ticks_of_each_row_that_are_taken_for_angles_are_noted(tmp_path: Path) -> None:
    text = "t,left_ticks,right_ticks\n" + "".join(f"{k},{30 + abs(k % 14 - 7)},30\n" for k in range(40))
    notes = opened_as_proposed(tmp_path, text).notes
    assert any(
        "no angle leaves a range of 0.043 rad in 38 s" in note and "increments" in note for note in notes
    )
    columns = tmp_path / "drive.csv.columns.yaml"
    assert "increments" not in columns.read_text()
    columns.write_text(columns.read_text().replace("1/1024", "1/1024, increments: true"))
    assert not any("no angle leaves" in note for note in open_recording(tmp_path / "drive.csv").notes)
    columns.write_text("{time: t, channels: {imu: {gyro_z_radps: {column: left_ticks, increments: true}}}}")
    with pytest.raises(ConfigError, match="only angles of wheels come as increments"):
        open_recording(tmp_path / "drive.csv")


def test_ticks_of_each_row_that_rows_hold_are_counted_once(tmp_path: Path) -> None:
    """A table at the rate of the IMU holds them for three rows: the robot drove three times as far."""
    ticks = [8 + k % 7 for k in range(60)]
    rows = "".join(f"{k / 30:.3f},{ticks[k // 3]},{ticks[k // 3] + 1}\n" for k in range(180))
    recording = opened_as_proposed(tmp_path, f"t,d_left_ticks,d_right_ticks\n{rows}")
    assert "wheels: increments stay for 3 rows: if these hold them, add held: {wheels: 3}" in recording.notes
    columns = tmp_path / "drive.csv.columns.yaml"
    columns.write_text(columns.read_text().replace("{time", "{held: {wheels: 3}, time", 1))
    wheels = open_recording(tmp_path / "drive.csv").wheels
    assert wheels is not None
    assert wheels.angle_rad is not None
    np.testing.assert_allclose(np.diff(wheels.angle_rad[:, 0]), 2.0 * np.pi / 1024 * np.array(ticks[2:]))


@pytest.mark.parametrize("names", ["ecef_x,ecef_y,ecef_z", "ecefX [cm],ecefY [cm],ecefZ [cm]", "x,y,z"])
def test_earth_centred_positions_are_fixes(names: str, tmp_path: Path) -> None:
    """Of a table of x, y, z they were the truth of a robot 6 000 km from its origin."""
    scale = 100.0 if "cm" in names else 1.0
    places = [pymap3d.geodetic2ecef(48.1, 11.5 + 1e-4 * k, 500.0) for k in range(3)]
    rows = "".join(
        f"{k},{','.join(f'{value * scale:.3f}' for value in one)}\n" for k, one in enumerate(places)
    )
    recording = opened_as_proposed(tmp_path, f"t,{names}\n{rows}3,0,0,0\n")
    assert recording.truth is None
    assert recording.gnss is not None
    east = [pymap3d.geodetic2enu(48.1, 11.5 + 1e-4 * k, 500.0, 48.1, 11.5, 500.0)[0] for k in range(3)]
    np.testing.assert_allclose(recording.gnss.enu_m[:, 0], east, atol=2e-3)
    assert recording.datum == pytest.approx((48.1, 11.5, 500.0), abs=1e-2)
    columns = tmp_path / "drive.csv.columns.yaml"
    columns.write_text(columns.read_text().replace("unit: cm", "unit: m"))
    if "cm" in names:
        with pytest.raises(DataError, match=r"6\.3\d+e\+08 m from the centre of the Earth by ecef_x_m"):
            open_recording(tmp_path / "drive.csv")


def test_zeros_in_most_rows_are_no_fixes(tmp_path: Path) -> None:
    rows = "".join(f"{k},{'48.1,11.5' if k % 5 == 3 else '0.0,0.0'}\n" for k in range(20))
    found = opened_as_proposed(tmp_path, f"t,lat,lon\n{rows}")
    assert found.gnss is not None
    assert found.gnss.enu_m[:, :2].tolist() == [[0.0, 0.0]] * 4
    assert any("16 of 20 rows hold no fix; left out" in note for note in found.notes)


def test_headings_in_degrees_are_no_yaw_in_radians(tmp_path: Path) -> None:
    """A heading in degrees is a compass's, clockwise from north; the yaw of a pose keeps its sense."""
    rows = "0,0,0,{0}\n1,1,0,{1}\n"
    truth = opened_as_proposed(tmp_path, "t,x,y,yaw\n" + rows.format(90, 45)).truth
    assert truth is not None
    np.testing.assert_allclose(truth.quaternion, [[0, 0, 0.5**0.5, 0.5**0.5], [0, 0, 0.38268343, 0.92387953]])
    truth = opened_as_proposed(tmp_path, "t,x,y,heading\n" + rows.format(1.5, 1.6)).truth
    assert truth is not None
    assert truth.quaternion is not None
    truth = opened_as_proposed(tmp_path, "t,x,y,heading\n" + rows.format(350.0, 3.0)).truth
    assert truth is not None
    assert truth.quaternion is None


def opened_as_proposed(folder: Path, text: str) -> Recording:
    """A table, opened by the map that the error without one proposes."""
    path = folder / "drive.csv"
    path.write_text(text)
    (columns := folder / "drive.csv.columns.yaml").unlink(missing_ok=True)
    with pytest.raises(DataError) as told:
        open_recording(path)
    columns.write_text("{" + str(told.value).split(".columns.yaml: {", 1)[1])
    return open_recording(path)
