"""Tables as loggers write them: units in headers, ticks of encoders, decimal commas."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.text.proposed_map import starter_map
from tests.datasets.readers.test_table import GYRO_MAP, table

HEADERS = {
    "brackets": (
        "timestamp [ms];wx [deg/s];wz [deg/s];ax [m/s^2];left ticks;right ticks;vl [m/s];vr [km/h];"
        "Latitude [deg];Longitude [deg];Altitude [m];fix",
        "1714564800000.5;0;90;1;5;6;2;7.2;48;11;500;4",
    ),
    "suffixes": (
        "stamp_ns,gyro_z_deg_s,acc_z_g,v_left_kmh,v_right_kmh,lat,lon,alt_mm",
        "1714564800000500000,90,1,7.2,7.2,48,11,500000",
    ),
    "milliseconds": (
        "timestamp_ms,imu.gyro.z,speed,gps_lat,gps_lon",
        "1714564800000.5,1.5707963267948966,2,48,11",
    ),
    "no unit of time": ("t,yaw_rate_dps,speed_mps,lat,lon", "1714564800000.5,90,2,48,11"),
    "rpm and quality": (
        "t,gz_dps,RPM_L,RPM_R,lat,lon,fix_quality",
        "1714564800.0005,90,19.098593171027442,19.098593171027442,48,11,4",
    ),
    "decimal commas": ("time;gz [deg/s];speed;lat;lon", "1714564800,0005;90,0;2,0;48,0;11,0"),
}


@pytest.mark.parametrize("case", HEADERS)
def test_the_proposed_map_reads_units_in_headers(tmp_path: Path, case: str) -> None:
    header, row = HEADERS[case]
    path = table(tmp_path, f"{header}\n{row}\n", None)
    with pytest.raises(DataError, match="this proposal, whose fields and units are guesses") as told:
        open_recording(path)
    (tmp_path / "drive.csv.columns.yaml").write_text(str(told.value).split(".columns.yaml: ", 1)[1])
    recording = open_recording(path)
    assert recording.start_ns == 1_714_564_800_000_500_000
    assert recording.imu is not None
    assert recording.imu.gyro_radps[0, 2] == pytest.approx(np.pi / 2)
    assert recording.wheels is not None
    assert recording.wheels.speed[0].tolist() == pytest.approx([2.0] * len(recording.wheels.names))
    assert recording.gnss is not None
    if "acc_z" in header:
        assert recording.imu.accel_mps2[0, 2] == 9.80665
    if "quality" in header:
        assert recording.gnss.fix.tolist() == [Fix.FIXED]
    assert any("decimal commas" in note for note in recording.notes) == (case == "decimal commas")


@pytest.mark.parametrize(
    ("names", "field"),
    [("steer_deg", "angle_rad"), ("SteeringWheelAngle [deg],steering_angle [deg]", "angle_rad"),
     ("SteeringWheelAngle [deg]", "steering_wheel_rad")],
)  # fmt: skip
def test_steering_is_proposed_by_its_name(names: str, field: str) -> None:
    column = names.split(",")[-1]
    expected = f'steering: {{{field}: {{column: "{column}", unit: deg}}}}'
    assert expected in starter_map(["time", "speed", *names.split(",")])


def test_ticks_are_proposed_as_angles_with_a_scale(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * k:.1f},{512 * k},{1024 * k}\n" for k in range(20))
    path = table(tmp_path, f"t,left_ticks,right_ticks\n{rows}", None)
    with pytest.raises(DataError, match="how many ticks make a turn") as told:
        open_recording(path)
    assert "gyro" not in str(told.value)
    (tmp_path / "drive.csv.columns.yaml").write_text(str(told.value).split(".columns.yaml: ", 1)[1])
    recording = open_recording(path)
    assert recording.wheels is not None
    np.testing.assert_allclose(recording.wheels.speed, np.tile([10 * np.pi, 20 * np.pi], (19, 1)))
    assert "wheels: no speeds are there; they are differences of the angles" in recording.notes


@pytest.mark.parametrize(("scale", "factor"), [("1/1024", 1 / 1024), ("'-3/4'", -0.75), ("2.5", 2.5)])
def test_a_scale_multiplies_a_column(tmp_path: Path, scale: str, factor: float) -> None:
    columns = GYRO_MAP.replace("wz}", f"{{column: wz, unit: rev/s, scale: {scale}}}}}")
    imu = open_recording(table(tmp_path, "t,wz\n0,8\n", columns)).imu
    assert imu is not None
    assert imu.gyro_radps[0, 2] == pytest.approx(16 * np.pi * factor)


def test_a_comma_between_words_is_no_decimal_comma(tmp_path: Path) -> None:
    columns = "time: {column: t}\nchannels: {imu: {gyro_z_radps: wz}, terrain: {label: ground}}\n"
    recording = open_recording(table(tmp_path, "t;wz;ground\n0.5;1;mud, wet\n", columns))
    assert recording.terrain is not None
    assert recording.terrain.label[0] == "mud, wet"


def proposed(folder: Path, text: str, encoding: str = "utf-8") -> Recording:
    path = table(folder, "", None)
    path.write_bytes(text.encode(encoding))
    with pytest.raises(DataError) as told:
        open_recording(path)
    path.with_name("drive.csv.columns.yaml").write_text(str(told.value).split(".columns.yaml: ", 1)[1])
    return open_recording(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
def test_any_encoding_of_a_table_is_read(tmp_path: Path, encoding: str) -> None:
    rows = "".join(f"{k / 10:.1f}\t90\t2,0\n" for k in range(9)).replace(".", ",")
    recording = proposed(tmp_path, f"t\tgz [°/s]\tspeed [m/s]\n{rows}", encoding)
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.gyro_radps[:, 2], [np.pi / 2] * 9)


def test_a_packed_table_is_read(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv.gz"
    path.write_bytes(gzip.compress(b"t,wz\n0,1\n1,2\n"))
    (tmp_path / "drive.csv.gz.columns.yaml").write_text(GYRO_MAP)
    assert len(open_recording(path).channels()["imu"]) == 2


@pytest.mark.parametrize("units", ["", "s,deg/s,km/h\n\n", "t,gz,speed\ns,deg/s,km/h\n"])
@pytest.mark.parametrize(
    "preface", ["Logger v1.2, unit 7\n\n", '"Format","CSV File",,"Robot"\n"Duration","150","s","",\n']
)
def test_lines_in_front_of_the_header_are_left_out(tmp_path: Path, preface: str, units: str) -> None:
    recording = proposed(tmp_path, f"{preface}t,gz,speed\n{units}0,90,7.2\n0.1,90,7.2\n")
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.wheels.speed[0, 0] == pytest.approx(2.0 if units else 7.2)
    assert any("in front of the header" in note for note in recording.notes)


def test_columns_of_euroc_are_proposed(tmp_path: Path) -> None:
    places = ",".join(
        f"{name}_{axis} [{unit}]"
        for name, unit in (("w_RS_S", "rad s^-1"), ("a_RS_S", "m s^-2"))
        for axis in "xyz"
    )
    recording = proposed(tmp_path, f"#timestamp [ns],{places}\n1714564800000000000,1,2,3,4,5,6\n")
    assert recording.imu is not None
    assert np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2]).tolist() == [[1, 2, 3, 4, 5, 6]]
    poses = ",".join([*(f"p_RS_R_{axis} [m]" for axis in "xyz"), *(f"q_RS_{axis} []" for axis in "wxyz")])
    (tmp_path / "drive.csv.columns.yaml").unlink()
    recording = proposed(tmp_path, f"#timestamp,{poses}\n1714564800000000000,1,2,3,0,0,0,1\n")
    assert recording.truth is not None
    assert recording.truth.quaternion is not None
    assert recording.truth.quaternion.tolist() == [[0, 0, 1, 0]]


def test_a_long_table_is_named(tmp_path: Path) -> None:
    path = table(tmp_path, "time,id,Signal,Value\n0,0x181,WheelSpeedLeft,1.5\n0,0x201,YawRate,0.2\n", None)
    with pytest.raises(DataError, match=r"a long table: .*export one column for each 'Signal'"):
        open_recording(path)


def test_whole_numbers_of_encoders_are_proposed_as_ticks() -> None:
    names = ["t", "enc_left", "enc_right"]
    assert "unit: rev, scale: 1/1024" in starter_map(names, ["0", "-12", "7"])
    assert "unit: rev" not in starter_map(names, ["0", "-0.12", "0.7"])


def test_minutes_and_seconds_go_on_after_the_hour(tmp_path: Path) -> None:
    recording = proposed(tmp_path, "t,gz\n59:59.9,1\n00:00.4,2\n")
    assert recording.imu is not None
    assert np.diff(recording.imu.t_ns).tolist() == [500_000_000]


def test_a_line_of_units_below_the_header_is_proposed(tmp_path: Path) -> None:
    rows = "0 sec,90,7.2,--\n0.5 sec,N/A,null,1\n"
    recording = proposed(tmp_path, f"Time,GyroZ,Speed,AccZ\n[s],[deg/s],km/h,[g]\n\n{rows}")
    assert recording.imu is not None
    assert recording.wheels is not None
    np.testing.assert_allclose(recording.imu.gyro_radps[:, 2], [np.pi / 2, np.nan])
    np.testing.assert_array_equal(recording.imu.accel_mps2[:, 2], [np.nan, 9.80665])
    assert recording.wheels.speed.tolist() == [[2.0]]
    assert "the line below the header holds units; left out" in recording.notes


@pytest.mark.parametrize(("lat", "lon"), [("4807.5,S", "01130.0,W"), ("48.125,S", "11.5,W")])
def test_hemispheres_and_degrees_with_minutes_are_proposed(lat: str, lon: str, tmp_path: Path) -> None:
    text = f"t,Lat,NS,Lon,EW,gz\n0,,,,,1\n1,{lat},{lon},1\n2,{lat},{lon},1\n"
    recording = proposed(tmp_path, text)
    assert recording.datum is not None
    assert recording.datum[:2] == (-48.125, -11.5)
    assert recording.gnss is not None
    assert len(recording.gnss) == 2
    (tmp_path / "drive.csv").write_text(text.replace(",W,", ",X,"))
    with pytest.raises(DataError, match="column 'EW' is 'X'; give N, S, E or W"):
        open_recording(tmp_path / "drive.csv")


def test_minutes_are_below_sixty(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"column 'Lat' is 4877\.5: no minutes"):
        proposed(tmp_path, "t,Lat,Lon,gz\n1,4807.5,01130.0,1\n2,4877.5,01130.0,1\n")


AS_EXPORTED = {
    "PX4 IMU": (
        "sensor_combined_0.csv",
        "timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0]",
        "6000000,0,0,1,2\n6004000,0,0,1,2",
        'time: {column: "timestamp", unit: us, epoch: none}, channels: {imu: {gyro_x_radps: "gyro_rad[0]", '
        'gyro_y_radps: "gyro_rad[1]", gyro_z_radps: "gyro_rad[2]", accel_x_mps2: "accelerometer_m_s2[0]"}}',
    ),
    "PX4 GPS": (
        "vehicle_gps_position_0.csv",
        "timestamp,lat,lon,alt,vel_m_s,cog_rad",
        "6000000,481000000,115000000,500000,1,0\n6200000,481000000,115000000,500000,1,0",
        'time: {column: "timestamp", unit: us, epoch: none}, channels: {gnss: {latitude_deg: {column: "lat", '
        'unit: "1e-7 deg"}, longitude_deg: {column: "lon", unit: "1e-7 deg"}, '
        'height_m: {column: "alt", unit: mm}}}',
    ),
    "phone's gyroscope": (
        "Gyroscope.csv",
        "seconds_elapsed,z,y,x",
        "0.01,3,2,1\n0.02,3,2,1",
        'channels: {imu: {gyro_z_radps: "z", gyro_y_radps: "y", gyro_x_radps: "x"}}',
    ),
    "phyphox": (
        "Accelerometer.csv",
        '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"',
        "0.01,3,2,1\n0.02,3,2,1",
        'imu: {accel_x_mps2: "Acceleration x (m/s^2)", accel_y_mps2: "Acceleration y (m/s^2)", ',
    ),
    "phone's receiver": (
        "Location.csv",
        "time,speed,bearing,longitude,latitude",
        "1600000000000000000,1,0,11,48\n1600000001000000000,1,0,11,48",
        'unit: ns, epoch: unix}, channels: {gnss: {longitude_deg: "longitude", latitude_deg: "latitude"}}',
    ),
    "odometry, whose place is no truth": (
        "odometry.csv",
        "time,x,y,theta,v,w",
        "0.1,1,2,0,1,0.1\n0.2,1,2,0,1,0.1",
        'channels: {wheels: {speed_mps: "v", yaw_rate_radps: "w"}}',
    ),
    "Arduino": (
        "log.csv",
        "millis,v_left,v_right",
        "10,1,1\n60,1,1",
        'time: {column: "millis", unit: ms, epoch: none}, channels: {wheels: {left_mps: "v_left", ',
    ),
}


@pytest.mark.parametrize("case", AS_EXPORTED)
def test_exports_of_autopilots_and_phones_are_proposed(case: str, tmp_path: Path) -> None:
    name, header, rows, expected = AS_EXPORTED[case]
    (tmp_path / name).write_text(f"{header}\n{rows}\n")
    with pytest.raises(DataError) as told:
        open_recording(tmp_path / name)
    assert expected in str(told.value)


@pytest.mark.parametrize(
    ("first", "step", "entry"),
    [
        (987_654_321_012, 33_333_333, "unit: ns, epoch: none"),
        (5_000 * 10**9, 33_333_333, "unit: ns, epoch: none"),
        (5_000 * 10**6, 33_333, "unit: us, epoch: none"),
        (432_000_000, 10, "unit: ms, epoch: none"),
        (1_704_067_200, 1, "unit: s, epoch: unix"),
        (1_704_067_200_000, 20, "unit: ms, epoch: unix"),
    ],
)
def test_times_since_the_computer_was_started_are_no_dates(first: int, step: int, entry: str) -> None:
    """5000 s in ns were taken for ms in 2128, and rows to be nine hours apart."""
    times = [first + k * step for k in range(20)]
    assert entry in starter_map(["t", "gz"], [str(first), "0"], sample=lambda name: times)


def test_a_table_without_times_says_which_column_is_taken_for_them(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no name is a time's: does 'row' hold seconds"):
        open_recording(table(tmp_path, "row,gz\n0,1\n1,1\n", None))
    recording = proposed(tmp_path, "gz,when\n1,2024-05-01 12:00:00\n1,2024-05-01 12:00:01\n")
    assert recording.start_ns == 1_714_564_800 * 10**9


def test_a_sigma_of_the_height_that_is_not_given_is_twice_the_horizontal_one(tmp_path: Path) -> None:
    recording = proposed(tmp_path, "t,lat,lon,alt,hAcc\n0,48,11,500,0.5\n1,48,11,500,0.7\n")
    assert recording.gnss is not None
    assert recording.gnss.sigma_enu_m.tolist() == [[0.5, 0.5, 1.0], [0.7, 0.7, 1.4]]


@pytest.mark.parametrize("names", ["t,left,right", "t,left_wheel,right_wheel", "t;wheel_l;wheel_r"])
def test_columns_that_name_only_a_side_are_proposed_as_wheels(tmp_path: Path, names: str) -> None:
    path = tmp_path / "drive.csv"
    path.write_text(f"{names}\n0,1,1\n")
    with pytest.raises(DataError, match=r"wheels: \{left_mps: .*, right_mps: "):
        open_recording(path)


def test_a_proposal_reads_accuracy_and_g_and_names_what_it_leaves_out(tmp_path: Path) -> None:
    header = "t,AccX,AccY,AccZ,GyroZ,Lat,Lon,HAcc,FixQual,Battery"
    path = table(tmp_path, f"{header}\n0,0.04,0.02,1.005,0.1,48,11,0.5,4,12.1\n", None)
    with pytest.raises(DataError, match="which leaves out Battery ") as told:
        open_recording(path)
    (tmp_path / "drive.csv.columns.yaml").write_text(str(told.value).split(".columns.yaml: ", 1)[1])
    recording = open_recording(path)
    assert recording.imu is not None
    assert recording.imu.accel_mps2[0, 2] == pytest.approx(1.005 * 9.80665)
    assert recording.gnss is not None
    assert recording.gnss.sigma_enu_m[0, :2].tolist() == [0.5, 0.5]
    assert recording.gnss.fix.tolist() == [Fix.FIXED]


@pytest.mark.parametrize(("header", "end"), [("t,gz,speed", ","), ("t,gz,speed,", ""), ("t,gz,speed,", ",")])
def test_lines_may_end_in_a_separator(header: str, end: str, tmp_path: Path) -> None:
    recording = proposed(tmp_path, f"{header}\n0,90,7.2{end}\n0.1,90,7.2{end}\n")
    assert recording.wheels is not None
    assert recording.wheels.speed.tolist() == [[7.2], [7.2]]


def test_integers_of_a_receiver_are_proposed_in_its_units(tmp_path: Path) -> None:
    names = "iTOW,lat,lon,height,hAcc,vAcc,velN,velE,velD,sAcc,fixType"
    row = "481000000,115000000,500000,15,30,-1250,600,20,100,3"
    recording = proposed(tmp_path, f"{names}\n1000,{row}\n1200,{row}\n")
    assert recording.gnss is not None
    assert recording.gnss.sigma_enu_m[0] == pytest.approx([0.015, 0.015, 0.03])
    assert recording.gnss.velocity_enu_mps is not None
    assert recording.gnss.velocity_enu_mps[0] == pytest.approx([0.6, -1.25, -0.02])
    assert recording.gnss.sigma_v_mps is not None
    assert recording.gnss.sigma_v_mps[0] == pytest.approx(0.1)
    assert recording.gnss.fix[0] == Fix.SINGLE


def test_the_fix_type_of_mavlink_is_proposed(tmp_path: Path) -> None:
    recording = proposed(tmp_path, "t,lat,lon,fix_type\n0,48,11,1\n1,48,11,4\n2,48,11,5\n3,48,11,6\n")
    assert recording.gnss is not None
    assert recording.gnss.fix.tolist() == [Fix.DGPS, Fix.FLOAT, Fix.FIXED]


def test_the_speed_of_motors_is_proposed_with_a_gear_ratio_to_fill_in(tmp_path: Path) -> None:
    recording = proposed(tmp_path, "t,motor_rpm_left,motor_rpm_right\n0,300,600\n")
    assert recording.wheels is not None
    assert recording.wheels.speed[0] == pytest.approx([np.pi / 3, 2 * np.pi / 3])
    (tmp_path / "drive.csv.columns.yaml").unlink()
    with pytest.raises(DataError, match=r"1/30: what is the gear ratio\?"):
        open_recording(tmp_path / "drive.csv")


@pytest.mark.parametrize(
    ("text", "rpm", "said"),
    [
        ('t,gz,left_rpm,right_rpm\n0,1,999.5,"1,999.5"\n1,234,567,"1,000"\n', [999.5, 1999.5], "thousands"),
        ('t,gz,left_rpm,right_rpm\n0,1,"-1,234,567",2\n', [-1234567, 2], "thousands"),
        ("t;gz;left_rpm;right_rpm\n0;1;999.5;1,999.5\n1;2; 3,000;4\n", [999.5, 1999.5], "thousands"),
        ('t,gz,left_rpm,right_rpm\n0,"1,5","0,25","1,125"\n', [0.25, 1.125], "decimal commas"),
        ("t;gz;left_rpm;right_rpm\n0;1;2,125;1,125\n", [2.125, 1.125], "decimal commas"),
    ],
)
def test_commas_between_thousands_or_for_points(
    text: str, rpm: list[float], said: str, tmp_path: Path
) -> None:
    found = proposed(tmp_path, text)
    assert found.wheels is not None
    np.testing.assert_allclose(found.wheels.speed[0], np.pi / 30.0 * np.array(rpm))
    assert sum(said in note for note in found.notes) == 1


def test_a_comma_that_may_be_either_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"column 'right_rpm' is '1,125' at line 2"):
        proposed(tmp_path, 't,gz,left_rpm,right_rpm\n0,1,2,"1,125"\n')


@pytest.mark.parametrize(
    ("names", "rows", "start"),
    [
        ("utc_time,date", "235959.5,010524 000000.0,020524", "2024-05-01T23:59:59.5"),
        ("utc,gx", "93015.25,0 93016.0,0", "1970-01-01T09:30:15.25"),
        ("time,gx", "0_days_23:59:59.500000,0 1_days_00:00:00,0", "1970-01-01T23:59:59.5"),
    ],
)
def test_times_of_day_without_colons_and_of_pandas(names: str, rows: str, start: str, tmp_path: Path) -> None:
    lines = "".join(f"{row.replace('_', ' ')},1\n" for row in rows.split(" "))
    imu = proposed(tmp_path, f"{names},gz\n{lines}").imu
    assert imu is not None
    assert imu.t_ns[0] == np.datetime64(start, "ns").astype(np.int64)
    assert 0 < imu.t_ns[1] - imu.t_ns[0] < 10**9


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([45413.5 + k / 86400e2 for k in range(30)], r"rows are 1.2e-07 s apart.*as Excel counts them"),
        (
            [120000 + 100 * (k // 60) + k % 60 for k in range(300)],
            "seconds such as 120000; give it the unit iso",
        ),
    ],
)
def test_times_that_are_no_seconds_are_refused(times: list[float], said: str, tmp_path: Path) -> None:
    rows = "".join(f"{t:.9f},1\n" for t in times)
    path = table(
        tmp_path,
        f"clock,gz\n{rows}",
        "time: {column: clock, epoch: none}\nchannels: {imu: {gyro_z_radps: gz}}",
    )
    with pytest.raises(DataError, match=said):
        open_recording(path)


def test_a_first_row_with_a_word_in_it_is_no_header(tmp_path: Path) -> None:
    """So does `ros2 topic echo --csv` write messages."""
    (path := tmp_path / "drive.csv").write_text("1714564800,5,imu_link,0.1\n1714564801,5,imu_link,0.2\n")
    with pytest.raises(
        DataError, match=r"columns 1, 2, 3, 4 \(first row: 1714564800, 5, imu_link.*header: none"
    ):
        open_recording(path)
