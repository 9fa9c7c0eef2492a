"""`replay`: the files it leaves agree with each other, and the public Husky drive is localised well."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.common import load_rig

ROOT = Path(__file__).parents[3]
SCHEMA = json.loads((ROOT / "docs" / "schemas" / "metrics.schema.json").read_text(encoding="utf-8"))
FILES = {"metrics.json", "estimate.csv", "trajectory.tum", "weights.jsonl", "report.html", "config.json"}
WEIGHTS = {"t_s", "t_ns", "sensor", "before", "after", "unit", "reason"}

SCENARIO = """\
description: a stop, two grounds, turns both ways
drive:
  - {duration_s: 3}
  - {duration_s: 12, v_mps: 0.9}
  - {duration_s: 10, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 10, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt, length_m: 15}
  - {terrain: loose_sand}
"""


@dataclass(frozen=True)
class Results:
    """The content of a results folder."""

    metrics: dict[str, Any]
    rows: list[dict[str, str]]
    tum: np.ndarray
    weights: list[dict[str, Any]]
    report: str

    def column(self, name: str) -> np.ndarray:
        """A numeric column of estimate.csv; empty cells are NaN."""
        return np.array([float(row[name] or "nan") for row in self.rows])


def read_results(folder: Path) -> Results:
    """All five files, each by a reader that is not ours."""
    assert {path.name for path in folder.iterdir()} == FILES
    metrics = json.loads((folder / "metrics.json").read_text(), parse_constant=pytest.fail)
    jsonschema.Draft202012Validator(SCHEMA).validate(metrics)
    with (folder / "estimate.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    lines = (folder / "weights.jsonl").read_text().splitlines()
    return Results(
        metrics,
        rows,
        np.loadtxt(folder / "trajectory.tum", ndmin=2),
        [json.loads(line, parse_constant=pytest.fail) for line in lines],
        (folder / "report.html").read_text(encoding="utf-8"),
    )


def check_agreement(results: Results, start_ns: int) -> None:
    """Row counts, times, positions and counts are the same in every file."""
    metrics, rows, tum = results.metrics, results.rows, results.tum
    assert len(rows) == len(tum) == metrics["updates"] > 100
    t_ns = np.array([int(row["t_ns"]) for row in rows])
    assert (np.diff(t_ns) > 0).all()
    for row, t in zip(rows, t_ns.tolist(), strict=True):
        whole, part = row["t_s"].split(".")
        assert int(whole) * 10**9 + int(part) == t - start_ns
    np.testing.assert_allclose(tum[:, 0], t_ns * 1e-9, atol=1e-6)  # a double holds a Unix time to 0.2 us
    position = np.stack([results.column(name) for name in ("x_m", "y_m", "z_m")], axis=1)
    quaternion = np.stack([results.column(name) for name in ("qx", "qy", "qz", "qw")], axis=1)
    np.testing.assert_allclose(tum[:, 1:4], position, atol=1e-6)
    np.testing.assert_allclose(np.abs((tum[:, 4:] * quaternion).sum(axis=1)), 1.0, atol=1e-6)
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).sum() == pytest.approx(
        metrics["distance_m"], rel=0.05
    )
    assert len(results.weights) == metrics["weights"]["changes"]
    assert all(set(change) == WEIGHTS and change["reason"] for change in results.weights)
    changed = [change["t_ns"] for change in results.weights]
    assert changed == sorted(changed)
    assert rows[-1]["status"] == metrics["status"]["value"]
    assert sum(metrics["terrain"].values()) == pytest.approx(1.0)
    assert metrics["log"] in results.report
    assert "<svg" in results.report or "data:image/" in results.report
    assert "default-src 'none'" in results.report, "the report must be self-contained"


def check_verdict(results: Results, screen: str) -> None:
    """The verdict comes first, on the screen and in the report; assumptions and notes follow."""
    metrics, lines = results.metrics, screen.splitlines()
    words = metrics["verdict"]["value"].replace("_", " ")
    assert lines[0] == f"verdict: {words}"
    assert [line.strip() for line in lines[1:]][: len(metrics["verdict"]["reasons"])] == metrics["verdict"][
        "reasons"
    ]
    assert results.report.index(f"Verdict: {words}") < results.report.index("lasts")
    assert metrics["baselines"]["dead_reckoning_m"] > metrics["ate_m"]
    assert f"dead reckoning {metrics['baselines']['dead_reckoning_m']:.3f} m" in screen
    assert metrics["baselines"]["outages"][0]["gnss_m"] > 1.0
    assumed = [line for line in lines if line.startswith("assumed: ")]
    assert len(assumed) == len(metrics["assumed"]) > 0
    for note in metrics["notes"]:
        assert note in screen


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from terrafusion.datasets.writers import write_log_folder
    from terrafusion.twin.simulate import simulate

    folder = tmp_path_factory.mktemp("twin")
    (folder / "scenario.yaml").write_text(SCENARIO)
    return write_log_folder(simulate(str(folder / "scenario.yaml"), seed=2), folder / "drive")


@pytest.mark.parametrize("options", [(), ("--mode", "fixed"), ("--batch",)], ids=" ".join)
def test_files_agree(options: tuple[str, ...], drive: Path, tmp_path: Path, terrafusion) -> None:
    outcome = terrafusion("replay", drive, "--out", tmp_path / "results", "--gnss-outage", "20:5", *options)
    assert (outcome.status, outcome.err) == (0, "")
    results = read_results(tmp_path / "results")
    recording = open_recording(drive)
    check_agreement(results, recording.start_ns)
    metrics = results.metrics
    check_verdict(results, outcome.out)
    assert metrics["against"] == "truth"
    assert metrics["duration_s"] == pytest.approx(35.0, abs=0.1)
    assert [outage["start_s"] for outage in metrics["outages"]] == [20.0]
    assert metrics["held_out"]["fixes"] == 25
    assert f"position error {metrics['ate_m']:.3f} m" in outcome.out
    assert f"{metrics['outages'][0]['median_m']:.2f} m" in outcome.out
    if "fixed" in options:
        assert results.weights == []
    # The score again, from the files alone.
    truth = recording.truth
    assert truth is not None
    t_ns = np.array([int(row["t_ns"]) for row in results.rows])
    reference = [np.interp(t_ns, truth.t_ns, truth.position_m[:, k]) for k in range(2)]
    error = np.hypot(results.column("x_m") - reference[0], results.column("y_m") - reference[1])
    assert np.sqrt(np.mean(error**2)) == pytest.approx(metrics["ate_m"], rel=0.02)
    assert metrics["ate_m"] < 0.5
    assert error.max() < 2.0


def test_the_same_drive_gives_the_same_files_and_an_older_result_is_replaced(
    drive: Path, tmp_path: Path, terrafusion
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("terrafusion.fusion.reports.replay.write_report", lambda *_, **__: None)
        for name in ("a", "b"):
            assert terrafusion("replay", drive, "--out", tmp_path / name).status == 0
    for name in ("estimate.csv", "trajectory.tum", "weights.jsonl"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert terrafusion("replay", drive, "--out", tmp_path / "b", "--mode", "fixed").status == 0
    assert read_results(tmp_path / "b").metrics["mode"] == "fixed"


def test_husky(husky_bag: Path, tmp_path: Path, terrafusion) -> None:
    """Every fifth fix is kept back; the fixes' own sigma is 0.8 to 1.7 m."""
    metrics = husky(terrafusion, husky_bag, tmp_path, "adaptive").metrics
    assert metrics["against"] == "gnss_held_out"
    assert metrics["held_out"]["fixes"] > 150
    assert metrics["held_out"]["median_m"] <= 1.5
    assert metrics["realtime_factor"] > 5.0  # 80 on an idle core; tests run beside other work
    assert metrics["outages"] == []


@pytest.mark.usefixtures("no_report")
def test_grounds_are_written_with_the_name_of_the_robot(drive: Path, tmp_path: Path, terrafusion) -> None:
    grounds = tmp_path / "grounds.yaml"
    for _ in ("new", "known"):
        done = terrafusion("replay", drive, "--grounds", grounds, "--out", tmp_path / "out")
        assert done.out.splitlines()[-1].endswith(f" grounds of 'elevate' to {grounds}")
        assert "robot: elevate" in grounds.read_text()


def test_a_file_for_a_folder_is_refused_before_anything_is_computed(
    terrafusion: Any, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    monkeypatch.setattr("terrafusion.fusion.replay.replay", lambda *_, **__: pytest.fail("computed"))
    assert terrafusion("replay", drive, "--out", taken).refused("cannot be written", "taken")
    assert taken.read_text() == "mine"


@pytest.mark.parametrize("mode", ["fixed", "adaptive"])
def test_husky_without_gnss_for_a_minute_twice(
    mode: str, husky_bag: Path, tmp_path: Path, terrafusion
) -> None:
    words = ("--gnss-outage", "120:60", "--gnss-outage", "200:60")
    results = husky(terrafusion, husky_bag, tmp_path, mode, *words)
    for outage, start_s in zip(results.metrics["outages"], (120, 200), strict=True):
        print(f"{mode}, {start_s} s: median {outage['median_m']:.2f} m, end {outage['end_error_m']:.2f} m")
        assert (outage["start_s"], outage["seconds"]) == (start_s, 60.0)
        assert 30.0 < outage["distance_m"] < 80.0
        assert outage["median_m"] <= 5.0


def husky(terrafusion, bag: Path, folder: Path, *words: str) -> Results:
    """A replay of the public bag, checked for agreement of its files and for divergence."""
    mode, *options = words
    outcome = terrafusion(
        "replay", bag, "--vehicle", "husky", "--mode", mode, "--out", folder / "results", *options
    )
    assert (outcome.status, outcome.err) == (0, "")
    results = read_results(folder / "results")
    recording = open_recording(bag, rig=load_rig("husky"))
    check_agreement(results, recording.start_ns)
    gnss = recording.gnss
    assert gnss is not None
    t_ns = np.array([int(row["t_ns"]) for row in results.rows])
    nearest = np.abs(t_ns[:, None] - gnss.t_ns[None, :]).argmin(axis=1)
    off = np.hypot(
        results.column("x_m") - gnss.enu_m[nearest, 0], results.column("y_m") - gnss.enu_m[nearest, 1]
    )
    assert off.max() < 30.0, "the estimate has diverged"
    assert results.metrics["duration_s"] == pytest.approx(395.34, abs=0.01)
    return results
