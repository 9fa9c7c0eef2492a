"""MCAP out and in again; the file must also open with the format's own library."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.recording import Imu, Recording, Wheels
from terrafusion.datasets.sensors import Rig
from terrafusion.datasets.trajectory import Trajectory
from terrafusion.datasets.writers import write_mcap


def test_round_trip(drive: Recording, tmp_path: Path) -> None:
    left_out = write_mcap(drive, tmp_path / "a.mcap")
    assert [sentence.split(":")[0] for sentence in left_out] == ["motor", "terrain"]
    back = open_recording(tmp_path / "a.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert back.channels().keys() == drive.channels().keys() - {"motor"}
    for name in ("command", "wheels", "imu"):
        ours, theirs = drive.channels()[name], back.channels()[name]
        np.testing.assert_array_equal(ours.t_ns, theirs.t_ns)
        for column, values in ours.columns().items():
            np.testing.assert_array_equal(values, theirs.columns()[column])
    assert drive.gnss is not None
    assert back.gnss is not None
    assert back.datum == drive.datum
    np.testing.assert_array_equal(back.gnss.t_ns, drive.gnss.t_ns)
    np.testing.assert_array_equal(back.gnss.fix, drive.gnss.fix)
    np.testing.assert_allclose(back.gnss.enu_m, drive.gnss.enu_m, atol=1e-7)
    np.testing.assert_allclose(back.gnss.sigma_enu_m, drive.gnss.sigma_enu_m, rtol=1e-15)
    np.testing.assert_array_equal(back.gnss.velocity_enu_mps, drive.gnss.velocity_enu_mps)
    np.testing.assert_allclose(back.gnss.sigma_v_mps, drive.gnss.sigma_v_mps, rtol=1e-15)
    assert back.terrain is not None
    assert drive.terrain is not None
    assert back.terrain.label.tolist() == drive.terrain.label.tolist()
    assert_same_truth(drive.truth, back.truth)
    assert back.truth_channels == drive.truth_channels


def assert_same_truth(a: Trajectory | None, b: Trajectory | None) -> None:
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.t_ns, b.t_ns)
    np.testing.assert_array_equal(a.position_m, b.position_m)
    if a.quaternion is None:
        assert b.quaternion is None
    else:
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
    np.testing.assert_array_equal(a.twist_body, b.twist_body)


def test_planar_truth_of_the_antenna(drive: Recording, tmp_path: Path) -> None:
    assert drive.truth is not None
    position = drive.truth.position_m.copy()
    position[:, 2] = np.nan
    truth = dataclasses.replace(drive.truth, position_m=position, quaternion=None)
    write_mcap(dataclasses.replace(drive, truth=truth, truth_frame="antenna"), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap")
    assert_same_truth(truth, back.truth)
    assert back.truth_frame == "antenna"


def test_the_official_library_reads_it(drive: Recording, tmp_path: Path) -> None:
    assert drive.truth is not None
    covariance = np.tile(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), (len(drive.truth), 1, 1))
    estimate = dataclasses.replace(drive.truth, covariance=covariance)
    write_mcap(drive, tmp_path / "a.mcap", estimate)
    counts: Counter[str] = Counter()
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "/odometry/filtered":
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
                assert (decoded.header.frame_id, decoded.child_frame_id) == ("map", "base_link")
                assert list(decoded.pose.covariance[::7]) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert counts == {
        "/cmd_vel": 1200, "/joint_states": 1200, "/imu/data": 6000, "/datum": 1, "/fix": 300,
        "/fix_velocity": 300, "/terrain": 6, "/ground_truth/odom": 1200, "/odometry/filtered": 1200,
    }  # fmt: skip


def test_an_estimate_in_the_bag_is_not_read_as_wheels(drive: Recording, tmp_path: Path) -> None:
    write_mcap(dataclasses.replace(drive, wheels=None), tmp_path / "a.mcap", drive.truth)
    assert open_recording(tmp_path / "a.mcap").wheels is None


def test_side_speeds_need_a_track(drive: Recording, tmp_path: Path, husky_rig: Rig) -> None:
    assert drive.wheels is not None
    wheels = Wheels(drive.wheels.t_ns, drive.wheels.speed * 0.1651, ("left", "right"), "mps")
    recording = dataclasses.replace(drive, wheels=wheels)
    with pytest.raises(TerrafusionError, match=r"a\.mcap, wheels: .*track"):
        write_mcap(recording, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()
    write_mcap(recording, tmp_path / "a.mcap", rig=husky_rig)
    back = open_recording(tmp_path / "a.mcap", rig=husky_rig).wheels
    assert back is not None
    np.testing.assert_allclose(back.speed, wheels.speed, rtol=1e-13, atol=1e-13)


def test_mean_speed_stays_mean_speed(drive: Recording, tmp_path: Path) -> None:
    assert drive.wheels is not None
    wheels = Wheels(drive.wheels.t_ns, drive.wheels.speed[:, :1], ("speed",), "mps")
    write_mcap(dataclasses.replace(drive, wheels=wheels), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap").wheels
    assert back is not None
    assert back.names == ("speed",)
    np.testing.assert_array_equal(back.speed, wheels.speed)


def test_gyro_alone(drive: Recording, tmp_path: Path) -> None:
    assert drive.imu is not None
    gyro, accel = np.full_like(drive.imu.gyro_radps, np.nan), np.full_like(drive.imu.accel_mps2, np.nan)
    gyro[:, 2] = drive.imu.gyro_radps[:, 2]
    imu = Imu(drive.imu.t_ns, gyro, accel)
    write_mcap(Recording("g", drive.start_ns, imu=imu), tmp_path / "a.mcap")
    back = open_recording(tmp_path / "a.mcap").imu
    assert back is not None
    np.testing.assert_array_equal(back.gyro_radps, gyro)
    assert not back.has_accel()


def test_without_datum_it_is_nominal_and_said(drive: Recording, tmp_path: Path) -> None:
    left_out = write_mcap(dataclasses.replace(drive, datum=None), tmp_path / "a.mcap")
    assert any("no datum" in sentence for sentence in left_out)
    back = open_recording(tmp_path / "a.mcap")
    assert back.gnss is not None
    assert drive.gnss is not None
    assert len(back.gnss) == len(drive.gnss)
    np.testing.assert_allclose(back.gnss.enu_m, drive.gnss.enu_m, atol=1e-7)


def test_existing_file_is_kept_unless_told(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises(TerrafusionError, match="exists already"):
        write_mcap(drive, tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_text() == "precious"
    write_mcap(drive, tmp_path / "a.mcap", overwrite=True)
    assert open_recording(tmp_path / "a.mcap").imu is not None


def test_a_path_that_cannot_be_written(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TerrafusionError, match=r"a\.mcap"):
        write_mcap(drive, tmp_path / "file" / "a.mcap")
