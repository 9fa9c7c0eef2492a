"""`terrafusion gap` from log folders to its two files."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import jsonschema
import pytest

from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.reports.gap_text import effect_words
from tests.fusion.reports.browser import assert_drawn
from tests.twin.gap.runs import runs

SCHEMA = json.loads((Path(__file__).parents[3] / "docs/schemas/diagnosis.schema.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gap")
    for recording in [*runs(100, 6), *runs(300, 2, {"wheel_radius/scale": 0.04})]:
        write_log_folder(recording, folder / recording.name)
    return folder


def test_gap_writes_answer_report_and_corrected_vehicle(
    logs: Path, tmp_path: Path, terrafusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules["terrafusion.twin.gap.diagnose"]
    diagnose, found = module.diagnose, []

    def kept(*given, **more):
        found.append(diagnose(*given, **more))
        return found[0]

    monkeypatch.setattr(module, "diagnose", kept)
    arguments = ["gap", str(logs / "run300"), str(logs / "run301"), "--out", str(tmp_path / "out")]
    arguments += ["--effects", "wheel_radius,grousers,mass"]
    for i in range(6):
        arguments += ["--reference", str(logs / f"run{100 + i}")]
    done = terrafusion(*arguments, "--write-vehicle", str(tmp_path / "corrected.yaml"))
    assert done.status == 0, done.err
    answer = json.loads((tmp_path / "out/diagnosis.json").read_text("utf-8"))
    jsonschema.validate(answer, SCHEMA)
    assert answer["named"] == ["wheel_radius"]
    assert answer["runs"] == [str(logs / "run300"), str(logs / "run301")]
    assert answer["reference_runs"] == [str(logs / f"run{100 + i}") for i in range(6)]
    page = (tmp_path / "out/report.html").read_text("utf-8")
    assert page.index("<strong>Gap caused by wheel_radius or grousers (") < page.index("<h2>")
    assert "The references cover over 99 % of the time of these drives." in page
    assert re.search(r"<th>wheel_radius or grousers, .*</th>\s*<td class=\"n\">\d\d %</td><td>yes</td>", page)
    assert re.search(r'<td class="n">[0-9.]+ m</td>', page)
    cells = re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", page)
    assert max(cell.count(",") for cell in cells) < 5
    keys = re.findall(r'id="plot-(\w+)"', page)
    assert keys[:5] == ["path0", "path1", "where", "causes", "shrink"]
    assert {key.split("_")[0] for key in keys[5:]} == {"error0", "error1"}
    assert page.count('class="tile"') == 3
    assert_drawn(tmp_path / "out" / "report.html")
    assert "Before and after" in page
    lines = done.out.splitlines()
    assert lines[0].startswith("Gap caused by wheel_radius or grousers (")
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 100
    titles = [line.split()[0] for line in lines[1:] if not line.startswith(" ")]
    sections = ["Where", "Which", "Shrinks", "Next", "Load", "Runs", "Details"]
    assert [t for t in titles if t[0].isupper()] == sections
    assert "run103 and 2 more" in " ".join(done.out.split())
    assert re.search(r" while .*: [0-9.]+ m \([0-9.]+ sigma\), references", done.out), done.out
    assert "Push the robot ten turns" in " ".join(done.out.split())
    assert f"--vehicle {tmp_path / 'corrected.yaml'}" in " ".join(done.out.split())
    assert "wheel.radius_m" not in done.out
    monkeypatch.setattr(module, "diagnose", lambda *_, **__: found[0])  # the same words in full
    verbose = terrafusion(*arguments, "--write-vehicle", str(tmp_path / "corrected.yaml"), "--verbose")
    assert "wheel.radius_m" in verbose.out
    assert "cause: mass" in verbose.out
    assert "of what the best do" in verbose.out
    assert (tmp_path / "corrected.yaml").is_file()
    nothing = dataclasses.replace(found[0].verdict, kind="no_gap", named=())
    found[0] = dataclasses.replace(found[0], verdict=nothing)
    unwritten = terrafusion(*arguments, "--write-vehicle", str(tmp_path / "other.yaml"))
    assert f"No effect was named, so {tmp_path / 'other.yaml'} was not written." in unwritten.out
    assert not (tmp_path / "other.yaml").exists()


def test_every_effect_has_one_sentence_what_it_is_and_one_how_to_check_it() -> None:
    words = effect_words()
    assert set(words) >= {"wheel_radius", "encoder_dropout", "torque_limit"}
    for name, sentences in words.items():
        assert len(sentences) == 2, name
        assert all(s.endswith(".") for s in sentences), name


def test_gap_explains_an_effect(terrafusion) -> None:
    done = terrafusion("gap", "--explain", "dead_time")
    assert done.status == 0, done.err
    assert "check:" in done.out
    assert "dead_time/transport" in done.out
    assert terrafusion("gap", "--explain", "dead_tim").refused("unknown effect 'dead_tim'", "dead_time")


def test_gap_refuses_an_unknown_effect_in_one_line(logs: Path, tmp_path: Path, terrafusion) -> None:
    done = terrafusion(
        "gap", str(logs / "run300"), "--effects", "wheels_fell_off", "--out", str(tmp_path / "o")
    )
    assert done.status == 1
    assert done.err.count("\n") == 1
    assert "wheels_fell_off" in done.err


@pytest.mark.parametrize("option", ["--out", "--write-vehicle"])
def test_what_cannot_be_written_is_refused_before_anything_is_computed(
    logs: Path, tmp_path: Path, terrafusion, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    monkeypatch.setattr(
        sys.modules["terrafusion.twin.gap.diagnose"], "diagnose", lambda *_, **__: pytest.fail("computed")
    )
    taken = tmp_path / "taken"
    taken.write_text("mine")
    targets = {"--out": tmp_path / "out", option: taken if option == "--out" else taken / "vehicle.yaml"}
    words = [str(word) for pair in targets.items() for word in pair]
    done = terrafusion("gap", str(logs / "run300"), *words)
    assert done.refused("cannot be written", "taken")
    assert taken.read_text() == "mine"
    assert not (tmp_path / "out").exists()


def test_the_blind_check_refuses_a_file_for_a_folder(tmp_path: Path, terrafusion) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    done = terrafusion("gap-blind", "--quick", "--out", str(taken))
    assert done.status == 1
    assert done.err.startswith("error: ")
    assert "cannot be written" in done.err
    assert taken.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (("--input", "bogus"), 1, "unknown input 'bogus'"),
        (("--effects", ","), 1, "no effect is named"),
        (("--seed", "-1"), 2, "--seed"),
    ],
)
def test_gap_refuses_what_it_cannot_mean(
    logs: Path, tmp_path: Path, terrafusion, words: tuple[str, ...], status: int, told: str
) -> None:
    done = terrafusion("gap", str(logs / "run300"), *words, "--out", str(tmp_path / "out"))
    assert done.status == status
    assert told in done.err
    assert not (tmp_path / "out").exists()
