"""Reading a log folder: every form its files may have, and every bad input told in one line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.channels import Fix, Wheels
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder, write_mcap
from terrafusion.twin.model.vehicle import load_vehicle
from tests.differences import differences

META = "start_ns: 1700000000123456789\nvehicle: husky\n"


def folder_with(tmp_path: Path, meta: str = META, **files: str) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "meta.yaml").write_text(meta)
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text)
    return folder


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


def test_a_channel_in_another_format_beside_the_csv_is_noted(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, imu="t_s,gyro_z_radps\n0,0.1\n")
    (folder / "imu.parquet").write_bytes(b"PAR1")
    (folder / "photo.parquet").write_bytes(b"PAR1")
    notes = [note for note in open_recording(folder).notes if "parquet" in note]
    assert notes == ["imu.parquet was not read: a log folder has imu.csv or imu.csv.gz"]


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
    "semicolons": ("imu", "t_s;gyro_z_radps\n0,0;0,1\n", ["separated by a semicolon", "commas"]),
    "tabs": ("imu", "t_s\tgyro_z_radps\n0\t1\n", ["separated by a tab", "commas"]),
    "decimal comma": ("imu", "t_s,gyro_z_radps\n0,0,1\n0,1,1\n", ["line 2", "3 cells for 2 columns"]),
    "short line": (
        "imu",
        "t_s,gyro_x_radps,gyro_z_radps\n0,1,1\n0.1,1\n",
        ["line 3", "2 cells for 3 columns"],
    ),
    "no time": ("imu", "t_s,gyro_z_radps\n0,0\n,0\n", ["line 3", "t_s"]),
    "nan time": ("imu", "t_s,gyro_z_radps\n0,0\nnan,0\n", ["line 3", "t_s", "'nan'"]),
    "backwards": (
        "imu",
        "t_s,gyro_z_radps\n0,0\n2,0\n1.5,0\n",
        ["line 4", "backwards by 0.5", "sort"],
    ),
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
    "one sigma": ("gnss", "t_s,east_m,north_m,sigma_n_m\n0,1,1,1\n", ["sigma_e_m", "missing", "or no sigma"]),
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
    monkeypatch.setattr(limits, "TEXT_BYTES", 2**20)
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


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("t_s,east_m,north_m,sigma_e_m,sigma_n_m,fix", "1,2,,,"),
        ("t_s,east_m,north_m,up_m,fix", "1,2,3,"),
    ],
)
def test_sigmas_that_are_missing_are_those_of_the_class(tmp_path: Path, header: str, row: str) -> None:
    """As in tables: an empty cell, or no column at all."""
    rows = f"0,{row}single\n1,{row}fixed\n"
    folder = folder_with(tmp_path, gnss=f"{header}\n{rows}")
    recording = open_recording(folder)
    assert recording.gnss is not None
    assert recording.gnss.sigma_enu_m[:, :2].tolist() == [[3.0, 3.0], [0.02, 0.02]]
    assert any("gnss: 2 fixes have no sigma; taken from their class" in note for note in recording.notes)
    own = open_recording(folder, rig=load_vehicle("husky").rig())
    assert own.gnss is not None
    assert own.gnss.sigma_enu_m[:, 0].tolist() == [3.0, 0.02]  # its stand-alone receiver made no RTK fix


def test_angles_that_start_again_after_each_turn_count_turns(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * k:.1f},9,9,{0.9 * k % (2 * np.pi)},{0.9 * k}\n" for k in range(100))
    recording = open_recording(
        folder_with(tmp_path, wheels=f"t_s,left_radps,right_radps,left_rad,right_rad\n{rows}")
    )
    assert recording.wheels is not None
    np.testing.assert_allclose(recording.wheels.angle_rad, np.arange(100)[:, None] * [0.9, 0.9], atol=1e-9)
    assert (
        "wheels: the angles of left start again after each turn; whole turns are counted" in recording.notes
    )


def test_wrapped_angles_of_a_recording_are_written_and_read_to_the_bit(tmp_path: Path) -> None:
    t_ns = np.arange(100) * 10**8
    angle = np.stack([0.9 * np.arange(100) % (2 * np.pi)] * 2, axis=1)
    wheels = Wheels(t_ns, np.full((100, 2), 9.0), ("left", "right"), "radps", angle)
    recording = Recording("wrapped", 0, wheels=wheels)
    assert differences(recording, open_recording(write_log_folder(recording, tmp_path / "wrapped"))) == []
    write_mcap(recording, tmp_path / "wrapped.mcap")
    assert differences(recording, open_recording(tmp_path / "wrapped.mcap")) == []


def test_angles_alone_give_the_speeds(tmp_path: Path) -> None:
    rows = "0,0,0\n0.1,0.5,1\n0.1,0.5,1\n0.2,,\n0.3,1.5,3\n"
    recording = open_recording(folder_with(tmp_path, wheels=f"t_s,left_rad,right_rad\n{rows}"))
    wheels = recording.wheels
    assert wheels is not None
    np.testing.assert_allclose(wheels.speed, [[5, 10], [5, 10]])
    assert wheels.angle_rad is not None
    assert wheels.angle_rad.tolist() == [[0.5, 1], [1.5, 3]]
    assert "wheels: no speeds are there; they are differences of the angles" in recording.notes
