"""What proposed column maps make of the names of columns."""

from pathlib import Path

import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.text.proposed_map import starter_map
from tests.datasets.readers.test_table_headers import proposed


@pytest.mark.parametrize(
    ("names", "fields"),
    [
        ("Track Speed Left (rpm),Track Speed Right (rpm)", ["left_radps", "right_radps"]),
        ("WhlSpdFL,WhlSpdFR,ws_rl,wheelspeed_rr", ["rear_left_mps", "rear_right_mps"]),
        ("LF,RF,LH,RH", ["rear_left_mps", "rear_right_mps"]),
        ("odo_speed,forward_velocity", ["speed_mps"]),
        ("x_utm,y_utm", ["east_m", "north_m"]),
        ("E,N", ["east_m", "north_m"]),
        ("Easting [m],Northing [m],N", ["east_m", "north_m"]),
        ("E,count", []),
    ],
)
def test_names_of_tracks_odometers_and_map_grids_are_proposed(names: str, fields: list[str]) -> None:
    proposal = starter_map(["t", "gz", *names.split(",")])
    known = (
        "rear_left_mps",
        "rear_right_mps",
        " left_radps",
        " right_radps",
        "speed_mps",
        "east_m",
        "north_m",
    )
    assert [name.strip() for name in known if name in proposal.replace("{", " ")] == fields


def test_words_of_a_fix_type_are_not_proposed_as_codes() -> None:
    names = ["t", "lat", "lon", "fix_type"]
    assert "mavlink" in starter_map(names, ["0", "48.1", "11.5", "6"])
    assert "fix" not in starter_map(names, ["0", "48.1", "11.5", "RTK_FIXED"])


@pytest.mark.parametrize(
    ("taken", "others"),
    [
        ("imu1_gz,imu1_ax", "imu2_gz,imu2_ax"),
        ("imu_2_ax,imu2_gz", "imu_1_gz"),
        ("rear_imu_gyro_z", "front_imu_gyro_z,front_imu_acc_z"),
        ("/imu/angular_velocity/z,/imu/linear_acceleration/x", "/b/angular_velocity/z"),
        ("gps1_lat,gps1_lon", "gps2_lat,gps2_lon,gps2_alt"),
        ("/odom/twist/twist/linear/x", "/odometry/filtered/twist/twist/linear/x"),
        ("gps_lat,gps_lon,gnss_hacc,imu_gz,acc_x", ""),
    ],
)
def test_of_several_sensors_the_first_is_proposed_and_said(taken: str, others: str, tmp_path: Path) -> None:
    columns = ",".join(filter(None, (taken, others)))
    (path := tmp_path / "drive.csv").write_text(f"t,{columns}\n0{',1' * len(columns.split(','))}\n")
    with pytest.raises(DataError) as refused:
        open_recording(path)
    said, _, proposal = str(refused.value).partition(".columns.yaml: ")
    assert [name for name in columns.split(",") if f'"{name}"' in proposal] == taken.split(",")
    assert (f"leaves out {others.replace(',', ', ')} (" in said) == bool(others)
    assert ("of several sensors it takes that of" in said) == (others != "" and "filtered" not in others)


def test_axes_in_brackets_and_units_that_nobody_knows(tmp_path: Path) -> None:
    names = "t,Gyro (x),gyro[2],acc[0],Acc Z [foo],Gyro (y) [mdps]"
    (path := tmp_path / "drive.csv").write_text(f"{names}\n0,1,1,1,1,1\n")
    with pytest.raises(DataError, match=r"the units in Acc Z \[foo\] are not known") as refused:
        open_recording(path)
    for entry in (
        'gyro_x_radps: "Gyro (x)"', 'gyro_z_radps: "gyro[2]"', 'accel_x_mps2: "acc[0]"',
        'gyro_y_radps: {column: "Gyro (y) [mdps]", unit: mdeg/s}',
    ):  # fmt: skip
        assert entry in str(refused.value)


@pytest.mark.parametrize(
    ("names", "entries"),
    [
        ("odom_vx,odom_wz,imu_wz", ["speed_mps: odom_vx", "yaw_rate_radps: odom_wz", "gyro_z_radps: imu_wz"]),
        ("gt_x,gt_y,gt_yaw", ["x_m: gt_x", "y_m: gt_y", "yaw_rad: gt_yaw"]),
        ("linear_acceleration_z,acceleration_z", ["accel_z_mps2: acceleration_z"]),
        ("lat,lon,std_lat,lon_stdev", ["sigma_n_m: std_lat", "sigma_e_m: lon_stdev"]),
        ("lat,lon,std_lat", ["longitude_deg: lon}}"]),
    ],
)
def test_names_tell_odometry_truth_and_sigmas(names: str, entries: list[str], tmp_path: Path) -> None:
    proposed(tmp_path, f"t,{names}\n0{',1' * len(names.split(','))}\n")
    columns = (tmp_path / "drive.csv.columns.yaml").read_text().replace('"', "")
    assert [entry for entry in entries if entry not in columns] == []
