"""The commands: wrong input is one line, before any long work."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.cli import policy, terrain
from terrafusion.fusion.training.detector_scores import DetectorScores


@pytest.mark.parametrize(("app", "command"), [(terrain.app, "train"), (policy.app, "fit")])
def test_an_output_that_cannot_be_written_is_told_at_once(app: object, command: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path, tmp_path / "file" / "model.yaml"):
        result = CliRunner().invoke(app, [command, "--out", str(out)])  # type: ignore[arg-type]
        assert isinstance(result.exception, TerrafusionError)
        assert "cannot be written" in str(result.exception)


def test_no_seeds_is_wrong_usage(tmp_path: Path) -> None:
    result = CliRunner().invoke(terrain.app, ["train", "--out", str(tmp_path / "m.yaml"), "--seeds", "0"])
    assert result.exit_code == 2


def test_a_missing_model_is_a_known_error(tmp_path: Path) -> None:
    result = CliRunner().invoke(terrain.app, ["eval", "--model", str(tmp_path / "none.yaml")])
    assert isinstance(result.exception, TerrafusionError)


def test_scores_are_printed_for_the_grounds_that_occurred(capsys: pytest.CaptureFixture[str]) -> None:
    confusion = ((0.9, 0.1, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    scores = DetectorScores(
        ("mud", "ice", "unknown"), 0.9, 0.9, 0.01, confusion, 50, 0.0, (1.0, 1.5, 2.0), 1.0, 0.0, 0.1, 0.2
    )
    lines = terrain.score_lines("trial", scores)
    assert lines[0] == "trial: 50 windows"
    assert [line.split()[0] for line in lines[2:4]] == ["mud", "macro-F1"]
    assert "within 2 s 100%" in lines[4]
    with terrain.progress("drives", 3) as tick:
        tick()
    assert capsys.readouterr().err == ""
