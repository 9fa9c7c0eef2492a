"""`inspect` and `convert` as a user runs them: output, exit status, one line for an error."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import formats, open_recording
from terrafusion.fusion.cli.inspect_page import _utc
from terrafusion.fusion.cli.main import app

FILES = {
    "meta.yaml": "start_ns: 1700000000000000000\nvehicle: nobody_knows\nterrain: gravel\ntrack_m: 0.5\n",
    "imu.csv": "t_s,gyro_z_radps\n" + "".join(f"{i / 50:.2f},{(i % 7 or -0.0) / 100}\n" for i in range(500)),
    "wheels.csv": "t_s,left_mps,right_mps\n"
    + "".join(f"{i / 10:.1f},{1 + i % 3 / 10},1\n" for i in range(100)),
    "gnss.csv": "t_s,east_m,north_m,sigma_e_m,sigma_n_m,fix\n"
    + "".join(f"{i},{i * 1.05},0,1,1,single\n" for i in range(10)),
    "terrain.csv": "t_s,label\n0,gravel\n5,mud\n",
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "my_log"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    """Exit status, output and error text, by the rules of the console script."""
    try:
        status = app([str(word) for word in words], standalone_mode=False) or 0
    except TerrafusionError as error:
        print(f"error: {error}", file=sys.stderr)
        status = 1
    except Exception as error:
        if not hasattr(error, "exit_code"):
            raise
        print(f"usage: {error}", file=sys.stderr)
        status = error.exit_code
    out, err = capsys.readouterr()
    return status, out, err


@pytest.mark.parametrize(
    "command",
    [("inspect", "LOG"), ("convert", "LOG", "OUT"), ("calibrate", "LOG", "--sensors", "--out", "OUT.yaml")],
)
def test_options_that_a_log_folder_has_no_use_for_are_warned_of(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    columns = tmp_path / "map.yaml"
    columns.write_text("time: t\n")
    words = [word.replace("LOG", str(log)).replace("OUT", str(tmp_path / "out")) for word in command]
    _, _, err = run(capsys, *words, "--topic", "imu=/imu", "--columns", columns)
    warned = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert warned == [
        f"warning: {log}: topics only matter for ROS bags; not used here",
        f"warning: {log}: columns only matter for plain tables and bags; not used here",
    ]
    _, _, err = run(capsys, *words)
    assert "warning" not in err


def test_inspect_page(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "inspect", log)
    assert (status, err) == (0, "")
    for word in (
        "my_log",
        "imu",
        "500",
        "50",
        "gyro_z_radps 0 to 0.06",
        "fix single 10",
        "label gravel 1, mud 1",
    ):
        assert word in out, out
    assert "no findings" in out


def test_inspect_json(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "inspect", log, "--json")
    page = json.loads(out)
    assert status == 0
    assert page["channels"]["imu"]["samples"] == 500
    assert page["channels"]["imu"]["rate_hz"] == pytest.approx(50.0)
    assert page["channels"]["wheels"]["ranges"]["left_mps"] == [1.0, 1.2]
    assert page["findings"] == []


def test_inspect_shows_a_gap(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (log / "imu.csv").read_text().splitlines(keepends=True)
    (log / "imu.csv").write_text("".join(lines[:100] + lines[200:]))
    _, out, _ = run(capsys, "inspect", log)
    row = next(line for line in out.splitlines() if line.startswith("imu "))
    assert row.split()[-2:] == ["1", "2"]  # gaps, and the longest in s
    assert "imu: 1 gap [gaps]" in out


def fill(path: Path, rows: dict[str, np.ndarray]) -> None:
    """A table of the log folder."""
    lines = (",".join(f"{value:.6f}" for value in row) for row in zip(*rows.values(), strict=True))
    path.write_text("\n".join([",".join(rows), *lines, ""]))


@pytest.fixture
def known_log(tmp_path: Path) -> Path:
    """A minute with turns whose measures are known: track 0.8 m, GNSS 4 % slower than the wheels,
    wheels 0.3 s late, gravity on +y, wheels held for four rows."""
    folder = tmp_path / "known"
    folder.mkdir()
    (folder / "meta.yaml").write_text("start_ns: 0\nlicence: MIT\nsource: a test\n")
    fine = np.arange(0.0, 60.0, 0.01)
    v = 0.96 * (1.0 + 0.3 * np.sin(0.5 * fine))
    rate = 0.3 * np.sin(fine) * (fine > 30.0)
    yaw = np.cumsum(rate) * 0.01
    east, north = np.cumsum(v * np.cos(yaw)) * 0.01, np.cumsum(v * np.sin(yaw)) * 0.01
    zero, t_w, t_g = 0.0 * fine, np.arange(0.0, 59.9, 0.05), np.arange(0.0, 59.0, 0.2)
    at_w = np.maximum(np.floor(t_w / 0.2) * 0.2 - 0.3, 0.0)
    speed, turn = np.interp(at_w, fine, v) / 0.96, np.interp(at_w, fine, rate)
    fill(folder / "imu.csv", {
        "t_s": fine, "gyro_x_radps": zero, "gyro_y_radps": zero, "gyro_z_radps": rate,
        "accel_x_mps2": zero, "accel_y_mps2": zero + 9.81, "accel_z_mps2": zero,
    })  # fmt: skip
    fill(folder / "wheels.csv", {"t_s": t_w, "left_mps": speed - 0.4 * turn, "right_mps": speed + 0.4 * turn})
    sigma = 0.02 + 0.0 * t_g
    fill(folder / "gnss.csv", {
        "t_s": t_g, "east_m": np.interp(t_g, fine, east), "north_m": np.interp(t_g, fine, north),
        "sigma_e_m": sigma, "sigma_n_m": sigma,
    })  # fmt: skip
    return folder


def test_inspect_measures(known_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "inspect", known_log, "--json")
    assert status == 1, "gravity along +y is an error"
    page = json.loads(out)
    measured = page["measured"]
    assert (page["licence"], page["source"], page["recordings"]) == ("MIT", "a test", 1)
    assert measured["gravity"]["axis"] == "+y"
    assert measured["gravity"]["size_mps2"] == pytest.approx(9.81)
    assert measured["yaw"]["r"] > 0.9
    assert measured["yaw"]["effective_track_m"] == pytest.approx(0.8, rel=0.1)
    assert measured["speed_ratio"]["gnss"]["ratio"] == pytest.approx(0.96, rel=0.01)
    late = next(lag for lag in measured["lags"] if lag["quantity"] == "yaw rate")
    assert (late["later"], late["earlier"]) == ("wheels", "imu")
    assert late["low_s"] < 0.3 < late["high_s"]
    assert late["seconds"] == pytest.approx(0.3, abs=0.03)
    assert measured["path_m"]["wheels"] == pytest.approx(60.0, rel=0.02)
    assert measured["path_m"]["gnss"] == pytest.approx(0.96 * 59.0, rel=0.02)
    assert measured["held"]["wheels"]["update_hz"] == pytest.approx(5.0, rel=0.05)
    assert measured["sigma_m"] == {"min": 0.02, "median": 0.02, "max": 0.02}


def test_page_shows_the_same_and_fits(known_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, "inspect", known_log)
    assert max(len(line) for line in out.splitlines()) <= 100
    text = " ".join(out.split())
    for word in (
        "licence MIT; a test",
        "along +y",
        "effective track 0.79",
        "gnss over wheels 0.9",
        "wheels after imu by 0.",
        "wheels: 5",
        "[imu-axes]",
    ):
        assert word in text, out


class Windows(formats.Format):
    """A file of three recordings: a drive, the same with its IMU upside down, and one without GNSS."""

    def claims(self, path: Path, head: bytes) -> bool:
        return path.suffix == ".windows"

    def read(self, request: formats.Request) -> list[Recording]:
        drive = open_recording(request.path.read_text())
        assert drive.imu is not None
        down = dataclasses.replace(drive.imu, accel_mps2=-drive.imu.accel_mps2)
        return [
            drive.with_notes("7 rows dropped"),
            dataclasses.replace(drive, imu=down).with_notes("8 rows dropped"),
            dataclasses.replace(drive, gnss=None),
        ]


@pytest.fixture
def windows(known_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(formats, "FORMATS", (Windows("windows", "windows", ""), *formats.FORMATS))
    (tmp_path / "some.windows").write_text(str(known_log))
    return tmp_path / "some.windows"


def test_inspect_several(windows: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = json.loads(run(capsys, "inspect", windows, "--json")[1])
    assert (page["name"], page["recordings"]) == ("some.windows", 3)
    assert page["duration_s"]["total"] == pytest.approx(3 * page["duration_s"]["median"])
    assert page["channels"]["imu"]["samples"] == 3 * 6000
    assert page["channels"]["imu"]["ranges"]["accel_y_mps2"] == [-9.81, 9.81]
    assert page["channels"]["gnss"]["recordings"] == 2
    assert {"note": "7 rows dropped", "recordings": 2, "numbers_vary": True} in page["notes"]
    axes = next(f for f in page["findings"] if f["code"] == "imu-axes")
    assert (axes["recordings"], axes["first"]) == (3, 0)
    assert page["measured"]["yaw"]["seconds"] == pytest.approx(3 * 59.5)
    assert page["measured"]["path_m"]["gnss"] == pytest.approx(2 * 0.96 * 59.0, rel=0.02)
    _, out, _ = run(capsys, "inspect", windows)
    assert "3 recordings of" in out
    assert max(len(line) for line in out.splitlines()) <= 100


def test_number_chooses_one_of_several(
    windows: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = json.loads(run(capsys, "inspect", f"{windows}#2", "--json")[1])
    assert alone["recordings"] == 1
    assert "gnss" not in alone["channels"]
    status, _, err = run(capsys, "convert", windows, tmp_path / "out")
    assert (status, err.count("\n")) == (1, 1)
    assert "holds 3 recordings" in err
    assert f"{windows}#0" in err
    assert run(capsys, "convert", f"{windows}#2", tmp_path / "out")[0] == 0
    status, _, err = run(capsys, "inspect", f"{windows}#3")
    assert (status, err.count("\n")) == (1, 1)
    assert "numbered from 0" in err


def test_catalogue_name(husky_bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert husky_bag.is_file()
    page = json.loads(run(capsys, "inspect", "husky_parkinglot/test1", "--json")[1])
    assert page["licence"] == "BSD-3-Clause"
    assert page["channels"]["gnss"]["samples"] == 989


def test_absent_catalogue_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERRAFUSION_DATA", str(tmp_path))
    monkeypatch.setattr("terrafusion.datasets.catalog.catalog.cache_folder", lambda: tmp_path)
    status, _, err = run(capsys, "inspect", "husky_parkinglot/test1")
    assert (status, err.count("\n")) == (1, 1)
    assert "terrafusion fetch husky_parkinglot" in err


def test_convert_to_mcap_and_back(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "convert", log, tmp_path / "a.mcap")
    assert status == 0
    assert "no datum" in out
    assert (tmp_path / "a.mcap").is_file()
    status, out, _ = run(capsys, "convert", tmp_path / "a.mcap", tmp_path / "back")
    assert status == 0
    back = open_recording(tmp_path / "back")
    assert {name: len(c) for name, c in back.channels().items()} == {
        "wheels": 100, "imu": 500, "gnss": 10, "terrain": 2,
    }  # fmt: skip
    status, _, err = run(capsys, "convert", log, tmp_path / "a.mcap")
    assert (status, err.count("\n")) == (1, 1)
    assert run(capsys, "convert", log, tmp_path / "a.mcap", "--force")[0] == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("inspect", "nowhere.bag"), "nowhere.bag"),
        (("inspect", "."), "meta.yaml"),
        (("inspect", "my_log", "--vehicle", "no_such_robot"), "no_such_robot"),
        (("convert", "empty.mcap", "out"), "empty.mcap"),
        (("convert", "my_log", "."), "not empty"),
    ],
)
def test_known_errors_are_one_line(
    log: Path, words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(log.parent)
    (log.parent / "empty.mcap").touch()
    status, out, err = run(capsys, *words)
    assert (status, out) == (1, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err


def test_bad_cell_is_one_line(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (log / "imu.csv").write_text("t_s,gyro_z_radps\n0,0\n0.02,nan\n")
    status, _, err = run(capsys, "inspect", log)
    assert (status, err.count("\n")) == (1, 1)
    for word in ("imu.csv", "gyro_z_radps", "line 3", "t = 0.020 s", "leave the cell empty"):
        assert word in err


@pytest.mark.parametrize("words", [("--topic", "imu"), ("--stamps", "arrival"), ("--nonsense",)])
def test_wrong_usage_is_status_2(
    log: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "inspect", log, *words)[0] == 2


@pytest.mark.parametrize("name", ["drive.bag", "drive.db3", "drive.csv.gz"])
def test_a_folder_with_the_name_of_a_file_is_not_written(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    status, _, err = run(capsys, "convert", log, tmp_path / name)
    ending = Path(name).suffix
    assert status == 1
    assert f"{name}: a folder is written, no {ending} file; give the name of a folder, or of a file" in err
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("start_ns", "words"),
    [
        (1_700_000_000_000_000_000, "start 2023-11-14 22:13:20 UTC"),
        (1_700_000_000, "start 1.700 s after 1970; if start_ns is given in s: 2023-11-14"),
        (1_700_000_000_000, "start 1700.000 s after 1970; if start_ns is given in ms: 2023-11-14"),
        (5_000_000_000_000_000, "start 5000000.000 s (no calendar time)"),
    ],
)
def test_a_start_in_another_unit_is_told(start_ns: int, words: str) -> None:
    assert _utc(start_ns) == words
