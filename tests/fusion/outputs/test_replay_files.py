"""The files a replay leaves behind: valid, complete, never half written."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.json_text import finite, to_json
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.common import Mode
from terrafusion.fusion.metrics.scores import HeldOut, Outage, Scores, score
from terrafusion.fusion.noise.modes import MODES
from terrafusion.fusion.outputs import replay_files
from terrafusion.fusion.outputs.replay_files import metrics_of, terrain_shares, write_outputs
from tests.fusion.replayed import result_of

SCHEMA = json.loads(
    (Path(__file__).parents[3] / "docs" / "schemas" / "metrics.schema.json").read_text(encoding="utf-8")
)


def check(metrics):
    """Strict JSON that keeps to the schema."""
    text = to_json(metrics)
    Draft202012Validator(SCHEMA).validate(json.loads(text, parse_constant=pytest.fail))


def test_the_command_line_has_the_modes():
    assert get_args(Mode) == MODES


@pytest.mark.parametrize("mode", MODES)
def test_metrics_keep_to_the_schema(drive, mode):
    d = drive(drift_mps=0.01)
    scores = score(d.estimate, d.recording, held_out=d.fixes, outages=[Outage(10, 20)])
    metrics = metrics_of(result_of(d.recording, d.estimate, scores, mode=mode))
    check(metrics)
    assert metrics["schema"] == "terrafusion.replay/1"
    assert metrics["ate_m"] > 0
    assert metrics["held_out"]["fixes"] == 121
    assert metrics["rejected"] == {"gnss": 7, "wheels": 0}
    assert metrics["update_latency_ms"]["p50"] == pytest.approx(0.6)
    tested = {(row["quantity"], row["terrain"]) for row in metrics["consistency"]}
    assert {
        ("position", "all"),
        ("position", "loose_sand"),
        ("heading", "all"),
        ("nis gnss", "all"),
    } <= tested
    assert {row["verdict"] for row in metrics["consistency"]} <= {"consistent", "overconfident", "cautious"}


def test_metrics_of_a_run_that_broke_are_still_valid(drive, monkeypatch):
    d = drive()
    bad = float("nan")
    broken = Scores(
        "truth", bad, {"10": bad, "50": None, "100": float("inf")}, bad, bad, bad, None,
        (), ("note",),
    )  # fmt: skip
    monkeypatch.setattr(replay_files, "terrain_shares", lambda *_: {"mud": bad, "snow": 1.0 + 1e-12})
    path = d.estimate.trajectory
    away = dataclasses.replace(path, position_m=np.full(path.position_m.shape, bad))
    estimate = dataclasses.replace(d.estimate, trajectory=away)
    metrics = metrics_of(
        result_of(d.recording, estimate, broken, seconds=bad, latencies_ms=np.array([bad, bad]))
    )
    check(metrics)
    assert metrics["terrain"] == {"mud": 0.0, "snow": 1.0}
    assert metrics["distance_m"] == metrics["realtime_factor"] == 0.0
    assert metrics["update_latency_ms"] == {"p50": 0.0, "p99": 0.0}
    assert metrics["ate_m"] is None
    assert metrics["rpe_percent"] == {"10": None, "50": None, "100": None}


def test_metrics_with_nothing_scored_are_valid(drive):
    d = drive()
    recording = dataclasses.replace(d.recording, truth=None)
    scores = score(d.estimate, recording, outages=[Outage(900, 5)])
    check(metrics_of(result_of(recording, d.estimate, scores)))


def test_numbers_that_are_not_finite_become_null():
    value = {"a": np.float64("nan"), "b": [np.inf, np.int64(3)], "c": np.array([1.0, np.nan])}
    assert finite(value) == {"a": None, "b": [None, 3], "c": [1.0, None]}
    assert finite(dataclasses.asdict(HeldOut(2, float("nan"), 1.0))) == {
        "fixes": 2,
        "median_m": None,
        "p95_m": 1.0,
    }


def test_terrain_shares_are_shares_of_time(drive):
    shares = terrain_shares(drive().estimate)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["asphalt"] == pytest.approx(0.5, abs=0.02)
    assert set(shares) == {"asphalt", "loose_sand"}


def test_grounds_that_the_robot_found_take_over_the_share_of_unknown_ground(drive):
    names = {"asphalt": "unknown", "loose_sand": "loose_sand"}
    estimate = drive().estimate
    estimate = dataclasses.replace(estimate, classes=tuple(names.get(c, "mud") for c in estimate.classes))
    shares = terrain_shares(estimate, {"ground 1": 0.6, "loose_sand": 0.2})
    expected = {"ground 1": 0.3, "loose_sand": 0.6, "unknown": 0.1}
    assert shares == pytest.approx(expected, abs=0.02)


def test_all_files_are_written_and_read_back(drive, tmp_path):
    d = drive()
    slip = d.estimate.slip.copy()
    slip[4] = np.nan
    estimate = dataclasses.replace(d.estimate, slip=slip)
    metrics = metrics_of(result_of(d.recording, estimate, score(estimate, d.recording)))
    paths = write_outputs(tmp_path / "new" / "out", estimate, metrics, d.recording)
    assert set(paths) == {"metrics.json", "estimate.csv", "trajectory.tum", "weights.jsonl"}
    assert sorted(p.name for p in (tmp_path / "new" / "out").iterdir()) == sorted(paths)
    assert json.loads(paths["metrics.json"].read_text(encoding="utf-8")) == json.loads(to_json(metrics))

    with paths["estimate.csv"].open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == len(estimate.trajectory)
    assert rows[4]["slip"] == ""
    assert rows[11]["t_s"] == "1.100000000"
    assert int(rows[11]["t_ns"]) == int(estimate.trajectory.t_ns[11])
    assert float(rows[-1]["x_m"]) == pytest.approx(estimate.trajectory.position_m[-1, 0], abs=1e-6)
    assert rows[-1]["terrain"] == "loose_sand"
    assert float(rows[0]["p_asphalt"]) == pytest.approx(0.9, abs=1e-3)
    assert float(rows[0]["sigma_yaw_rad"]) == pytest.approx(0.02)
    assert rows[0]["status"] == "running"
    assert float(rows[0]["w_gyro_inflation"]) == pytest.approx(2.0, abs=1e-3)

    back = open_recording(paths["trajectory.tum"]).truth
    assert back is not None
    np.testing.assert_array_equal(back.t_ns, estimate.trajectory.t_ns)
    changes = [json.loads(line) for line in paths["weights.jsonl"].read_text(encoding="utf-8").splitlines()]
    assert [c["sensor"] for c in changes] == ["wheels", "imu"]
    assert changes[0]["t_s"] == pytest.approx(60.0)
    assert set(changes[0]) == {"t_s", "t_ns", "sensor", "before", "after", "unit", "reason"}


def test_the_same_estimate_gives_the_same_bytes(drive, tmp_path):
    d = drive()
    metrics = metrics_of(result_of(d.recording, d.estimate, score(d.estimate, d.recording)))
    first = write_outputs(tmp_path / "a", d.estimate, metrics, d.recording)
    second = write_outputs(tmp_path / "b", d.estimate, metrics, d.recording)
    for name, path in first.items():
        assert path.read_bytes() == second[name].read_bytes()


def test_class_names_with_commas_stay_one_cell(drive, tmp_path):
    d = drive()
    estimate = dataclasses.replace(d.estimate, classes=('wet, "deep"\nmud', "b", "c", "d"))
    paths = write_outputs(tmp_path, estimate, {}, d.recording)
    with paths["estimate.csv"].open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert rows[0]["terrain"] == 'wet, "deep" mud'
    assert all(None not in row for row in rows)


def test_a_writer_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "metrics.json"
    path.write_text("old", encoding="utf-8")

    def fail(part: Path) -> None:
        part.write_text("half", encoding="utf-8")
        raise OSError(28, "No space left on device")

    with pytest.raises(TerrafusionError, match="No space left"):
        write_atomically(path, fail)
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_a_file_is_a_known_error(drive, tmp_path):
    d = drive(seconds=5.0)
    (tmp_path / "out").write_text("", encoding="utf-8")
    with pytest.raises(TerrafusionError, match="cannot be written"):
        write_outputs(tmp_path / "out", d.estimate, {}, d.recording)
