"""TUM trajectories as recordings: round trip, what they cannot tell, and bad ones."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.formats import Request
from terrafusion.datasets.readers.text import tum
from terrafusion.datasets.writers.tum import write_tum

POSE = "1.0 2.0 3.0 0 0 0.6 0.8"


def poses(tmp_path: Path, text: str, name: str = "ground_truth.txt") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def truth_of(path: Path) -> Trajectory:
    """The trajectory, whatever the file's name and first lines look like."""
    truth = tum.read(Request(path))[0].truth
    assert truth is not None
    return truth


def test_round_trip(drive: Recording, tmp_path: Path) -> None:
    assert drive.truth is not None
    write_tum(drive.truth, tmp_path / "truth.tum")
    recording = open_recording(tmp_path / "truth.tum")
    truth = recording.truth
    assert truth is not None
    assert truth.quaternion is not None
    np.testing.assert_array_equal(truth.t_ns, drive.truth.t_ns)
    np.testing.assert_allclose(truth.position_m, drive.truth.position_m, atol=1e-9)
    np.testing.assert_allclose(truth.quaternion, drive.truth.quaternion, atol=1e-9)
    assert recording.truth_channels == ("position", "yaw")
    assert recording.channels() == {}
    assert any("neither body nor world frame" in note for note in recording.notes)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(-(10**17), 9 * 10**18), min_size=1, max_size=20, unique=True).map(sorted))
def test_times_are_exact_to_the_nanosecond(tmp_path: Path, times: list[int]) -> None:
    text = "".join(f"{'-' if t < 0 else ''}{abs(t) // 10**9}.{abs(t) % 10**9:09d} {POSE}\n" for t in times)
    assert truth_of(poses(tmp_path, text)).t_ns.tolist() == times


def test_comments_commas_and_exponents(tmp_path: Path) -> None:
    path = poses(tmp_path, f"# t x y z qx qy qz qw\n1.5e0 {POSE}\n\n# more\n2.5 {POSE}\n")
    assert open_recording(path).start_ns == 1_500_000_000
    back = truth_of(poses(tmp_path, f"1,{','.join(POSE.split())}\n"))
    np.testing.assert_array_equal(back.position_m, [[1, 2, 3]])


def test_identity_throughout_is_no_orientation(tmp_path: Path) -> None:
    recording = open_recording(poses(tmp_path, "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n"))
    assert recording.truth is not None
    assert recording.truth.quaternion is None
    assert recording.truth_channels == ("position",)


def test_repeated_times_are_left_out(tmp_path: Path) -> None:
    recording = open_recording(poses(tmp_path, f"0 {POSE}\n1 {POSE}\n1 {POSE}\n2 {POSE}\n"))
    assert recording.truth is not None
    assert len(recording.truth) == 3
    assert any("1 poses with a repeated time" in note for note in recording.notes)


def test_backward_times(tmp_path: Path) -> None:
    t = 0.1 * np.arange(200) - 3.0 * (np.arange(200) >= 100)
    path = poses(tmp_path, "".join(f"{x:.3f} {POSE}\n" for x in t))
    with pytest.raises(DataError, match=r"backwards by 2\.9"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert recording.truth is not None
    assert set(np.diff(recording.truth.t_ns).tolist()) == {100_000_000}
    assert [jump.step_s for jump in recording.clock_jumps] == [-3.0]


BAD = {
    "no poses": ("# nothing\n", "holds no rows"),
    "text": (f"0 {POSE}\n1 1 2 three 0 0 0 1\n", "column 'z' is 'three' at line 2"),
    "NaN": (f"0 {POSE}\n1 1 2 nan 0 0 0 1\n", "column 'z' is 'nan' at line 2"),
    "infinite": (f"0 {POSE}\n1 1 2 inf 0 0 0 1\n", "column 'z' is 'inf' at line 2"),
    "short": (f"0 {POSE}\n1 1 2\n2 {POSE}\n", "line 2 has 3 cells for 8 columns"),
    "long": (f"0 {POSE}\n1 {POSE} 7\n", "line 2 has 9 cells for 8 columns"),
    "a time beyond 64 bits": (f"0 {POSE}\n1e300 {POSE}\n", "column 't' is '1e300' at line 2"),
    "a time that would take forever": (f"0 {POSE}\n1e999999999 {POSE}\n", "1e999999999"),
    "no time": (f"0 {POSE}\nnan {POSE}\n", "column 't' is 'nan'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_told_in_one_line(tmp_path: Path, case: str) -> None:
    text, match = BAD[case]
    with pytest.raises(DataError, match=match):
        truth_of(poses(tmp_path, text))


def test_quaternions_that_are_none(tmp_path: Path) -> None:
    text = "".join(f"{k} {POSE}\n" for k in range(100)) + "100 0 0 0 0 0 0 0\n"
    with pytest.raises(DataError, match="line 101: the quaternion has norm 0"):
        open_recording(poses(tmp_path, text))


def test_the_ending_alone_is_enough(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="column 'x' is 'nan' at line 1"):
        open_recording(poses(tmp_path, f"0 nan {POSE[4:]}\n", "drive.tum"))


def test_a_cut_last_line_is_left_out(tmp_path: Path) -> None:
    recording = open_recording(poses(tmp_path, f"0 {POSE}\n1 {POSE}\n2 1.0 2"))
    assert recording.truth is not None
    assert len(recording.truth) == 2
    assert any("cut off" in note for note in recording.notes)


def test_random_bytes_and_one_long_line(tmp_path: Path) -> None:
    path = tmp_path / "noise.tum"
    for data in (random.Random(4).randbytes(100_000), b"1 " * 5_000_000):
        path.write_bytes(f"0 {POSE}\n1 {POSE}\n".encode() + data)
        with pytest.raises(DataError):
            open_recording(path)
