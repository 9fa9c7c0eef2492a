"""Writing a log folder: round trip to the bit, and what the writer refuses or leaves alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrafusion.datasets.core.channels import Command, Fix, Gnss, Imu, Terrain, Wheels
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import log_folder, write_log_folder
from tests.differences import differences


def test_round_trip_keeps_everything(drive: Recording, tmp_path: Path) -> None:
    assert differences(drive, open_recording(write_log_folder(drive, tmp_path / "drive"))) == []
    renamed = open_recording(write_log_folder(drive, tmp_path / "other"))
    assert renamed.name == "drive"
    (tmp_path / "other").rename(tmp_path / "third")
    assert differences(drive, open_recording(tmp_path / "third")) == []


TIMES = st.lists(st.integers(-(10**12), 3 * 10**17), min_size=1, max_size=20).map(sorted)
NUMBERS = st.floats(allow_nan=True, allow_infinity=False)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), times=TIMES)
def test_any_numbers_survive_to_the_bit(tmp_path: Path, data: st.DataObject, times: list[int]) -> None:
    n = len(times)
    values = data.draw(hnp.arrays(float, (n, 6), elements=NUMBERS))
    values[:, 0] = np.nan_to_num(values[:, 0])  # a row without any value is left out
    t_ns = 1_700_000_000_000_000_000 + np.array(times, dtype=np.int64)
    recording = Recording("any", 1_700_000_000_000_000_000, imu=Imu(t_ns, values[:, :3], values[:, 3:]))
    back = open_recording(write_log_folder(recording, tmp_path / "any")).imu
    assert back is not None
    np.testing.assert_array_equal(back.t_ns, t_ns)
    assert (
        np.hstack([back.gyro_radps, back.accel_mps2]).tobytes()
        == np.where(np.isnan(values), np.nan, values).tobytes()
    )


def test_writer_keeps_off_other_folders(drive: Recording, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(TerrafusionError, match="not empty"):
        write_log_folder(drive, tmp_path)
    with pytest.raises(TerrafusionError, match="is a file"):
        write_log_folder(drive, tmp_path / "thesis.tex")


def test_writer_replaces_an_older_log(drive: Recording, tmp_path: Path) -> None:
    write_log_folder(drive, tmp_path / "log")
    smaller = dataclasses.replace(drive, motor=None, truth=None)
    assert open_recording(write_log_folder(smaller, tmp_path / "log")).motor is None


def test_writing_here(drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "drive").mkdir()
    monkeypatch.chdir(tmp_path / "drive")
    assert differences(drive, open_recording(write_log_folder(drive, "."))) == []


def test_writer_refuses_wheels_without_columns(tmp_path: Path) -> None:
    t = np.arange(3, dtype=np.int64)
    wheels = Wheels(t, np.ones((3, 1)), Wheels.LAYOUTS[2], "radps")
    with pytest.raises(TerrafusionError, match="wheels"):
        write_log_folder(Recording("x", 0, wheels=wheels), tmp_path / "x")


def test_truth_with_unknown_height_and_antenna_frame(tmp_path: Path) -> None:
    t = np.array([0, 10**9], dtype=np.int64)
    truth = Trajectory(t, np.array([[0.0, 1.0, np.nan], [1.0, 1.0, np.nan]]))
    gnss = Gnss(t, np.zeros((2, 3)), np.ones((2, 3)), np.ones(2, dtype=np.uint8))
    recording = Recording("x", 0, gnss=gnss, truth=truth, truth_channels=("position",), truth_frame="antenna")
    back = open_recording(write_log_folder(recording, tmp_path / "x"))
    assert back.truth_frame == "antenna"
    assert back.truth_channels == ("position",)


def test_all_of_the_truth(tmp_path: Path) -> None:
    """A symmetric covariance takes 21 columns, another 36; both come back."""
    t = np.arange(4) * 10**9
    rng = np.random.default_rng(5)
    P = rng.normal(size=(4, 6, 6))
    twist = rng.normal(size=(4, 6))
    for name, covariance in (("symmetric", P + P.transpose(0, 2, 1)), ("other", P)):
        truth = Trajectory(t, rng.normal(size=(4, 3)), None, twist, covariance)
        folder = write_log_folder(Recording(name, 0, truth=truth), tmp_path / name)
        header = (folder / "truth.csv").read_text().splitlines()[0].split(",")
        assert sum(c.startswith("cov_") for c in header) == (21 if name == "symmetric" else 36)
        assert differences(open_recording(folder).truth, truth) == []


def test_rows_and_channels_without_values_are_kept_where_meta_says_so(tmp_path: Path) -> None:
    t = np.array([0, 10**9], dtype=np.int64)
    none = np.full((2, 3), np.nan)
    gnss = Gnss(t, none, none, np.array([Fix.NONE, Fix.SINGLE], dtype=np.uint8))
    imu = Imu(t[:0], none[:0], none[:0])
    recording = Recording("x", 0, imu=imu, gnss=gnss)
    folder = write_log_folder(recording, tmp_path / "x")
    assert differences(recording, open_recording(folder)) == []
    meta = folder / "meta.yaml"
    meta.write_text(meta.read_text().replace("keep_empty: true", "keep_empty: false"))
    with pytest.raises(TerrafusionError, match="no channel holds a sample"):
        open_recording(folder)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_writer_that_fails_leaves_what_was_there(
    drive: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    write_log_folder(drive, tmp_path / "old")
    (tmp_path / "old" / "diary.txt").write_text("kept")
    written: list[Path] = []
    write_table = log_folder._write_table

    def fail_at_the_third(path: Path, *rest: object) -> None:
        written.append(path)
        if len(written) % 3 == 0:
            raise error
        write_table(path, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(log_folder, "_write_table", fail_at_the_third)
    smaller = dataclasses.replace(drive, motor=None, name="old")
    for name in ("old", "new"):
        with pytest.raises((TerrafusionError, KeyboardInterrupt)):
            write_log_folder(smaller, tmp_path / name)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert differences(open_recording(tmp_path / "old"), drive) == []
    write_log_folder(smaller, tmp_path / "old")
    assert differences(open_recording(tmp_path / "old"), smaller) == []
    assert (tmp_path / "old" / "diary.txt").read_text() == "kept"
    assert not list((tmp_path / "old").glob(".*"))


UNWRITABLE = {
    "infinite": ({"imu": Imu(np.zeros(1, np.int64), np.full((1, 3), np.inf), np.ones((1, 3)))}, "infinite"),
    "far": ({"imu": Imu(np.array([2 * 10**18]), np.ones((1, 3)), np.ones((1, 3)))}, "onto one clock"),
    "zero byte": ({"terrain": Terrain(np.zeros(1, np.int64), np.array(["a\0b"], dtype=object))}, "zero byte"),
    "half a character": (
        {"terrain": Terrain(np.zeros(1, np.int64), np.array(["\ud800"], dtype=object))},
        "no character",
    ),
    "class of two lines": (
        {"terrain": Terrain(np.zeros(1, np.int64), np.array(["a"]), "x", ("a\nb",), np.ones((1, 1)))},
        "cannot be a column",
    ),
    "datum": ({"datum": (91.0, 0.0, 0.0)}, "latitude"),
    "start": ({"start_ns": -5}, "start_ns"),
    "notes": ({"notes": ("x" * 300_000,)}, "KiB"),
}


@pytest.mark.parametrize("case", UNWRITABLE)
def test_writer_refuses_what_could_not_be_read(tmp_path: Path, case: str) -> None:
    fields, words = UNWRITABLE[case]
    recording = Recording("x", 0, command=Command(np.zeros(1, np.int64), np.ones(1), np.ones(1)))
    with pytest.raises(TerrafusionError) as caught:
        write_log_folder(dataclasses.replace(recording, **fields), tmp_path / "x")
    message = str(caught.value)
    assert "\n" not in message
    assert words in message
    assert str(tmp_path / "x") in message
    assert list(tmp_path.iterdir()) == []
