"""The scripts of docs/examples run as they stand, without a log of the reader's own, on the first minute."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from tests.test_docs import cut_after

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
SAID = {
    "replay_your_bag": "position error against truth",
    "live_estimator": "running   east",
    "simulate_your_robot": "path",
    "calibrate_sensors": "next: terrafusion replay LOG --vehicle my_robot.yaml",
    "find_a_gap": "verdict: effect wheel_radius",
}
"""What each prints, by name."""


def test_every_example_is_run_and_short() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAID)
    for path in EXAMPLES.glob("*.py"):
        assert len(path.read_text(encoding="utf-8").splitlines()) < 60, path.name


@pytest.mark.parametrize("name", SAID)
def test_example(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    cut_after(60.0, monkeypatch)
    monkeypatch.setattr(sys, "argv", [f"{name}.py"])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert SAID[name] in capsys.readouterr().out
