"""A small benchmark from end to end: files, resumption, the command."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from terrafusion.datasets.core.errors import ConfigError, TerrafusionError
from terrafusion.fusion.benchmark import checkpoints as parts
from terrafusion.fusion.benchmark import field_logs, plan, run
from terrafusion.fusion.benchmark.field_logs import FieldLog, Refusal
from terrafusion.fusion.benchmark.methods import METHODS
from terrafusion.fusion.benchmark.plan import BenchmarkPlan, Job, families_of
from terrafusion.fusion.benchmark.run import BenchmarkResult, run_benchmark
from terrafusion.fusion.benchmark.run_score import RunScore
from terrafusion.fusion.benchmark.twin_runs import FIRST_SEED, BenchmarkCase
from terrafusion.fusion.reports import benchmark as outputs
from terrafusion.fusion.reports.benchmark import MARK, write_benchmark, write_document
from tests.fusion.reports.browser import assert_drawn

FEW = ("fixed", "adaptive", "oracle")
JOB = Job(BenchmarkCase("outages", "twin", FIRST_SEED + 2), FEW)
PLAN = BenchmarkPlan({"outages": None}, seeds=1)
ORIGIN = {"command": "terrafusion benchmark"}


@pytest.fixture
def one_job(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every plan is one drive of 75 s with three arms."""
    monkeypatch.setattr(BenchmarkPlan, "jobs", lambda self: [JOB])


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BenchmarkResult]:
    out = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BenchmarkPlan, "jobs", lambda self: [JOB])
        return out, run_benchmark(PLAN, out)


def test_every_arm_gives_a_row_with_its_grounds(found) -> None:
    rows = found[1].rows
    assert [row.method for row in rows] == list(FEW)
    for row in rows:
        assert row.failed == row.diverged == ""
        assert row.error_m is not None
        assert 0.0 < row.error_m < 20.0
        assert sum(g.seconds for g in row.grounds) == pytest.approx(row.outage_s, abs=0.5)
    oracle = rows[2]
    assert min(g.recognised for g in oracle.grounds if g.seconds > 5.0) > 0.8


def test_finished_jobs_are_not_run_again(found, one_job, monkeypatch) -> None:
    out, before = found
    monkeypatch.setattr(run, "run_job", lambda job: pytest.fail("it ran again"))
    assert run_benchmark(PLAN, out) == before


def test_results_of_other_sources_are_not_taken(found, one_job, monkeypatch) -> None:
    monkeypatch.setattr(parts, "sources_sha256", lambda: "other")
    monkeypatch.setattr(
        run, "run_job", lambda job: (job, BenchmarkResult((RunScore("a", "b", "c", "d", "e"),), ()))
    )
    assert run_benchmark(PLAN, found[0]).rows[0].family == "a"


def test_jobs_whose_parts_another_process_overwrites_meanwhile_are_not_lost(tmp_path, monkeypatch) -> None:
    jobs = [Job(BenchmarkCase("mixed", "twin", FIRST_SEED + i), FEW) for i in range(3)]

    def job(one: Job) -> tuple[Job, BenchmarkResult]:
        for file in (tmp_path / parts.FOLDER).glob("*"):
            file.write_text(json.dumps({"sources_sha256": "of other sources", "state": ""}))
        return one, BenchmarkResult((RunScore("mixed", "twin", one.key, one.key, "fixed", error_m=1.0),), ())

    monkeypatch.setattr(BenchmarkPlan, "jobs", lambda self: jobs)
    monkeypatch.setattr(run, "run_job", job)
    assert [row.unit for row in run_benchmark(BenchmarkPlan({"mixed": 3}), tmp_path).rows] == [
        one.key for one in jobs
    ]


def test_logs_are_run_again_once_their_files_differ_or_where_they_were_refused(tmp_path, monkeypatch) -> None:
    log = tmp_path / "log"
    log.mkdir()
    wheels = log / "wheels.csv"
    wheels.write_text("t_ns\n")
    begun: list[Job] = []
    given: list[tuple[tuple[RunScore, ...], tuple[Refusal, ...]]] = []

    def job(one: Job) -> tuple[Job, BenchmarkResult]:
        begun.append(one)
        return one, BenchmarkResult(*given[-1])

    monkeypatch.setattr(BenchmarkPlan, "jobs", lambda self: [Job(FieldLog(str(log)), ("fixed",))])
    monkeypatch.setattr(run, "run_job", job)
    row = RunScore("field", "firm", "log", "log", "fixed", error_m=1.0)
    for rows, refused, runs in (
        ((), (Refusal("log", "no IMU"),), 1), ((row,), (), 2), ((row,), (), 2),
    ):  # fmt: skip
        given.append((rows, refused))
        assert run_benchmark(PLAN, tmp_path / "out") == BenchmarkResult(rows, refused)
        assert len(begun) == runs
    wheels.write_text("t_ns\n0\n")
    run_benchmark(PLAN, tmp_path / "out")
    assert len(begun) == 3
    (part,) = (tmp_path / "out" / parts.FOLDER).iterdir()
    cut = json.loads(part.read_text())
    del cut["refused"]
    part.write_text(json.dumps(cut))
    run_benchmark(PLAN, tmp_path / "out")
    assert len(begun) == 4


@pytest.mark.parametrize("place", [(field_logs, "open_recordings"), (field_logs, "check_log")])
def test_an_unforeseen_error_in_a_log_becomes_a_refusal(place, monkeypatch) -> None:
    def fail(what: object) -> None:
        raise ValueError("from a reader or planner")

    field_logs.opened.cache_clear()
    monkeypatch.setattr(field_logs, "open_recordings", lambda log: [SimpleNamespace(duration_s=lambda: 20.0)])
    monkeypatch.setattr(*place, fail)
    _, found = run.run_job(Job(FieldLog("one"), ("fixed",)))
    assert found == BenchmarkResult((), (Refusal("one", "FAILED, ValueError: from a reader or planner"),))
    field_logs.opened.cache_clear()


def test_what_cannot_be_written_is_refused_before_anything_is_computed(
    terrafusion, one_job, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(run, "run_job", lambda job: pytest.fail("it ran"))
    taken = tmp_path / "file"
    taken.write_text("")
    assert terrafusion("benchmark", "--out", taken, "--jobs", 1).refused("cannot be written")
    words = ("benchmark", "--out", tmp_path / "out", "--jobs", 1)
    assert terrafusion(*words, "--docs", taken).refused("no document with a place")
    assert terrafusion(*words, "--only", "field=5").refused("field logs have no seeds")


def test_the_commit_is_that_of_this_library_and_of_no_folder_above_it(tmp_path, monkeypatch) -> None:
    def git(*words: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True)

    module = tmp_path / "site-packages" / "outputs.py"
    module.parent.mkdir()
    module.write_text("")
    monkeypatch.setattr(outputs, "__file__", str(module))
    assert outputs.commit() == ""
    git("init")
    git("commit", "--allow-empty", "-m", "somebody's project")
    assert outputs.commit() == ""
    git("add", "site-packages")
    git("commit", "-m", "this library")
    assert len(outputs.commit()) == 12
    module.write_text("# changed")
    assert outputs.commit().endswith("-dirty")


def test_sources_that_change_while_it_runs_are_told(monkeypatch) -> None:
    origin = outputs.origin_of(PLAN, "terrafusion benchmark")
    assert outputs.at_the_end(origin) == origin
    monkeypatch.setattr(outputs, "hash_sources", lambda: "other")
    assert outputs.at_the_end(origin)["sources"] == f"{origin['sources']}, changed while it ran"


def test_versions_are_among_the_sources(monkeypatch) -> None:
    before = parts.hash_sources()
    assert before == parts.hash_sources()
    monkeypatch.setattr(parts.metadata, "version", lambda name: "0")
    assert parts.hash_sources() != before


def test_the_files_hold_the_same_numbers(found, tmp_path) -> None:
    made = write_benchmark(tmp_path, found[1], ORIGIN)
    content = json.loads((tmp_path / "benchmark.json").read_text())
    assert content["schema"] == outputs.SCHEMA
    assert [row["arm"] for row in content["rows"]] == list(FEW)
    assert {"arm", "base", "base_m"} <= content["contrasts"][0].keys()
    assert not {"method", "baseline", "baseline_m"} & content["contrasts"][0].keys()
    assert content["origin"]["command"] == "terrafusion benchmark"
    text = (tmp_path / "benchmark.md").read_text()
    for cells in made[0].rows:
        assert " | ".join(cells) in text
    page = (tmp_path / "report.html").read_text()
    assert "targets are reached" in page
    assert page.count('id="plot-') == 1
    assert_drawn(tmp_path / "report.html")
    again = tmp_path / "again"
    write_benchmark(again, found[1], ORIGIN)
    for name in ("benchmark.json", "benchmark.md", "report.html"):
        assert (again / name).read_bytes() == (tmp_path / name).read_bytes()


def test_a_document_keeps_what_stands_before_the_mark(found, tmp_path) -> None:
    document = tmp_path / "page.md"
    document.write_text(f"# Head\n{MARK}\nold\n")
    made = write_benchmark(tmp_path / "out", found[1], ORIGIN)
    write_document(document, made, found[1], ORIGIN)
    text = document.read_text()
    assert text.startswith(f"# Head\n{MARK}\n\n## Errors\n")
    assert "old" not in text
    with pytest.raises(ConfigError, match="no document with a place"):
        write_document(tmp_path / "absent.md", made, found[1], ORIGIN)


def test_plans() -> None:
    quick = BenchmarkPlan(families_of(["firm", "mixed"]), quick=True).jobs()
    assert [(job.item.family, job.item.plant) for job in quick] == [
        ("mixed", "twin"), ("mixed", "perturbed"), ("mixed", "second"), ("firm", "twin"),
        ("mixed", "twin"), ("mixed", "perturbed"), ("mixed", "second"),
    ]  # fmt: skip
    full = BenchmarkPlan({"mixed": None, "firm": None}, seeds=3).jobs()
    assert len({job.key for job in full}) == len(full) == 2 * 3 * 3
    assert {job.methods for job in full} == {tuple(method.name for method in METHODS)}
    with pytest.raises(ConfigError, match="0 seeds"):
        BenchmarkPlan({"mixed": None}, seeds=0)
    with pytest.raises(ConfigError, match="field logs have no seeds"):
        BenchmarkPlan({"field": None}, seeds=3)
    assert outputs.origin_of(BenchmarkPlan({"mixed": 7, "field": None}), "")["seeds"] == "mixed 7"


def test_families_by_name_with_seeds_of_their_own() -> None:
    assert list(families_of([])) == ["mixed", "slopes", "outages", "firm", "unseen", "field"]
    assert families_of(["field", "mixed=7"]) == {"mixed": 7, "field": None}
    assert BenchmarkPlan(families_of(["mixed=7", "firm"]), seeds=3).seed_count("mixed") == 7
    with pytest.raises(ConfigError, match="unknown family 'mixd'"):
        families_of(["mixd"])
    with pytest.raises(ConfigError, match="'mixed=all' has no number of seeds"):
        families_of(["mixed=all"])


def test_field_alone_without_logs_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(plan, "present_logs", list)
    with pytest.raises(TerrafusionError, match="no field log is present"):
        run_benchmark(BenchmarkPlan({"field": None}), tmp_path)


def test_the_command(terrafusion, found, one_job, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(run, "run_job", lambda job: (job, found[1]))
    done = terrafusion("benchmark", "--out", tmp_path / "out", "--only", "outages", "--jobs", 1)
    assert done.status == 0, done.err
    assert "## Errors" in done.out
    assert "outages, twin" in done.out
    assert terrafusion("benchmark", "--out", tmp_path / "other", "--only", "nothing").refused(
        "unknown family 'nothing'"
    )
