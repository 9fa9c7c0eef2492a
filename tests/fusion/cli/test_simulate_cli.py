"""`simulate`: its options reach the run, what it prints tells of it, wrong ones are told in one line."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.main import app, main
from terrafusion.twin.model.choose import choose_vehicle

pytestmark = pytest.mark.usefixtures("quick")

SHORT = "drive: [{duration_s: 2}, {duration_s: 8, v_mps: 1.0}]\nroute: [{terrain: asphalt}]\n"


def told(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """What the command says as it fails with a known error: one line, exit status 1."""
    monkeypatch.setattr("sys.argv", ["terrafusion", "simulate", *arguments, "--out", "log"])
    with pytest.raises(SystemExit) as ended:
        main()
    captured = capsys.readouterr()
    assert ended.value.code == 1
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    return captured.err


def test_options_reach_the_run_and_the_log_holds_it(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    options = [
        "--slope-deg",
        "5",
        "--cross-slope-deg",
        "-4",
        "--payload-kg",
        "20",
        "--payload-at",
        "0.1,0,0.3",
    ]
    done = CliRunner().invoke(app, ["simulate", "short.yaml", *options, "--seed", "3", "--out", "log"])
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert lines[0].endswith("slope 5 deg, across -4 deg; payload 20 kg at 0.1, 0, 0.3 m; seed 3")
    assert lines[1].startswith("distance 7.")
    assert "W mean" in lines[2]
    assert "% slip" in lines[2]
    assert lines[3] == "not immobilised"
    assert any(line.startswith("assumed numbers, marked in their files: ") for line in lines)
    assert lines[-1] == "written to log"
    log = open_recording(tmp_path / "log")
    assert log.imu is not None
    assert log.imu.accel_mps2[:100, 1].mean() == pytest.approx(-9.8 * 0.07, abs=0.1)


@pytest.mark.parametrize("out", ["log", "log.mcap"])
def test_a_log_finds_the_vehicle_of_the_users_own_file(out: str, tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    own = files("terrafusion.twin.params").joinpath("vehicles", "generic.yaml").read_text()
    (tmp_path / "own.yaml").write_text(own.replace("name: generic", "name: cart").replace("0.165", "0.172"))
    done = CliRunner().invoke(app, ["simulate", "short.yaml", "--vehicle", "own.yaml", "--out", out])
    assert done.exit_code == 0, done.output
    chosen, _ = choose_vehicle(open_recording(tmp_path / out))
    assert (chosen.name, chosen.odometry.wheel_radius_m) == ("cart", pytest.approx(0.172))


def test_immobilisation_is_told_with_place_and_cause(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["simulate", "paper_profile", "--terrain", "mud", "--out", "mud"])
    assert done.exit_code == 0, done.output
    assert "immobilised at " in done.output
    assert " m: motors stalled" in done.output


def test_what_a_turn_on_the_spot_leaves_undefined_is_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "turn.yaml").write_text("drive: [{duration_s: 4, yaw_rate_radps: 0.5}]\n")
    done = CliRunner().invoke(app, ["simulate", "turn.yaml", "--out", "log"])
    assert done.exit_code == 0, done.output
    assert "mean |slip| undefined (it hardly moved), energy a metre undefined" in done.output
    assert "nan" not in done.output
    assert "-0 %" not in done.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["straight", "--slope-deg", "26"], "slope 26 deg is out of range; give 0 to 25 deg"),
        (["straight", "--cross-slope-deg", "nan"], "cross-slope nan deg is out of range; give -25 to 25 deg"),
        (["straight", "--payload-kg", "61"], "payload 61 kg is out of range; give 0 to 60 kg"),
        (["straight", "--payload-at", "0,0,9"], "'payload_at_m' is (0.0, 0.0, 9.0), out of range"),
        (
            ["straight", "--payload-kg", "60", "--payload-at", "0,0,1", "--cross-slope-deg", "20"],
            "the robot tips over where it starts",
        ),
        (["nowhere"], "unknown scenario 'nowhere'; known are"),
        (["straight", "--vehicle", "huskey"], "unknown vehicle 'huskey'; known are"),
        (["straight", "--seed", "-1"], "seed -1 is negative"),
    ],
)
def test_a_wrong_request_is_one_line(options, message, monkeypatch, capsys) -> None:
    assert message in told(options, monkeypatch, capsys)


def test_a_place_that_is_none_is_wrong_usage() -> None:
    done = CliRunner().invoke(app, ["simulate", "straight", "--payload-at", "here", "--out", "log"])
    assert done.exit_code == 2
    assert "'here' is not X,Y,Z in metres" in done.output


def test_help_shows_examples_and_ranges() -> None:
    done = CliRunner().invoke(app, ["simulate", "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert done.exit_code == 0
    for words in ("--cross-slope-deg", "--payload-at", "-25 to 25 deg", "--payload-at 0,0.1,0.4"):
        assert words in done.output
