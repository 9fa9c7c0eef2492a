"""`demo`: the command a newcomer runs first."""

from __future__ import annotations

import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.cli import demo as module
from terrafusion.twin import simulate as simulation
from terrafusion.twin.simulate import simulate

ROOT = Path(__file__).parents[3]
ENTRY = "from terrafusion.fusion.cli.main import main; main()"
FILES = {"metrics.json", "estimate.csv", "trajectory.tum", "weights.jsonl", "report.html"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a demo run as the shell runs it, with every warning shown, and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    done = subprocess.run(
        [sys.executable, "-c", ENTRY, "demo", "--out", "first", "--drives", "1"],
        capture_output=True, text=True, timeout=900, check=False, cwd=folder,
        env=os.environ | {"PYTHONWARNINGS": "default"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "first", done.stdout


def test_the_comparison_is_printed(demo: tuple[Path, str]) -> None:
    _, out = demo
    lines = out.splitlines()
    assert "asphalt, loose_sand, mud" in lines[0]
    assert lines[1].split() == ["fixed", "adaptive"]
    assert lines[-1] == f"report: {Path('first') / 'report.html'}"
    for row in ("with GNSS", "in the outage", "at the end of the outage"):
        line = next(line for line in lines if line.startswith(f"position error {row} (m)"))
        assert len(re.findall(r"\d+\.\d\d \[\d+\.\d\d, \d+\.\d\d\]", line)) == 2, line
    for row in ("position error, whole drive", "heading error", "real-time factor"):
        line = next(line for line in lines if line.startswith(row))
        assert len(re.findall(r"\d+\.\d\d", line)) == 2, line
    assert (
        sum(
            line.startswith(("Where adaptive weights do not help", "Adaptive weights help")) for line in lines
        )
        == 1
    )


def test_the_map_shows_the_path_in_the_odometry_frame(demo: tuple[Path, str]) -> None:
    folder, _ = demo
    assert 'data-series="map/adaptive, odometry frame"' in (folder / "report.html").read_text()


def test_the_odometry_frame_does_not_jump_where_gnss_comes_back(demo: tuple[Path, str]) -> None:
    """A step takes a tenth of a second at 1.1 m/s; the map is corrected by more than that."""
    _, out = demo
    line = next(line for line in out.splitlines() if line.startswith("Largest step"))
    map_m, odom_m = (float(x) for x in re.findall(r"(\d+\.\d\d) m", line))
    assert odom_m < 0.15 < map_m


def test_its_files(demo: tuple[Path, str]) -> None:
    folder, out = demo
    assert {path.name for path in folder.iterdir()} == {
        "log",
        "fixed",
        "adaptive",
        "report.html",
        "config.json",
    }
    schema = json.loads((ROOT / "docs" / "schemas" / "metrics.schema.json").read_text(encoding="utf-8"))
    printed = next(line for line in out.splitlines() if line.startswith("position error, whole")).split()[-2:]
    for mode, shown in zip(("fixed", "adaptive"), printed, strict=True):
        assert {path.name for path in (folder / mode).iterdir()} == FILES
        metrics = json.loads((folder / mode / "metrics.json").read_text())
        jsonschema.validate(metrics, schema)
        assert metrics["mode"] == mode
        assert f"{metrics['ate_m']:.2f}" == shown
        assert metrics["outages"][0]["distance_m"] > 20.0
    report = (folder / "report.html").read_text(encoding="utf-8")
    assert "fixed" in report
    assert "adaptive" in report
    assert "All drives" in report
    assert "default-src 'none'" in report  # the browser asks for nothing outside


def test_its_log_can_be_read_again(demo: tuple[Path, str]) -> None:
    folder, _ = demo
    recording = open_recording(folder / "log")
    assert set(recording.channels()) == {"command", "wheels", "imu", "gnss", "motor", "terrain"}
    assert recording.duration_s() == pytest.approx(150.0, abs=0.1)


def test_several_drives_run_twice_into_the_same_folder(
    tmp_path: Path, terrafusion, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """The first 22 s of each drive are enough for that."""

    @functools.cache
    def short(name: str, seed: int) -> Recording:
        return until(simulate(name, seed=seed), 22.0)

    monkeypatch.setattr(simulation, "simulate", short)
    monkeypatch.setattr(module, "OUTAGE_START_S", 13.0)
    monkeypatch.setattr(module, "OUTAGE_S", 6.0)
    estimates = []
    for drives in (2, 1):
        if drives == 1:  # the pages of a drive have been written by then
            request.getfixturevalue("no_report")
        outcome = terrafusion("demo", "--out", tmp_path / "out", "--drives", drives, "--jobs", "1")
        assert (outcome.status, outcome.err) == (0, "")
        assert outcome.out.startswith(f"{drives} drives of 22 s over asphalt")
        estimates.append((tmp_path / "out" / "fixed" / "estimate.csv").read_bytes())
    assert estimates[0] == estimates[1]
