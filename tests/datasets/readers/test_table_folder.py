"""A folder of tables is one recording: each channel as its table alone gives it, contradictions told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import files_of, open_recording
from tests.conftest import Terrafusion

MAPS = {
    "imu.csv": "time: {column: t}\nchannels: {imu: {gyro_z_radps: wz}}\n",
    "odo.csv": "track_m: 0.5\ntime: {column: t}\nchannels: {wheels: {left_mps: l, right_mps: r}}\n",
    "gps.csv": "time: {column: t}\nchannels: {gnss: {latitude_deg: lat, longitude_deg: lon}}\n",
}
TABLES = {
    "imu.csv": "t,wz\n1700000000.0,0.1\n1700000000.5,0.2\n1700000001.0,0.3\n",
    "odo.csv": "t,l,r\n1700000000.2,1,2\n1700000000.7,3,4\n",
    "gps.csv": "t,lat,lon\n1700000000.1,48.1,11.5\n1700000000.9,48.1,11.50001\n",
}


def folder(path: Path, maps: dict[str, str] = MAPS, tables: dict[str, str] = TABLES) -> Path:
    log = path / "drive"
    log.mkdir()
    for name, text in tables.items():
        (log / name).write_text(text)
    for name, text in maps.items():
        (log / f"{name}.columns.yaml").write_text(text)
    return log


def test_each_channel_is_that_of_its_table(tmp_path: Path) -> None:
    log = folder(tmp_path)
    found = open_recording(log)
    assert (found.name, found.overrides.track_m) == ("drive", 0.5)
    assert found.start_ns == 1_700_000_000_000_000_000
    assert found.datum is not None
    for file, channel in (("imu.csv", "imu"), ("odo.csv", "wheels"), ("gps.csv", "gnss")):
        alone, own = getattr(open_recording(log / file), channel), getattr(found, channel)
        np.testing.assert_array_equal(own.t_ns, alone.t_ns)
        for name, values in own.columns().items():
            np.testing.assert_array_equal(values, alone.columns()[name])
    assert {path.name for path in files_of(log)} == {*TABLES, *(f"{name}.columns.yaml" for name in MAPS)}


def test_a_trajectory_joins_and_other_files_are_noted(tmp_path: Path) -> None:
    log = folder(tmp_path, {name: MAPS[name] for name in ("imu.csv", "odo.csv")})
    (log / "truth.txt").write_text("1700000000.0 0 0 0 0 0 0 1\n1700000001.0 1 0 0 0 0 0.1 0.995\n")
    (log / "README.md").write_text("A drive.\n")
    found = open_recording(log)
    assert found.truth is not None
    assert found.gnss is None
    left_out = [note for note in found.notes if "was not read" in note]
    assert [note.split()[0] for note in left_out] == ["README.md", "gps.csv"]
    assert "no column map" in left_out[1]


@pytest.mark.parametrize(
    ("file", "text", "columns", "words"),
    [
        ("imu2.csv", TABLES["imu.csv"], MAPS["imu.csv"], ("imu", "imu.csv and imu2.csv both have it")),
        ("a.csv", "t,c\n5.0,1\n",
         "time: {column: t, epoch: none}\nchannels: {motor: {left_a: c, right_a: c}}\n",
         ("share no clock", "1970-01-01", "2023-11-14", "epoch")),
        ("a.csv", "t,c\n1700000000.0,1\n",
         "track_m: 0.6\ntime: {column: t}\nchannels: {motor: {left_a: c, right_a: c}}\n",
         ("track_m", "a.csv says 0.6, odo.csv 0.5")),
        ("a.csv", "t,c\n1700000000.0,x\n", MAPS["imu.csv"].replace("wz", "c"), ("a.csv", "'x'")),
    ],
)  # fmt: skip
def test_contradictions_are_refused(
    tmp_path: Path, file: str, text: str, columns: str, words: tuple[str, ...]
) -> None:
    log = folder(tmp_path, {**MAPS, file: columns}, {**TABLES, file: text})
    with pytest.raises(DataError) as refused:
        open_recording(log)
    for word in words:
        assert word in str(refused.value)


def test_without_maps_the_folder_says_how(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="column map beside each table"):
        open_recording(folder(tmp_path, {}))


def test_a_replay_of_a_folder_of_tables(tmp_path: Path, terrafusion: Terrafusion) -> None:
    t_s = np.arange(0.0, 12.0, 0.1)
    driven = np.where(t_s < 2.0, 0.0, t_s - 2.0)
    rows = {
        "imu.csv": "t,wz\n" + "".join(f"{t:.1f},0.0\n" for t in t_s),
        "odo.csv": "t,l,r\n"
        + "".join(f"{t:.1f},{float(d > 0)},{float(d > 0)}\n" for t, d in zip(t_s, driven, strict=True)),
        "gps.csv": "t,lat,lon\n"
        + "".join(f"{t:.1f},48.1,{11.5 + d / 74_500.0:.9f}\n" for t, d in zip(t_s, driven, strict=True)),
    }
    log = folder(
        tmp_path, {n: m.replace("column: t", "column: t, epoch: none") for n, m in MAPS.items()}, rows
    )
    assert terrafusion("replay", log, "--mode", "fixed", "--out", tmp_path / "out").status == 0
    assert (tmp_path / "out" / "metrics.json").is_file()


def test_parts_of_one_drive_are_to_be_appended(tmp_path: Path) -> None:
    (log := tmp_path / "drive").mkdir()
    for k in range(3):
        (log / f"run_{k:02d}.csv").write_text(f"t,wz\n{k}.0,0.1\n{k}.5,0.2\n")
    advice = r"if they are parts of one drive, append them: `cat run_\*.csv > drive.csv`"
    with pytest.raises(DataError, match=f"give one of its logs itself: run_00.csv, .*; {advice}"):
        open_recording(log)
    for k in range(3):
        (log / f"run_{k:02d}.csv.columns.yaml").write_text(
            "{time: {column: t, epoch: none}, channels: {imu: {gyro_z_radps: wz}}}"
        )
    with pytest.raises(DataError, match=f"run_00.csv and run_01.csv both have it; .*; {advice}"):
        open_recording(log)
    whole = "".join((log / f"run_{k:02d}.csv").read_text() for k in range(3))
    (tmp_path / "drive.csv").write_text(whole)
    (log / "run_00.csv.columns.yaml").rename(tmp_path / "drive.csv.columns.yaml")
    imu = open_recording(tmp_path / "drive.csv").imu
    assert imu is not None
    assert imu.t_ns.tolist() == [k * 500_000_000 for k in range(6)]
