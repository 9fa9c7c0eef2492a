"""Habits of all commands: where results go, what is replaced, `--quiet`, `--verbose`, `--json`."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

SHORT = "description: two metres\ndrive:\n  - {duration_s: 4, v_mps: 0.5}\nroute:\n  - {terrain: asphalt}\n"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder with a short scenario. Reports have tests of their own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("terrafusion.fusion.reports.replay.write_report", lambda *_, **__: None)
    (tmp_path / "short.yaml").write_text(SHORT)
    return tmp_path


def test_results_go_to_a_dated_folder_by_default(here: Path, good_log: Path, terrafusion) -> None:
    done = terrafusion("replay", good_log)
    assert (done.status, done.err) == (0, "")
    (folder,) = (here / "terrafusion-out").iterdir()
    assert re.fullmatch(r"replay-log-\d{8}-\d{6}", folder.name)
    assert done.out.splitlines()[-1] == f"written to {Path('terrafusion-out') / folder.name}"
    assert terrafusion("simulate", "short.yaml").status == 0
    assert any(path.name.startswith("simulate-short-") for path in (here / "terrafusion-out").iterdir())


def test_a_wrong_log_is_told_without_an_output(here: Path, terrafusion) -> None:
    assert terrafusion("replay", "gone.bag").refused("gone.bag", "no such file")
    assert terrafusion("calibrate", "gone.bag").refused("gone.bag", "no such file")
    assert terrafusion("gap", "gone.bag").refused("gone.bag", "no such file")
    assert not (here / "terrafusion-out").exists()


def test_what_the_command_did_not_write_is_kept(here: Path, good_log: Path, terrafusion) -> None:
    mine = here / "mine"
    mine.mkdir()
    (mine / "metrics.json").write_text("{}")
    command = ("replay", good_log, "--out", mine)
    assert terrafusion(*command).refused("mine", "metrics.json", "--force")
    assert (mine / "metrics.json").read_text() == "{}"
    assert terrafusion(*command, "--force").status == 0
    assert terrafusion(*command, "--mode", "fixed").status == 0, "a result of its own is replaced"
    (mine / "notes.txt").write_text("do not lose")
    assert terrafusion(*command).refused("mine", "notes.txt", "--force")


def test_a_log_is_only_replaced_by_what_made_it(here: Path, good_log: Path, terrafusion) -> None:
    shutil.copytree(good_log, here / "copy")
    text = (here / "copy" / "meta.yaml").read_text().replace("terrafusion twin", "a robot")
    (here / "copy" / "meta.yaml").write_text(text)
    assert terrafusion("simulate", "short.yaml", "--out", "copy").refused("copy", "--force")
    assert terrafusion("convert", good_log, "copy").refused("copy", "--force")
    assert terrafusion("simulate", "short.yaml", "--out", "log").status == 0
    assert terrafusion("simulate", "short.yaml", "--out", "log").status == 0
    assert terrafusion("convert", good_log, "copy", "--force").status == 0
    assert terrafusion("convert", good_log, "a.mcap").status == 0
    assert terrafusion("convert", good_log, "a.mcap").refused("a.mcap", "exists", "--force")
    assert terrafusion("convert", good_log, "a.mcap", "--force").status == 0


def test_the_configuration_lies_beside_the_results(here: Path, good_log: Path, terrafusion) -> None:
    for out in ("a", "b"):
        words = ("--gnss-outage", "10:5", "--mode", "fixed", "--json")
        assert terrafusion("replay", good_log, "--out", out, *words).status == 0
    text = (here / "a" / "config.json").read_bytes()
    assert text == (here / "b" / "config.json").read_bytes()
    config = json.loads(text)
    assert config["command"] == "replay"
    assert config["command_line"] == f"terrafusion replay {good_log} --gnss-outage 10:5 --mode fixed"
    assert config["options"]["mode"] == "fixed"
    assert config["options"]["batch"] is False, "defaults are in it"
    assert config["vehicle"]["name"] == "elevate"
    assert len(config["vehicle"]["sha256"]) == 64
    assert {"terrafusion", "gtsam", "casadi", "Python"} <= set(config["versions"])
    shutil.rmtree(here / "a")
    assert terrafusion("replay", good_log, "--out", "a", "--vehicle", "husky").status == 0
    other = json.loads((here / "a" / "config.json").read_text())
    assert other["vehicle"]["sha256"] != config["vehicle"]["sha256"]


def test_quiet_is_one_line(here: Path, good_log: Path, terrafusion) -> None:
    done = terrafusion("replay", good_log, "--quiet", "--out", "out")
    assert (done.status, done.err) == (0, "")
    assert re.fullmatch(r"verdict: \w+; written to out\n", done.out)
    gap = terrafusion("gap", good_log, "--effects", "wheel_radius", "--quiet", "--out", "gap")
    assert (gap.status, gap.err, gap.out.count("\n")) == (0, "", 1)
    assert re.fullmatch(r"\S.*[.;] [Ww]ritten to gap\n", gap.out)
    assert terrafusion("replay", "gone.bag", "--quiet").refused("gone.bag")


def test_verbose_tells_the_options_and_where_an_error_arose(here: Path, terrafusion) -> None:
    done = terrafusion("replay", "gone.bag", "--verbose")
    assert "mode = adaptive" in done.err
    assert "Traceback" in done.err
    assert done.err.splitlines()[-1].startswith("error: gone.bag")


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ("replay LOG --out out", "verdict"),
        ("inspect LOG", "channels"),
        ("init LOG --out robot.yaml", "verdict"),
        ("convert LOG out", "samples"),
        ("convert LOG out.mcap --apply-fixes", "findings"),
        ("simulate short.yaml --out out", "summary"),
        ("calibrate LOG --sensors --out robot.yaml", "robot"),
        ("calibrate LOG --terrain asphalt --parameters vehicle.body.mass_kg --out out", "parameters"),
    ],
)
def test_json_is_one_document_on_standard_output(
    words: str, key: str, here: Path, good_log: Path, terrafusion
) -> None:
    done = terrafusion(*words.replace("LOG", str(good_log)).split(), "--json")
    assert done.status == 0, done.err
    document = json.loads(done.out)
    assert key in document
    if words.startswith("replay"):
        assert document == json.loads((here / "out" / "metrics.json").read_text())
        assert done.err.endswith("written to out\n")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("replay LOG --out out", "interrupted; nothing was written"),
        (
            "sweep friction_slope --out out --jobs 1",
            "kept in out; the same command with this --out continues",
        ),
    ],
)
def test_ctrl_c_is_status_130_and_one_line(
    words: str, told: str, here: Path, good_log: Path, terrafusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise ImportError("as a library that is being loaded") from KeyboardInterrupt()

    monkeypatch.setattr("terrafusion.fusion.replay.feed", stopped)
    monkeypatch.setattr("terrafusion.twin.sweep.run.open_workers", stopped)
    done = terrafusion(*words.replace("LOG", str(good_log)).split())
    assert (done.status, done.err.count("\n")) == (130, 1), done
    assert told in done.err


def test_inspect_fails_where_a_finding_is_an_error(here: Path, good_log: Path, terrafusion) -> None:
    assert terrafusion("inspect", good_log).status == 0
    shutil.copytree(good_log, here / "log")
    rows = (here / "log" / "imu.csv").read_text().splitlines()
    column = rows[0].split(",").index("gyro_z_radps")
    cells = [row.split(",") for row in rows[1:]]
    for row in cells:
        row[column] = "1e9"
    (here / "log" / "imu.csv").write_text("\n".join([rows[0], *map(",".join, cells)]) + "\n")
    done = terrafusion("inspect", "log", "--json")
    assert done.status == 1
    assert re.fullmatch(r"findings: \d+ errors?.*\n", done.err)
    assert any(finding["severity"] == "error" for finding in json.loads(done.out)["findings"])
    for _ in range(2):
        assert terrafusion("inspect", "log", "--report", "log.html").out.endswith("report: log.html\n")
    page = (here / "log.html").read_text()
    assert "beyond anything possible" in page
    assert "gyro_z_radps" in page
    assert page.count("beyond anything possible") == 1
    assert re.search(r'class="verdict not_to_be_used">\s*<p><strong>\d+ errors? and', page)
    assert re.fullmatch(r"findings: \d+ errors?.*", terrafusion("inspect", "log", "--quiet").out.strip())
    (here / "mine.html").write_text("mine")
    assert terrafusion("inspect", "log", "--report", "mine.html").refused("mine.html", "exists", "--force")


def test_progress_is_lines_in_a_pipe_where_asked_for(
    here: Path, good_log: Path, terrafusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrafusion.fusion.cli.common.LINE_EVERY_S", 0.0)
    assert terrafusion("replay", good_log, "--out", "a").err == ""
    lines = terrafusion("replay", good_log, "--out", "b", "--verbose").err.splitlines()
    assert any(re.fullmatch(r"adaptive short: \d+%, \d+ s left", line) for line in lines), lines[-3:]
