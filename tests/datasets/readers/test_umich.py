"""The Michigan Husky's text files: how they go together, and what is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import files_of, open_recording
from terrafusion.datasets.readers.sets import umich_text
from tests.differences import differences

START_S = 1_652_300_000
FAMILY = ("trial4_wheel_imu.txt", "trial4_wheel_vel.txt", "trial4_loop_center.txt", "trial4_loop_front.txt")


def save(path: Path, t_s: np.ndarray, rows: np.ndarray) -> None:
    """Rows as the set has them: Unix seconds with ten decimals, then numbers."""
    lines = [
        f"{START_S + int(t)}.{round((t - int(t)) * 1e10):010d} {' '.join(f'{x:.17g}' for x in row)}\n"
        for t, row in zip(t_s.tolist(), rows.tolist(), strict=True)
    ]
    path.write_text("".join(lines))


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The four files of a straight drive of half a minute."""
    folder, rng = tmp_path_factory.mktemp("umich"), np.random.default_rng(4)
    t = np.arange(0.0, 30.0, 0.01)
    save(folder / FAMILY[0], t, rng.normal((0, 0, 0, 0, 0, 9.8), 0.02, (len(t), 6)))
    t = np.arange(0.1, 30.0, 0.1)
    save(folder / FAMILY[1], t, np.outer(rng.normal(0.5, 0.01, len(t)), (1, 0, 0)))
    t = np.arange(0.5, 29.5, 1.0 / 60.0)
    poses = np.zeros((len(t), 7))
    poses[:, 0], poses[:, 6] = 0.5 * (t - t[0]), 1.0
    for file in FAMILY[2:]:
        save(folder / file, t, poses)
    return folder


@pytest.mark.parametrize("file", FAMILY)
def test_any_file_opens_the_whole(trial: Path, file: str) -> None:
    whole, other = open_recording(trial / FAMILY[0]), open_recording(trial / file)
    assert set(whole.channels()) == {"imu", "wheels"}
    assert whole.name == "trial4"
    assert whole.truth_channels == ("position", "yaw")
    assert differences(dataclasses.replace(whole, notes=()), dataclasses.replace(other, notes=())) == []
    joined = next(note for note in other.notes if note.startswith("joined with"))
    assert all(name in joined for name in FAMILY)
    assert any(note.startswith("front: second rigid body") for note in other.notes)
    assert files_of(trial / file) == sorted(trial / name for name in FAMILY)


def test_numbers_are_those_of_the_files(trial: Path) -> None:
    recording = open_recording(trial / FAMILY[0])
    assert recording.imu is not None
    assert recording.wheels is not None
    assert recording.truth is not None
    table = np.loadtxt(trial / FAMILY[0])
    np.testing.assert_array_equal(
        np.hstack([recording.imu.gyro_radps, recording.imu.accel_mps2]), table[:, 1:]
    )
    assert recording.imu.t_ns[7] == START_S * 10**9 + 70_000_000
    assert (recording.wheels.names, recording.wheels.unit) == (("speed",), "mps")
    np.testing.assert_array_equal(recording.wheels.speed[:, 0], np.loadtxt(trial / FAMILY[1])[:, 1])
    np.testing.assert_array_equal(recording.truth.position_m, np.loadtxt(trial / FAMILY[2])[:, 1:4])


@pytest.mark.parametrize(
    ("file", "channels", "truth"),
    [(FAMILY[0], {"imu"}, ()), (FAMILY[1], {"wheels"}, ()), (FAMILY[2], set(), ("position", "yaw")),
     (FAMILY[3], set(), ("yaw",))],
)  # fmt: skip
def test_a_file_alone(
    trial: Path, tmp_path: Path, file: str, channels: set[str], truth: tuple[str, ...]
) -> None:
    (tmp_path / file).write_bytes((trial / file).read_bytes())
    recording = open_recording(tmp_path / file)
    assert set(recording.channels()) == channels
    assert recording.truth_channels == truth
    assert any("stands alone" in note for note in recording.notes)


def test_the_other_names_of_the_set(trial: Path, tmp_path: Path) -> None:
    for old, new in zip(
        FAMILY, ("04_test_imu.txt", "04_test_vel_input.txt", "trial4_cat_center.txt"), strict=False
    ):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    assert set(open_recording(tmp_path / "trial4_cat_center.txt").channels()) == {"imu", "wheels"}
    for old, new in zip(FAMILY, ("hill__wheel_imu.txt", "hill__wheel_vel_input.txt"), strict=False):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    for old, new in zip(FAMILY, ("wheel_imu.txt", "wheel_vel_input.txt"), strict=False):
        (tmp_path / new).write_bytes((trial / old).read_bytes())
    for file, name in (("hill__wheel_vel_input.txt", "hill"), ("wheel_imu.txt", tmp_path.name)):
        recording = open_recording(tmp_path / file)
        assert recording.name == name
        assert set(recording.channels()) == {"imu", "wheels"}
        assert recording.truth is None


def test_a_velocity_of_another_source_is_no_wheels(trial: Path, tmp_path: Path) -> None:
    """Beside some trials lies a body velocity made of the motion capture under the wheels' name."""
    (tmp_path / "4_test_imu.txt").write_bytes((trial / FAMILY[0]).read_bytes())
    lines = (trial / FAMILY[1]).read_text().splitlines(keepends=True)
    (tmp_path / "4_test_vel_input.txt").write_text("".join(put(9, 2, "0.01")(lines)))
    recording = open_recording(tmp_path / "4_test_imu.txt")
    assert set(recording.channels()) == {"imu"}
    assert any("4_test_vel_input.txt moves sideways" in note for note in recording.notes)
    with pytest.raises(DataError, match="line 10: wheels that move sideways"):
        open_recording(tmp_path / "4_test_vel_input.txt")
    assert not umich_text.claims(tmp_path / "4_inekf_wheel_vel.txt", b"1 2 3 4\n")


def test_files_of_another_time_are_not_joined(trial: Path, tmp_path: Path) -> None:
    for file in FAMILY[:2]:
        (tmp_path / file).write_bytes((trial / file).read_bytes())
    later = (trial / FAMILY[2]).read_text().replace("16523000", "16523009")
    (tmp_path / FAMILY[2]).write_text(later)
    recording = open_recording(tmp_path / FAMILY[0])
    assert recording.truth is None
    assert any(FAMILY[2] in note and "not joined" in note for note in recording.notes)


def test_an_open_choice_is_refused(trial: Path, tmp_path: Path) -> None:
    for file in (*FAMILY, "trial4_square_center.txt"):
        source = FAMILY[2] if "center" in file else file
        (tmp_path / file).write_bytes((trial / source).read_bytes())
    with pytest.raises(DataError, match=r"trial4_loop_center\.txt and trial4_square_center\.txt both"):
        open_recording(tmp_path / FAMILY[0])
    assert open_recording(tmp_path / FAMILY[2]).truth is not None


# --- what is odd, and what is refused


def changed(trial: Path, folder: Path, file: str, change: Callable[[list[str]], list[str]]) -> Path:
    """A copy of one file with its lines changed."""
    lines = (trial / file).read_text().splitlines(keepends=True)
    (folder / file).write_text("".join(change(lines)))
    return folder / file


def put(row: int, column: int, cell: str) -> Callable[[list[str]], list[str]]:
    """A change of one cell; rows count from 0."""

    def change(lines: list[str]) -> list[str]:
        cells = lines[row].split()
        cells[column] = cell
        return [*lines[:row], " ".join(cells) + "\n", *lines[row + 1 :]]

    return change


def columns(*order: int) -> Callable[[list[str]], list[str]]:
    """A change of all lines: these columns, in this order."""
    return lambda lines: [" ".join(line.split()[i] for i in order) + "\n" for line in lines]


BAD: dict[str, tuple[int, Callable[[list[str]], list[str]], tuple[str, ...]]] = {
    "short line": (0, lambda x: [*x[:6], "1652300000.06 1 2\n", *x[7:]], ("line 7 has 3", "t = 0.060 s")),
    "long line": (2, lambda x: [*x[:6], x[6].strip() + " 1\n", *x[7:]], ("line 7 has 9 cells for 8",)),
    "text": (0, put(9, 3, "fast"), ("'fast'", "line 10", "t = 0.090 s")),
    "NaN": (0, put(9, 3, "nan"), ("'nan'", "line 10", "t = 0.090 s")),
    "infinite": (2, put(9, 3, "inf"), ("'inf'", "line 10", "t = 0.150 s")),
    "time in words": (1, put(4, 0, "noon"), ("'noon'", "line 5")),
    "time of no year": (1, put(4, 0, "1e17"), ("'1e17'", "line 5")),
    "columns of another file": (0, columns(0, 1, 2, 3, 4, 5), ("6 cells for 7",)),
    "wheels aside": (1, put(11, 2, "0.25"), ("line 12", "sideways", "t = 1.100 s")),
    "vx and vy swapped": (1, columns(0, 2, 1, 3), ("sideways",)),
    "no quaternion": (2, put(20, 7, "0.5"), ("line 21", "quaternion", "t = 0.333 s")),
    "quaternion of huge numbers": (2, put(20, 7, "1e300"), ("line 21", "quaternion")),
    "time runs back": (2, lambda x: [*x[:9], x[7], *x[10:]], ("line 10", "runs backwards by 0.016667 s")),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(trial: Path, tmp_path: Path, name: str) -> None:
    which, change, words = BAD[name]
    path = changed(trial, tmp_path, FAMILY[which], change)
    with pytest.raises(DataError) as refused:
        open_recording(path)
    message = str(refused.value)
    assert "\n" not in message
    assert len(message) < 500
    for word in (path.name, *words):
        assert word in message, message


def test_other_text_is_not_claimed(tmp_path: Path) -> None:
    for content in (b"t,wx,wy\n1,2,3\n", b"all work\n", b"\n", b"\x00\x01\x02"):
        (tmp_path / "x_imu.txt").write_bytes(content)
        with pytest.raises(DataError):
            open_recording(tmp_path / "x_imu.txt")
    (tmp_path / "x_imu.txt").write_bytes(b"")
    with pytest.raises(DataError, match="empty"):
        open_recording(tmp_path / "x_imu.txt")
    assert not umich_text.claims(tmp_path / "x_imu.txt", b"t wx wy\n")
    (tmp_path / "notes.txt").write_text("1 2 3 4 5 6 7\n")
    assert not umich_text.claims(tmp_path / "notes.txt", b"1 2 3 4 5 6 7\n")


def test_a_file_of_too_many_lines_is_refused(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROWS", 2999)
    with pytest.raises(DataError, match=r"trial4_wheel_imu\.txt: has more than 2 999 lines"):
        open_recording(trial / FAMILY[0])


def test_a_huge_file_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("terrafusion.datasets.readers.delimited.bytearray", pytest.fail, raising=False)
    with (tmp_path / "x_imu.txt").open("wb") as file:
        file.write(b"1652300000.0 0 0 0 0 0 9.8\n")
        file.truncate(600 << 20)  # sparse: takes no room on the disk
    with pytest.raises(DataError, match="more than 512 MB"):
        open_recording(tmp_path / "x_imu.txt")


def test_a_cut_last_line_is_left_out_and_told(trial: Path, tmp_path: Path) -> None:
    path = changed(trial, tmp_path, FAMILY[0], lambda lines: [*lines[:50], lines[50][:40]])
    recording = open_recording(path)
    assert recording.imu is not None
    assert len(recording.imu) == 50
    assert any("cut off" in note for note in recording.notes)


def test_repeated_poses_are_dropped_and_told(trial: Path, tmp_path: Path) -> None:
    recording = open_recording(changed(trial, tmp_path, FAMILY[2], lambda x: [*x[:9], x[8], x[8], *x[9:]]))
    assert recording.truth is not None
    assert len(recording.truth) == len((trial / FAMILY[2]).read_text().splitlines())
    assert any("2 rows repeat a time" in note for note in recording.notes)


def test_lost_frames_are_told(trial: Path, tmp_path: Path) -> None:
    recording = open_recording(changed(trial, tmp_path, FAMILY[2], lambda x: [*x[:60], *x[120:]]))
    assert any("60 frames lost" in note and "longest 1.02 s" in note for note in recording.notes)


def test_a_step_of_the_clock_is_taken_out_if_asked_for(trial: Path, tmp_path: Path) -> None:
    def back(lines: list[str]) -> list[str]:
        cells = [line.split(maxsplit=1) for line in lines[2000:]]
        return [*lines[:2000], *(f"{float(t) - 5.0:.10f} {rest}" for t, rest in cells)]

    path = changed(trial, tmp_path, FAMILY[0], back)
    with pytest.raises(DataError, match="runs backwards"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert [(jump.channel, round(jump.step_s, 3)) for jump in recording.clock_jumps] == [("imu", -5.0)]


def test_the_front_checks_the_centre(trial: Path, tmp_path: Path) -> None:
    """A centre whose markers were mixed up disagrees with the front."""
    for file in FAMILY:
        (tmp_path / file).write_bytes((trial / file).read_bytes())
    assert not any("wrong" in note for note in open_recording(tmp_path / FAMILY[0]).notes)
    table = np.loadtxt(tmp_path / FAMILY[2])
    yaw = 2.0 * np.arctan2(table[:, 6], table[:, 7]) + np.radians(20.0) * (np.arange(len(table)) > 50)
    table[:, 6], table[:, 7] = np.sin(yaw / 2), np.cos(yaw / 2)
    save(tmp_path / FAMILY[2], table[:, 0] - START_S, table[:, 1:])
    assert any("one of the two is wrong" in note for note in open_recording(tmp_path / FAMILY[0]).notes)
