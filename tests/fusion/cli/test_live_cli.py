"""`terrafusion live`: times and the last state, and a log that is not there in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli.main import app
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.grounds.file import read_grounds
from terrafusion.fusion.live.loop import live_estimator


def test_a_log_gives_times_and_the_last_state(good_log: Path) -> None:
    done = CliRunner().invoke(app, ["live", str(good_log)])
    assert done.exit_code == 0
    lines = done.output.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["keyframe", "sample", "odometry"]
    assert lines[3].startswith("running: [")
    assert lines[4] == "verdict: good", lines


def test_a_log_is_run_with_the_robot_and_in_the_mode_asked_for(
    good_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Estimator] = []

    def seen(*options: Any) -> Estimator:
        made.append(live_estimator(*options))
        return made[-1]

    monkeypatch.setattr("terrafusion.fusion.live.loop.live_estimator", seen)
    CliRunner().invoke(app, ["live", str(good_log), "--mode", "fixed", "--vehicle", "husky"])
    assert (made[0].config.mode, made[0].config.vehicle) == ("fixed", "husky")


def test_a_log_leaves_what_it_learned_of_grounds(good_log: Path, tmp_path: Path) -> None:
    path = tmp_path / "grounds.yaml"
    done = CliRunner().invoke(app, ["live", str(good_log), "--grounds", str(path)])
    assert done.exit_code == 0
    assert read_grounds(path).robot == "elevate"
    assert f"of 'elevate' to {path}" in " ".join(done.output.split())


@pytest.mark.parametrize(
    "words",
    [("--rate", "nan"), ("--rate", "0"), ("--wait", "-1"), ("--datum", "90,0,0"), ("--datum", "nan,0,0")],
)
def test_options_that_make_no_sense_are_refused_with_a_log_too(
    good_log: Path, words: tuple[str, ...]
) -> None:
    assert isinstance(CliRunner().invoke(app, ["live", str(good_log), *words]).exception, TerrafusionError)


@pytest.mark.parametrize(
    "words",
    [
        ("--domain", "7"), ("--loopback",), ("--reliable",), ("--seconds", "3"), ("--foxglove", "8765"),
        ("--rate", "20"), ("--wait", "0.1"), ("--datum", "1,2,3"), ("--use-sim-time",), ("--namespace", "/r"),
    ],
)  # fmt: skip
def test_options_of_a_robot_are_wrong_usage_beside_a_log(good_log: Path, words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, ["live", str(good_log), *words])
    assert done.exit_code == 2
    assert f"{words[0]}: goes with a robot, not with a LOG" in " ".join(done.output.split())


def test_the_pace_of_a_recording_is_wrong_usage_without_one() -> None:
    done = CliRunner().invoke(app, ["live", "--realtime", "--seconds", "0"])
    assert done.exit_code == 2
    assert "--realtime: goes with a LOG" in " ".join(done.output.split())


def test_a_log_that_is_not_there_is_a_known_error() -> None:
    done = CliRunner().invoke(app, ["live", "no-such-log"])
    assert isinstance(done.exception, TerrafusionError)


def test_a_log_without_wheels_is_refused(good_log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    for file in good_log.iterdir():
        if not file.name.startswith("wheels"):
            (folder / file.name).write_bytes(file.read_bytes())
    done = CliRunner().invoke(app, ["live", str(folder)])
    assert isinstance(done.exception, TerrafusionError)
    with pytest.raises(TerrafusionError, match="IMU or wheels"):
        raise done.exception
