"""The field table: outage plan, fixes from truth, divergence, ratios, files, and one real log."""

from __future__ import annotations

import csv
import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark import checkpoints as parts
from terrafusion.fusion.benchmark.field_logs import Refusal
from terrafusion.twin.simulate import simulate
from tests.studies import field_runs
from tests.studies.field_table import table as field_table
from tests.studies.field_table.page import markdown, plot_lines, write
from tests.studies.field_table.summary import (
    BaselineComparison,
    compare_with_baselines,
    condense,
    in_order,
    ratio_of,
    verdicts,
)
from tests.studies.field_table.table import Run, Task, collect, run_task, run_tasks, tasks_of

SECOND_NS = 1_000_000_000


def made_run(log: str, mode: str, error_m: float | None, **changes: Any) -> Run:
    values: dict[str, Any] = {
        "log": log, "ground": "firm", "vehicle": "husky", "reference": "truth", "mode": mode, "test": "whole",
        "start_s": None, "distance_m": 100.0, "error_m": error_m, "within_m": None, "percent": error_m,
        "nees": 1.0, "top_speed_mps": 1.0, "path_ratio": 1.0, "diverged": "", "wheels_rejected": 0,
        "gnss_rejected": 0, "seconds": 1.0, "realtime": 100.0, "latency_p99_ms": 2.0,
    }  # fmt: skip
    return Run(**(values | changes))


def test_ratio_is_over_the_best_baseline_of_the_same_log() -> None:
    runs = [
        made_run("a", "adaptive", 1.0), made_run("a", "fixed", 2.0), made_run("a", "robust", 4.0),
        made_run("b", "adaptive", 3.0), made_run("b", "fixed", 2.0),
        made_run("c", "adaptive", None), made_run("c", "fixed", None),
    ]  # fmt: skip
    lines = {(line.log, line.mode): line for line in condense(runs)}
    assert lines["a", "adaptive"].ratio == pytest.approx(0.5)
    assert lines["a", "adaptive"].baseline == "fixed"
    assert lines["a", "robust"].ratio == pytest.approx(2.0)
    assert lines["c", "adaptive"].ratio is None
    (row,) = verdicts(list(lines.values()))
    assert (row["logs"], row["better"], row["worse"]) == (2, 1, 1)
    assert row["mean_ratio"] == pytest.approx(np.sqrt(0.5 * 1.5))
    assert row["worst"] == pytest.approx(1.5)


def test_lines_are_medians_over_starts() -> None:
    errors = (1.0, 9.0, 2.0)
    runs = [made_run("a", "fixed", e, test="outage 30 s", start_s=float(i)) for i, e in enumerate(errors)]
    (line,) = condense(runs)
    assert (line.error_m, line.runs) == (2.0, 3)


def test_the_interval_of_a_ratio_is_over_outages_and_noise() -> None:
    def runs(mode: str, times: float, outages: int, seeds: int) -> list[Run]:
        rng = np.random.default_rng(1)
        return [
            made_run("a", mode, times * e, test="outage 30 s", start_s=float(i), seed=seed)
            for i in range(outages)
            for seed, e in enumerate(rng.uniform(1.0, 3.0, seeds))
        ]

    def unlike(found: list[Run]) -> list[Run]:
        rng = np.random.default_rng(2)
        return [dataclasses.replace(r, error_m=float(rng.uniform(1.0, 3.0))) for r in found]

    own, other = runs("adaptive", 1.5, 8, 3), runs("fixed", 1.0, 8, 3)
    assert ratio_of(own, other) == pytest.approx((1.5, 1.5, 1.5))  # paired: the same draws of both
    ratio, low, high = ratio_of(unlike(own), other)
    assert ratio is not None
    assert low is not None
    assert high is not None
    assert low < ratio < high
    assert ratio_of(own[::-1], other)[1:] == pytest.approx(ratio_of(own, other)[1:])
    assert ratio_of(own[:1], other[:1]) == (pytest.approx(1.5), None, None)
    assert ratio_of(own, [])[0] is None


def test_an_interval_holds_the_ratio_as_often_as_it_says() -> None:
    """Both modes have errors of one distribution, twelve outages: 1 is inside in about 95 of 100."""
    rng, inside, n = np.random.default_rng(3), 0, 200
    for _ in range(n):
        both = [
            [
                made_run("a", mode, float(np.exp(e)), start_s=float(i))
                for i, e in enumerate(rng.normal(size=12))
            ]
            for mode in ("adaptive", "fixed")
        ]
        _, low, high = ratio_of(*both)
        assert low is not None
        assert high is not None
        inside += low <= 1.0 <= high
    assert inside / n > 0.88


def test_own_mode_is_compared_with_each_baseline_by_ground() -> None:
    runs = [
        made_run("a", "adaptive", 1.0), made_run("a", "fixed", 2.0), made_run("a", "robust", 0.5),
        made_run("b", "adaptive", 3.0, ground="slipping"), made_run("b", "fixed", 3.0, ground="slipping"),
    ]  # fmt: skip
    assert compare_with_baselines(runs) == [
        BaselineComparison("firm", "fixed", 1, pytest.approx(0.5), 1, 0, 0, 0.5),
        BaselineComparison("firm", "robust", 1, pytest.approx(2.0), 0, 1, 0, 2.0),
        BaselineComparison("slipping", "fixed", 1, pytest.approx(1.0), 0, 0, 0, 1.0),
    ]
    sure = [
        made_run("a", mode, e * times, start_s=float(i))
        for mode, times in (("adaptive", 1.2), ("fixed", 1.0))
        for i, e in enumerate((1.0, 2.0, 3.0))
    ]
    assert compare_with_baselines(sure)[0].significantly_worse == 1
    assert "| firm | fixed | 1 | 1.20 | 0 | 1 | 1 | 1.20 |" in markdown([], [], compare_with_baselines(sure))


def test_further_noise_is_drawn_for_made_fixes_alone() -> None:
    tasks = tasks_of(["a"], ["fixed", "robust"], 2, 5, seeds=3)
    assert [(t.mode, t.seed, t.again) for t in tasks] == [
        ("fixed", 5, False), ("robust", 5, False), ("fixed", 6, True), ("robust", 6, True),
        ("fixed", 7, True), ("robust", 7, True),
    ]  # fmt: skip
    assert len({t.key for t in tasks}) == len(tasks)
    with_fixes = simulate("straight", seed=1)
    assert not list(field_table._runs(tasks[2], 0, dataclasses.replace(with_fixes, truth=None)))
    runs = list(field_table._runs(tasks[2], 3, dataclasses.replace(with_fixes, gnss=None)))
    assert {run.test for run in runs if isinstance(run, Run)} == {"aided", "outage 30 s"}
    assert {(run.drive, run.seed) for run in runs if isinstance(run, Run)} == {(3, 6)}


def test_files_hold_all_runs_and_the_refusals(tmp_path: Path) -> None:
    runs = [made_run("a", "adaptive", 1.0), made_run("a", "fixed", 2.0), made_run("c", "fixed", None)]
    text = write(tmp_path, runs, [Refusal("d", "holds 3 pieces"), Refusal("e", "has no wheels")])
    with (tmp_path / "runs.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["error_m"] for row in rows] == ["1.0", "2.0", ""]
    assert text.endswith("- d: holds 3 pieces\n- e: has no wheels\n")
    assert (tmp_path / "field_table.md").read_text(encoding="utf-8") == text
    assert (tmp_path / "field_table.png").stat().st_size > 1000
    assert len(plot_lines(condense(runs)).axes) == 1


def test_tables_have_a_row_a_test_and_a_column_a_mode(tmp_path: Path) -> None:
    runs = [
        made_run("a", "adaptive", 1.0), made_run("a", "fixed", 2.0),
        made_run("a", "robust", 4.0, diverged="x"),
        made_run("c", "adaptive", None, path_ratio=0.5), made_run("c", "fixed", None, path_ratio=0.25),
        made_run("c", "fixed", None, path_ratio=0.25, diverged="y"), made_run("b", "fixed", 3.0),
    ]  # fmt: skip
    rows = write(tmp_path, runs, []).splitlines()
    assert (
        "| a | firm | truth | whole | 1 | 100 | 1.00 | 2.00 | 4.00 | 0.50 (fixed) | 1.00 | robust |" in rows
    )
    assert "| b | firm | truth | whole | 1 | 100 | - | 3.00 | - | - | - | none |" in rows
    assert "| c | firm | 100 | 0.50 | 0.25 | 1.00 | fixed |" in rows


def test_first_modes_are_run_on_all_logs_before_the_others_and_each_log_in_one_piece() -> None:
    tasks = tasks_of(["a", "b"], ["adaptive", "robust", "fixed", "innovation"], 2, 1)
    assert [(t.log, t.mode) for t in tasks] == [
        ("a", "adaptive"), ("a", "fixed"), ("b", "adaptive"), ("b", "fixed"),
        ("a", "robust"), ("a", "innovation"), ("b", "robust"), ("b", "innovation"),
    ]  # fmt: skip
    assert len({t.key for t in [*tasks, Task("a/b", "fixed", 2, 1), Task("a_b", "fixed", 2, 1)]}) == 10
    assert not any("/" in Task(log, "fixed", 1, 1).key for log in ("a/b", "/c", "../d"))


def test_a_stopped_table_goes_on_and_what_it_has_can_be_collected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, modes = ["a", "b"], ["adaptive", "fixed"]
    tasks = tasks_of(logs, modes, 1, 1)
    begun: list[Task] = []

    def fake(task: Task) -> tuple[Task, list[Run | Refusal]]:
        begun.append(task)
        if task.mode == "fixed" and len(begun) == 2:
            raise KeyboardInterrupt
        if task.log == "b":
            return task, [Refusal("b", "has no wheels")]
        # a diverged run: numbers that JSON does not have
        return task, [made_run(task.log, task.mode, 0.1 + 0.2, top_speed_mps=float("nan"))]

    monkeypatch.setattr(field_table, "run_task", fake)
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, tmp_path)
    runs, refusals, missing = collect(tasks, tmp_path)
    assert [(r.log, r.mode) for r in runs] == [("a", "adaptive")]
    assert missing == tasks[1:]
    run_tasks(tasks, tmp_path)
    assert begun == [tasks[0], tasks[1], *tasks[1:]]
    runs, refusals, missing = collect(tasks, tmp_path)
    assert [(r.log, r.mode, r.error_m) for r in runs] == [("a", mode, 0.1 + 0.2) for mode in modes]
    assert np.isnan(runs[0].top_speed_mps)
    assert (refusals, missing) == ([Refusal("b", "has no wheels")], [])
    monkeypatch.setattr(parts, "sources_sha256", lambda: "other")
    assert collect(tasks, tmp_path)[2] == tasks


def test_a_real_log_with_one_outage_and_a_log_that_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = os.environ.get("TERRAFUSION_DATA")
    if not root or not (Path(root) / "umich_husky").is_dir():
        pytest.skip("TERRAFUSION_DATA names no folder with umich_husky: the field logs are not at hand")
    logs = ["umich_husky/mair_mocap/trial7", "umich_husky/mair_mocap/trial2"]
    words = ["--out", str(tmp_path), "--modes", "fixed", "--starts", "1", "--logs", *logs]

    def table(*more: str) -> str:
        monkeypatch.setattr(sys, "argv", ["table", *words, *more])
        assert field_table.main() == 0
        return capsys.readouterr().out

    table()
    with (tmp_path / "runs.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["test"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"whole", "aided", "outage 30 s"}
    assert 0.0 < float(rows["aided"]["error_m"]) < 0.2
    assert all(row["diverged"] == "" and row["log"] == logs[0] for row in rows.values())
    assert 0.0 < float(rows["outage 30 s"]["percent"]) < 20.0
    with (tmp_path / "refused.csv").open(encoding="utf-8", newline="") as file:
        (refused,) = csv.DictReader(file)
    assert refused["log"] == logs[1]
    assert "no wheels" in refused["why"]
    before = (tmp_path / "runs.csv").read_bytes()
    table("--collect")
    assert (tmp_path / "runs.csv").read_bytes() == before
    more = table("--collect", "--modes", "fixed", "robust")
    assert "2 of 4 logs and modes not run yet" in more


@pytest.mark.parametrize(
    ("file", "told"),
    [
        ("/somewhere/on/this/machine/one/wheels.csv", "set/one: wheels.csv, speed: holds NaN; mend it"),
        ("set/one", "set/one: speed: holds NaN; mend it"),
        (None, "set/one: speed: holds NaN; mend it"),
    ],
)
def test_a_refusal_does_not_tell_where_a_log_lies(
    file: str | None, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(log: str) -> list[Recording]:
        raise DataError("holds NaN", file=file, channel="speed", remedy="mend it")

    monkeypatch.setattr(field_runs, "open_recordings", opened)
    _, (refusal,) = run_task(Task("set/one", "fixed", 1, 1))
    assert isinstance(refusal, Refusal)
    assert refusal.line == told
    assert markdown([], [refusal]).endswith(f"- {told}\n")


def test_whole_drives_come_before_outages_and_short_outages_before_long_ones() -> None:
    shuffled = ["outage 120 s", "outage 30 s", "whole", "outage 60 s"]
    assert sorted(shuffled, key=in_order) == ["whole", "outage 30 s", "outage 60 s", "outage 120 s"]


def test_the_command_shares_logs_among_processes(tmp_path: Path) -> None:
    """As a user calls it; the logs are refused at once."""
    logs = [tmp_path / name for name in ("one", "two")]
    for log in logs:
        log.mkdir()
        (log / "wheels.csv").write_text("t_s,left_mps,right_mps\n0.0,0.1,0.1\n0.1,0.1,0.1\n")
    words = ["--out", str(tmp_path / "out"), "--jobs", "2", "--modes", "fixed", "--logs", *map(str, logs)]
    command = [sys.executable, "-m", "tests.studies.field_table.table", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    refused = (tmp_path / "out" / "refused.csv").read_text()
    assert all(str(log) in refused for log in logs)
