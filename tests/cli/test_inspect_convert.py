"""`inspect` and `convert` as a user runs them: output, exit status, one line for an error."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import typer

from terrafusion.datasets.errors import TerrafusionError
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli import convert, inspect

FILES = {
    "meta.yaml": "start_ns: 1700000000000000000\nvehicle: nobody_knows\nterrain: gravel\ntrack_m: 0.5\n",
    "imu.csv": "t_s,gyro_z_radps\n" + "".join(f"{i / 50:.2f},{i % 7 / 100}\n" for i in range(500)),
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
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command("inspect")(inspect.inspect)
    app.command("convert")(convert.convert)
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


def test_inspect_tells_a_gap(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (log / "imu.csv").read_text().splitlines(keepends=True)
    (log / "imu.csv").write_text("".join(lines[:100] + lines[200:]))
    _, out, _ = run(capsys, "inspect", log)
    row = next(line for line in out.splitlines() if line.startswith("imu "))
    assert row.split()[-2:] == ["1", "2"]  # gaps, and the longest in s
    assert "imu: 1 gap [gaps]" in out


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
    assert run(capsys, "convert", log, tmp_path / "a.mcap", "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("inspect", "nowhere.bag"), "nowhere.bag"),
        (("inspect", "."), "meta.yaml"),
        (("inspect", "my_log", "--vehicle", "no_such_robot"), "no_such_robot"),
        (("convert", "empty.mcap", "out"), "empty.mcap"),
        (("convert", "my_log", "."), "not empty"),
    ],
)
def test_known_errors_are_one_line(
    log: Path, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(log.parent)
    (log.parent / "empty.mcap").touch()
    status, out, err = run(capsys, *words)
    assert (status, out) == (1, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert told in err


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
