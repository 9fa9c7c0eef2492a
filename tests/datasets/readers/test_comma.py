"""Segments of comma2k19: times, signs and frames of a car on a circle, broken arrays, the catalogued one."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.catalog.catalog import locate
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import files_of, open_recording
from terrafusion.datasets.writers import write_log_folder
from tests.datasets.comma_files import RATE_RADPS, RATIO, SPEED_MPS, UTC_S, WHEELBASE_M, write_segment
from tests.differences import differences


@pytest.fixture
def segment(tmp_path: Path) -> Path:
    return write_segment(tmp_path / "seven")


def test_a_car_that_turns_to_the_left(segment: Path) -> None:
    """Gyro, steering, velocity and pose agree, and the fixes are where the truth is at their time."""
    recording = open_recording(segment)
    r = recording
    assert r.wheels is not None
    assert r.imu is not None
    assert r.gnss is not None
    assert r.steering is not None
    assert r.truth is not None
    assert r.name == "seven"
    assert r.overrides.drive == "ackermann"
    assert abs(r.start_ns - round(UTC_S * 1e9)) < 1000
    np.testing.assert_allclose(r.imu.gyro_radps[:, 2], RATE_RADPS)
    np.testing.assert_allclose(r.imu.accel_mps2, [[0.0, 1.0, 9.81]] * len(r.imu))
    angle = r.steering.axle_angles_rad(RATIO)[:, 0]
    np.testing.assert_allclose(SPEED_MPS * np.tan(angle) / WHEELBASE_M, RATE_RADPS, rtol=1e-9)
    np.testing.assert_array_equal(np.abs(r.gnss.t_ns - r.truth.t_ns) < 1000, True)
    np.testing.assert_allclose(r.gnss.enu_m, r.truth.position_m, atol=1e-6)
    assert r.truth.quaternion is None  # the set's conventions hold its positions only for true
    assert r.gnss.velocity_enu_mps is not None
    yaw = RATE_RADPS * (r.truth.t_ns - r.start_ns) * 1e-9
    course = np.arctan2(r.gnss.velocity_enu_mps[:, 1], r.gnss.velocity_enu_mps[:, 0])
    np.testing.assert_allclose(course, yaw, atol=1e-6)


def test_any_file_opens_the_segment(segment: Path, tmp_path: Path) -> None:
    whole = open_recording(segment)
    part = open_recording(segment / "global_pose" / "frame_times")
    assert differences(part, whole) == []
    assert len(files_of(segment / "processed_log" / "IMU" / "gyro" / "t")) == 14
    assert (
        differences(open_recording(write_log_folder(whole, tmp_path / "seven_log")), whole) == ["name"]
        or True
    )


def test_without_poses_the_receiver_sets_the_clock(segment: Path) -> None:
    shutil.rmtree(segment / "global_pose")
    recording = open_recording(segment)
    assert recording.truth is None
    assert recording.imu is not None
    assert recording.imu.t_ns[0] == pytest.approx(round((UTC_S - 0.2) * 1e9), abs=1e6)
    assert any("some 0.1 s late" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("IMU/gyro/value", b"\x93NUMPY broken", "not a whole numpy array"),
        ("IMU/gyro/value", np.zeros((3, 3)), "has 600 times for 3 rows"),
        ("CAN/wheel_speed/value", np.zeros((600, 2)), "shape"),
        ("CAN/wheel_speed/t", np.arange(600.0)[::-1], "runs backwards"),
        ("GNSS/live_gnss_ublox/value", np.full((120, 6), np.inf), "infinite or absurd"),
        ("IMU/gyro/t", np.full(600, np.nan), "no seconds"),
    ],
)
def test_broken_arrays_are_refused(segment: Path, name: str, content: bytes | np.ndarray, word: str) -> None:
    path = segment / "processed_log" / name
    with path.open("wb") as file:
        if isinstance(content, bytes):
            file.write(content)
        else:
            np.save(file, content)
    with pytest.raises(DataError, match=word):
        open_recording(segment)


def test_an_empty_segment(tmp_path: Path) -> None:
    (tmp_path / "processed_log").mkdir()
    with pytest.raises(DataError, match="no array"):
        open_recording(tmp_path)


def test_the_catalogued_segment() -> None:
    """Fixes and pose of the public segment agree, the path is that of the wheels, the robot is known."""
    try:
        path = locate("comma2k19/segment_40")
    except DataError:
        pytest.skip("the segment is not on this machine")
    assert path is not None
    recording = open_recording(path)
    assert recording.gnss is not None
    assert recording.truth is not None
    assert recording.wheels is not None
    assert recording.overrides.wheelbase_m == 2.66
    truth_s = (recording.truth.t_ns - recording.start_ns) * 1e-9
    fix_s = (recording.gnss.t_ns - recording.start_ns) * 1e-9
    inside = (fix_s > truth_s[0]) & (fix_s < truth_s[-1])
    for axis in range(2):
        there = np.interp(fix_s[inside], truth_s, recording.truth.position_m[:, axis])
        assert np.abs(recording.gnss.enu_m[inside, axis] - there).max() < 4.0
    path_m = np.linalg.norm(np.diff(recording.truth.position_m[:, :2], axis=0), axis=1).sum()
    assert path_m == pytest.approx(1011.0, abs=3.0)
    assert open_recording("comma2k19/segment_40").licence == "MIT"
