"""`terrafusion sweep`: files, report, lines, and how it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.fusion.reports.browser import assert_drawn

SWEEP = """\
description: climbing <sand> & co
scenario: drive.yaml
axes:
  terrain: [asphalt, loose_sand]
  friction: {from: 0.2, to: 0.8, count: 4}
  slope_deg: [0, 5, 10, 15]
"""

MAPS = ("map0_slip", "map0_energy", "map0_share")


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.yaml").write_text("drive: [{duration_s: 2, v_mps: 1.0}]\n")
    (tmp_path / "own.yaml").write_text(SWEEP)
    return tmp_path / "own.yaml"


def test_a_sweep_leaves_table_report_and_plots(terrafusion: Any, file: Path) -> None:
    done = terrafusion("sweep", file, "--out", "out", "--jobs", 1)
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert lines[0].startswith("own: 32 runs of 2 s (terrain 2 x friction 4 x slope_deg 4; ")
    assert lines[1].startswith("32 runs: ")
    assert lines[-1] == "written to out"
    names = sorted(path.name for path in Path("out").iterdir())
    assert names == [
        "config.json",
        "report.html",
        "runs.parquet",
        "sweep.json",
    ]
    page = Path("out/report.html").read_text()
    assert "Climbing &lt;sand&gt; &amp; co. elevate drives drive: 32 runs" in page
    assert page.count("<figure>") == 8
    assert re.search(r"<strong>\d+ of 32 runs are mobile", page)
    assert re.search(r"Slope, deg: \d+ % of the runs are mobile at 0, \d+ % at 15\.", page)
    assert json.loads(Path("out/sweep.json").read_text())["sha256"] in page
    assert "default-src 'none'" in page  # the browser itself refuses any request
    assert_drawn(Path("out/report.html"))


def test_no_plots_and_recordings_of_chosen_runs(terrafusion: Any, file: Path) -> None:
    done = terrafusion(
        "sweep", file, "--out", "out", "--jobs", 1, "--no-plots", "--recordings", 7, "--recordings", 3
    )
    assert done.status == 0
    assert sorted(path.name for path in Path("out").iterdir()) == [
        "config.json",
        "recordings",
        "runs.parquet",
        "sweep.json",
    ]
    logs = sorted(path.name for path in Path("out/recordings").iterdir())
    assert logs == ["run-000003", "run-000007"]
    looked = terrafusion("inspect", "out/recordings/run-000003")
    assert looked.status == 0
    assert "elevate" in looked.out


def test_the_same_command_again_computes_nothing_and_redraws(terrafusion: Any, file: Path) -> None:
    first = terrafusion("sweep", file, "--out", "out", "--jobs", 1, "--no-plots")
    written = Path("out/runs.parquet").stat().st_mtime_ns
    again = terrafusion("sweep", file, "--out", "out", "--jobs", 1)
    assert again.out == first.out
    assert Path("out/runs.parquet").stat().st_mtime_ns == written
    assert Path("out/report.html").is_file()


@pytest.mark.parametrize(
    ("axes", "plots"),
    [
        ("{seed: [1, 2]}", ["energy_slip"]),
        ("{slope_deg: [0, 4, 8]}", ["profile_slip", "profile_energy", "profile_share", "energy_slip"]),
        ("{payload_kg: [0, 20], speed_mps: [0.5, 1.0, 1.5]}", [*MAPS, "mobility", "energy_slip"]),
        ("{terrain: [loose_sand], slope_deg: [24, 25], friction: [0.1, 0.2]}", [*MAPS, "mobility"]),
    ],
)
def test_the_plots_fit_the_axes(terrafusion: Any, file: Path, axes: str, plots: list[str]) -> None:
    file.write_text(f"scenario: drive.yaml\naxes: {axes}\n")
    done = terrafusion("sweep", file, "--out", "out", "--jobs", 1)
    assert (done.status, done.err) == (0, "")
    page = Path("out/report.html").read_text()
    assert re.findall(r'id="plot-(\w+)"', page) == plots
    assert page.count("<h2>") >= 3


def test_known_errors_are_one_line(terrafusion: Any, file: Path) -> None:
    assert terrafusion("sweep", "climb", "--out", "out").refused("unknown sweep 'climb'", "friction_slope")
    assert terrafusion("sweep", file, "--out", "out", "--max-runs", 31).refused("32 runs", "31", "--max-runs")
    assert terrafusion("sweep", file, "--out", "out", "--recordings", 32).refused("no run 32", "0 to 31")
    Path("taken").write_text("")
    assert terrafusion("sweep", file, "--out", "taken").refused("taken", "cannot be written")
    file.write_text("scenario: drive.yaml\naxes: {slope_deg: [30]}\n")
    assert terrafusion("sweep", file, "--out", "out").refused("axes.slope_deg[0]", "30", "[0, 25] deg")
    address = ("--backend", "dask", "--address", "127.0.0.1")
    file.write_text(SWEEP)
    assert terrafusion("sweep", file, "--out", "out", *address).refused("no address of a scheduler", "tcp://")
    assert not list(Path(".").rglob("*.parquet"))
    assert Path("taken").read_text() == ""


@pytest.mark.parametrize(
    "words",
    [
        ("--backend", "slurm"),
        ("--backend", "dask"),
        ("--address", "tcp://127.0.0.1:8786"),
        ("--jobs", "0"),
        ("--recordings", "some"),
        ("--recordings-format", "zip"),
    ],
)
def test_wrong_usage_has_status_2(terrafusion: Any, file: Path, words: tuple[str, str]) -> None:
    assert terrafusion("sweep", file, "--out", "out", *words).status == 2
    assert not Path("out").exists()


def test_a_run_that_fails_is_told_with_its_reason(terrafusion: Any, file: Path) -> None:
    Path("drive.yaml").write_text("drive: [{duration_s: 2, v_mps: 1.0}]\npayload_at_m: [0, 0, -2]\n")
    file.write_text("scenario: drive.yaml\naxes: {payload_kg: [20]}\n")
    done = terrafusion("sweep", file, "--out", "out", "--jobs", 1, "--no-plots")
    assert done.status == 1
    assert Path("out/runs.parquet").is_file()
    assert "1 run: 1 failed\nrun 0 failed: drive: the payload is 2 m below the ground; give" in done.out
