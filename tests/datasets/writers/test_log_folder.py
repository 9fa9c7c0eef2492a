"""The log folder: round trip to the bit, and every bad input told in one line."""

from __future__ import annotations

import dataclasses
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrafusion.datasets.core.channels import Command, Fix, Gnss, Imu, Terrain, Wheels
from terrafusion.datasets.core.differences import differences
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers import delimited, open_recording
from terrafusion.datasets.writers import log_folder, write_log_folder, write_mcap

META = "start_ns: 1700000000123456789\nvehicle: husky\n"


def folder_with(tmp_path: Path, meta: str = META, **files: str) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "meta.yaml").write_text(meta)
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


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


def test_packed_files_read_the_same(drive: Recording, tmp_path: Path) -> None:
    folder = write_log_folder(drive, tmp_path / "drive")
    for path in list(folder.glob("*.csv")):
        (folder / f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    assert differences(drive, open_recording(folder)) == []


def test_times_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    texts = ["-0.000000001", "0", "1234.123456789", "999999.999999999", "123456789.123456789"]
    rows = "".join(f"{text},0.5\n" for text in texts)
    back = open_recording(folder_with(tmp_path, meta="start_ns: 5\n", imu=f"t_s,gyro_z_radps\n{rows}")).imu
    assert back is not None
    wanted = [4, 5, 1234123456794, 1000000000000004, 123456789123456794]
    assert back.t_ns.tolist() == wanted
    assert back.has_gyro() is False
    assert np.isnan(back.accel_mps2).all()


def test_missing_cells_are_nan_and_empty_rows_are_left_out(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, wheels="t_s,left_mps,right_mps\n0,1,2\n0.1,,2.5\n0.2,,\n0.3,3,4\n")
    recording = open_recording(folder)
    assert recording.wheels is not None
    np.testing.assert_array_equal(recording.wheels.speed, [[1, 2], [np.nan, 2.5], [3, 4]])
    assert any("1 of 4 rows" in note for note in recording.notes)


def test_sides_that_are_sampled_in_turn_are_interpolated(tmp_path: Path) -> None:
    """Empty cells in turn are no missing values: the robot drives 1 m/s on the left, 2 m/s on the right."""
    rows = "".join(f"{0.1 * k:.1f},{'1,' if k % 2 else ',2'}\n" for k in range(40))
    recording = open_recording(folder_with(tmp_path, wheels=f"t_s,left_mps,right_mps\n{rows}"))
    wheels = recording.wheels
    assert wheels is not None
    assert len(wheels) >= 19
    np.testing.assert_allclose(wheels.speed, np.tile([1.0, 2.0], (len(wheels), 1)))
    assert any("sampled at different times" in note for note in recording.notes)


def test_gnss_without_fix_or_height(tmp_path: Path) -> None:
    recording = open_recording(
        folder_with(tmp_path, gnss="t_s,east_m,north_m,sigma_e_m,sigma_n_m\n0,1,2,0.5,0.5\n")
    )
    gnss = recording.gnss
    assert gnss is not None
    assert gnss.fix.tolist() == [Fix.SINGLE]
    assert np.isnan(gnss.enu_m[0, 2])
    assert any("no fix class" in note for note in recording.notes)


def test_fix_words(tmp_path: Path) -> None:
    rows = "".join(
        f"{i},1,2,1,1,{word}\n" for i, word in enumerate(["none", "single", "dgps", "float", "fixed", ""])
    )
    recording = open_recording(
        folder_with(tmp_path, gnss=f"t_s,east_m,north_m,sigma_e_m,sigma_n_m,fix\n{rows}")
    )
    assert recording.gnss is not None
    assert recording.gnss.fix.tolist() == [0, 1, 2, 3, 4, 1]


def test_planar_truth(tmp_path: Path) -> None:
    truth = "t_s,x_m,y_m,u_mps,v_mps,r_radps\n0,1,2,0.5,0,0.1\n1,1.5,2,0.5,0,\n"
    recording = open_recording(folder_with(tmp_path, META + "truth_frame: antenna\n", truth=truth))
    assert recording.truth is not None
    assert recording.truth.quaternion is None
    assert recording.truth.twist_body is not None
    np.testing.assert_array_equal(recording.truth.twist_body[0, [0, 1, 5]], [0.5, 0.0, 0.1])
    assert np.isnan(recording.truth.position_m[:, 2]).all()
    assert recording.truth_channels == ("position", "velocity")
    assert recording.truth_frame == "antenna"


def test_misspelt_channel_file_is_noted(tmp_path: Path) -> None:
    imu = "t_s,gyro_z_radps\n0,0.1\n"
    recording = open_recording(folder_with(tmp_path, imu=imu, wheel="t_s,left_mps,right_mps\n0,1,1\n"))
    assert any("wheel.csv" in note and "wheels.csv" in note for note in recording.notes)


def test_unknown_keys_of_meta_are_kept_and_named_in_one_warning(tmp_path: Path) -> None:
    meta = META + "operator: A. Smith\nweather: {sky: grey, rain: .nan}\nwheel_radus: 0.2\n"
    recording = open_recording(folder_with(tmp_path, meta, imu="t_s,gyro_z_radps\n0,0.1\n"))
    warnings = [note for note in recording.notes if "operator" in note]
    assert len(warnings) == 1
    assert warnings[0].startswith("warning: meta.yaml")
    assert "weather, wheel_radus (did you mean wheel_radius_m?)" in warnings[0]
    kept = {"operator": "A. Smith", "weather": {"sky": "grey", "rain": None}, "wheel_radus": 0.2}
    assert recording.metadata == kept
    again = open_recording(write_log_folder(recording, tmp_path / "again"))
    assert again.metadata == kept
    assert again.notes == recording.notes
    write_mcap(recording, tmp_path / "log.mcap")
    assert open_recording(tmp_path / "log.mcap").metadata == kept


TRUTH = """t_s,x_m,y_m,z_m,qx,qy,qz,qw,u_mps,v_mps,r_radps
0,1,2,0,0.1,0,0.7,0.7071,1,0,0
1,2,2,0,0,0.1,0,0.995,1,0,0
"""


@pytest.mark.parametrize("listed", [("position",), ("position", "yaw"), ("yaw",), ("velocity",)])
def test_the_truth_is_without_what_truth_channels_does_not_list(
    tmp_path: Path, listed: tuple[str, ...]
) -> None:
    meta = META + f"truth_channels: [{', '.join(listed)}]\n"
    truth = open_recording(folder_with(tmp_path, meta, truth=TRUTH)).truth
    (tmp_path / "whole").mkdir()
    whole = open_recording(folder_with(tmp_path / "whole", truth=TRUTH)).truth
    assert truth is not None
    assert whole is not None
    assert np.isfinite(truth.position_m).all() == ("position" in listed)
    assert (truth.twist_body is not None) == ("velocity" in listed)
    if "yaw" in listed:
        assert truth.quaternion is not None
        np.testing.assert_allclose(truth.yaw_rad(), whole.yaw_rad(), atol=1e-12)
        assert not truth.quaternion[:, :2].any()
    else:
        assert truth.quaternion is None


BAD_META = {
    "start_nss: 1\n": ["start_nss", "did you mean"],
    "vehicle: husky\n": ["start_ns", "missing"],
    "start_ns: 1.5\n": ["start_ns", "1.5"],
    "start_ns: true\n": ["start_ns"],
    "start_ns: -1\n": ["start_ns", "-1"],
    "start_ns: 1\nwheel_radius_mm: 165\n": ["wheel_radius_mm", "wheel_radius_m"],
    "start_ns: 1\nwheel_radius_m: 165\n": ["wheel_radius_m", "165", "[0.01, 2]"],
    "start_ns: 1\ntrack_m: wide\n": ["track_m", "wide"],
    "start_ns: 1\nantenna_m: [1, 2]\n": ["antenna_m", "3 numbers"],
    "start_ns: 1\ndatum: [91, 0, 0]\n": ["latitude", "91"],
    "start_ns: 1\ndatum: [1, 181, 0]\n": ["longitude", "181"],
    "start_ns: 1\ndatum: here\n": ["datum", "here"],
    "start_ns: 1\ntruth_frame: wheel\n": ["truth_frame", "wheel"],
    "start_ns: 1\ntruth_channels: position\n": ["truth_channels"],
    "start_ns: 1\nvehicle: 5\n": ["vehicle", "5"],
    "start_ns: 1\nnotes: dusty\n": ["notes", "dusty"],
    "start_ns: 1\nkeep_empty: 1\n": ["keep_empty", "true"],
    "start_ns: 1\nclock_jumps: 3\n": ["clock_jumps", "step_s"],
    "start_ns: 1\nclock_jumps: [{channel: imu, t_ns: 1.5, step_s: 2}]\n": ["clock_jumps", "t_ns"],
    "start_ns: 1\nclock_jumps: [{channel: imu, t_ns: 1, step_s: .inf}]\n": ["clock_jumps", "step_s"],
    "start_ns: 1\nstart_ns: 2\n": ["start_ns"],
    "start_ns: [1\n": ["YAML"],
    "- 1\n": ["mapping"],
}


@pytest.mark.parametrize("meta", BAD_META)
def test_bad_meta(tmp_path: Path, meta: str) -> None:
    folder = folder_with(tmp_path, meta, imu="t_s,gyro_z_radps\n0,0\n")
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder)
    one_line(caught.value, "meta.yaml", *BAD_META[meta])


GNSS = "t_s,east_m,north_m,sigma_e_m,sigma_n_m"
BAD_TABLES = {
    "nan text": (
        "imu",
        "t_s,gyro_z_radps\n0,0.1\n0.5,nan\n",
        ["gyro_z_radps", "'nan'", "line 3", "t = 0.500 s"],
    ),
    "inf text": ("imu", "t_s,gyro_z_radps\n0,inf\n", ["gyro_z_radps", "'inf'", "line 2"]),
    "word": ("imu", "t_s,gyro_z_radps\n0,0.1\n0.5,fast\n", ["gyro_z_radps", "'fast'", "line 3"]),
    "NA": ("imu", "t_s,gyro_z_radps\n0,NA\n", ["'NA'"]),
    "underscore": ("imu", "t_s,gyro_z_radps\n0,1_0\n", ["'1_0'"]),
    "decimal comma": ("imu", "t_s,gyro_z_radps\n0,0,1\n0,1,1\n", ["line 2", "3 cells for 2 columns"]),
    "short line": (
        "imu",
        "t_s,gyro_x_radps,gyro_z_radps\n0,1,1\n0.1,1\n",
        ["line 3", "2 cells for 3 columns"],
    ),
    "no time": ("imu", "t_s,gyro_z_radps\n0,0\n,0\n", ["line 3", "t_s"]),
    "nan time": ("imu", "t_s,gyro_z_radps\n0,0\nnan,0\n", ["line 3", "t_s", "'nan'"]),
    "backwards": ("imu", "t_s,gyro_z_radps\n0,0\n2,0\n1.5,0\n", ["backwards", "t = 2.000 s", "sort"]),
    "unix time": ("imu", "t_s,gyro_z_radps\n1700000000.5,0\n", ["Unix time", "start_ns"]),
    "no t_s": ("imu", "time,gyro_z_radps\n0,0\n", ["'time'", "t_s"]),
    "unknown column": ("imu", "t_s,gyro_z_rad\n0,0\n", ["'gyro_z_rad'", "did you mean 'gyro_z_radps'"]),
    "wrong unit": ("imu", "t_s,gyro_z_dps\n0,0\n", ["'gyro_z_dps'", "allowed"]),
    "twice": ("imu", "t_s,gyro_z_radps,gyro_z_radps\n0,0,0\n", ["twice"]),
    "only time": ("imu", "t_s\n0\n", ["no column"]),
    "empty": ("imu", "", ["empty"]),
    "zero bytes": ("imu", "t_s,gyro_z_radps\n0,\0\n", ["zero bytes"]),
    "no layout": ("wheels", "t_s,left_radps\n0,1\n", ["left_radps", "layout", "front_left_radps"]),
    "two layouts": ("wheels", "t_s,left_radps,right_radps,speed_mps\n0,1,1,1\n", ["layout"]),
    "mixed units": ("wheels", "t_s,left_radps,right_mps\n0,1,1\n", ["layout"]),
    "one angle": ("wheels", "t_s,left_radps,right_radps,left_rad\n0,1,1,1\n", ["right_rad"]),
    "stray angle": ("wheels", "t_s,speed_mps,left_rad\n0,1,1\n", ["left_rad"]),
    "no sigma": ("gnss", "t_s,east_m,north_m\n0,1,1\n", ["sigma_e_m", "missing"]),
    "height alone": ("gnss", f"{GNSS},up_m\n0,1,1,1,1,1\n", ["sigma_u_m"]),
    "half velocity": ("gnss", f"{GNSS},v_e_mps\n0,1,1,1,1,1\n", ["v_n_mps"]),
    "fix word": ("gnss", f"{GNSS},fix\n0,1,1,1,1,rtk\n", ["'rtk'", "fixed"]),
    "lone voltage": ("motor", "t_s,left_a,right_a,left_v\n0,1,1,1\n", ["left_v"]),
    "no label": ("terrain", "t_s,p_mud\n0,1\n", ["label"]),
    "bad quaternion": ("truth", "t_s,x_m,y_m,qx,qy,qz,qw\n0,1,1,0,0,0,0\n", ["norm", "unit"]),
    "half quaternion": ("truth", "t_s,x_m,y_m,qz,qw\n0,1,1,0,1\n", ["qz"]),
    "covariance in part": ("truth", "t_s,x_m,y_m,cov_x_x\n0,1,1,1\n", ["cov_x_y", "missing"]),
    "repeated truth": ("truth", "t_s,x_m,y_m\n0,1,1\n0,1,1\n", ["increase"]),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_bad_table(tmp_path: Path, case: str) -> None:
    channel, text, words = BAD_TABLES[case]
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder_with(tmp_path, **{channel: text}))
    one_line(caught.value, f"{channel}.csv", *words)


def one_line(error: TerrafusionError, *words: str) -> None:
    message = str(error)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def test_folder_without_meta(tmp_path: Path) -> None:
    with pytest.raises(TerrafusionError) as caught:
        open_recording(tmp_path)
    one_line(caught.value, str(tmp_path), "meta.yaml")


def test_folder_without_channels(tmp_path: Path) -> None:
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder_with(tmp_path, imu="t_s,gyro_z_radps\n"))
    one_line(caught.value, "log", "no channel")


def test_both_packed_and_plain(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, imu="t_s,gyro_z_radps\n0,0\n")
    (folder / "imu.csv.gz").write_bytes(gzip.compress(b"t_s,gyro_z_radps\n0,0\n", mtime=0))
    with pytest.raises(TerrafusionError, match="both"):
        open_recording(folder)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,east_m,north_m,sigma_e_m,sigma_n_m,fix\n0,1,1,1,1,single\n1,1,1,1,1\n", ("line 3", "5 cells")),
        ("t_s,east_m,north_m,sigma_e_m,sigma_n_m\n0,True,1,1,1\n", ("east_m", "True")),
        ("t_s,east_m,north_m,sigma_e_m,sigma_n_m\n0, ,1,1,1\n", ("east_m", "line 2")),
    ],
    ids=["a short last line of text", "a truth value", "a blank cell"],
)
def test_no_cell_is_made_up(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder_with(tmp_path, gnss=text))
    one_line(caught.value, "gnss.csv", *words)


def test_a_line_of_blanks_late_in_a_log(tmp_path: Path) -> None:
    r = open_recording(
        folder_with(tmp_path, command="t_s,v_mps,yaw_rate_radps\n1000001,1,1\n   \n1000002,1,1\n")
    )
    assert r.command is not None
    assert len(r.command) == 2


def test_a_packed_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few kilobytes of gzip can stand for gigabytes."""
    monkeypatch.setattr(delimited, "MAX_BYTES", 2**20)
    folder = folder_with(tmp_path)
    (folder / "imu.csv.gz").write_bytes(gzip.compress(b"t_s,gyro_z_radps\n" + b"0,0\n" * 10**6))
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder)
    one_line(caught.value, "imu.csv.gz", "more than 1 MB", "split")


@pytest.mark.parametrize(
    "content", [b"not gzip", gzip.compress(b"t_s,gyro_z_radps\n0,0\n" * 50, mtime=0)[:-20]]
)
def test_broken_gzip(tmp_path: Path, content: bytes) -> None:
    folder = folder_with(tmp_path)
    (folder / "imu.csv.gz").write_bytes(content)
    with pytest.raises(TerrafusionError) as caught:
        open_recording(folder)
    one_line(caught.value, "imu.csv.gz", "cannot be read")


def test_not_utf8(tmp_path: Path) -> None:
    folder = folder_with(tmp_path)
    (folder / "imu.csv").write_bytes(b"t_s,gyro_z_radps\n0,\xff\n")
    with pytest.raises(TerrafusionError, match=r"imu\.csv: not UTF-8"):
        open_recording(folder)


def test_byte_order_mark_and_windows_line_ends(tmp_path: Path) -> None:
    folder = folder_with(tmp_path)
    (folder / "imu.csv").write_bytes(b"\xef\xbb\xbft_s,gyro_z_radps\r\n0,0.25\r\n1,\r\n2,0.5\r\n")
    imu = open_recording(folder).imu
    assert imu is not None
    assert imu.gyro_radps[:, 2].tolist() == [0.25, 0.5]


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
    "far": ({"imu": Imu(np.array([2 * 10**18]), np.ones((1, 3)), np.ones((1, 3)))}, "start_ns"),
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
    one_line(caught.value, words, str(tmp_path / "x"))
    assert list(tmp_path.iterdir()) == []
