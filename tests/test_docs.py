"""The examples of the documents run, and what they point at is there."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from terrafusion.datasets.catalog.catalog import load_catalog
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.cli import demo
from terrafusion.fusion.cli.main import app
from terrafusion.twin import simulate as simulation

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])

SLOW = ("terrain train", "terrain eval", "policy fit")
"""Commands that take longer than a test should: only their options are checked."""
FEWER = {"demo": ["--drives", "1", "--jobs", "1"]}
"""Commands that are run with less work than they do by default."""


SHORTER = {"75:60": "28:12", "(75, 60)": "(28, 12)", "60:40": "28:12", "(40, 30)": "(28, 12)"}
"""Outages of the pages, where the drives are cut off."""


def blocks(document: Path) -> Iterator[tuple[int, str, str]]:
    """Line, language and text of the fenced blocks."""
    text = document.read_text(encoding="utf-8")
    for written, here in SHORTER.items():
        text = text.replace(written, here)
    for match in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield text[: match.start()].count("\n") + 2, match[1], match[2]


def run_command(line: str) -> str:
    name, *arguments = shlex.split(line)
    assert name == "terrafusion", line
    if " ".join(arguments[:2]) in SLOW:
        arguments.append("--help")
    arguments += FEWER.get(arguments[0], [])
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, f"{line}\n{result.output}"
    return result.output


def run_python(document: Path, line: int, code: str, session: dict[str, Any]) -> None:
    """Run one block; a traceback shows the document's own line numbers."""
    exec(compile("\n" * (line - 1) + code, str(document), "exec"), session)


def cut_after(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives of the twin are cut off: what a page shows does not hang on how long they are."""
    whole = simulation.simulate_run

    def first_part(*given: Any, **more: Any) -> simulation.SimulatedRun:
        run = whole(*given, **more)
        return dataclasses.replace(run, recording=until(run.recording, seconds))

    monkeypatch.setattr(simulation, "simulate_run", first_part)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None) -> Path:
    """An empty folder to work in. Reports have tests of their own and cost a third of the time: left out."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_readme(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The README shows Python first, on the log that its commands make. The demo has tests of its own: here
    it compares the first 30 s."""
    cut_after(50.0, monkeypatch)
    whole = demo._replayed
    monkeypatch.setattr(demo, "_replayed", lambda log, *of: whole(until(log, 30.0), *of))
    monkeypatch.setattr(demo, "OUTAGE_START_S", 18.0)
    monkeypatch.setattr(demo, "OUTAGE_S", 8.0)
    found = list(blocks(ROOT / "README.md"))
    for _, language, text in found:
        if language == "bash":
            for line in text.splitlines():
                run_command(line)
    session: dict[str, Any] = {"__name__": "readme"}
    for line, language, text in found:
        if language == "python":
            run_python(ROOT / "README.md", line, text, session)
    assert session["result"].scores.ate_m < 5.0
    assert (folder / "out" / "metrics.json").is_file()
    assert session["state"].status in ("running", "outage")
    assert (folder / "results" / "metrics.json").is_file()


def test_tutorial(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One session from top to bottom."""
    cut_after(50.0, monkeypatch)
    document = ROOT / "docs" / "tutorials" / "tutorial.md"
    session: dict[str, Any] = {"__name__": "tutorial"}
    for line, language, text in blocks(document):
        if language == "python":
            run_python(document, line, text, session)
        else:
            for command in text.splitlines():
                run_command(command)
    assert (folder / "adaptive" / "weights.jsonl").stat().st_size > 1_000
    assert (folder / "own-results" / "metrics.json").is_file()
    assert abs(session["state"].slip) < 1.0


def test_a_gap_is_found_and_closed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands of the tutorial end as it says."""
    cut_after(60.0, monkeypatch)
    document = ROOT / "docs" / "tutorials" / "close-a-gap.md"
    printed = [run_command(line) for _, _, text in blocks(document) for line in text.splitlines()]
    assert [text.startswith("Gap caused by wheel_radius (") for text in printed[-2:]] == [True, False]
    assert printed[-1].startswith("No gap: the runs differ no more than the twin's own runs")


@pytest.mark.parametrize(
    "document", [d for d in DOCUMENTS if d.is_relative_to(ROOT / "docs")], ids=lambda d: d.name
)
def test_python_of_the_other_documents(document: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block that a reader sees as Python is run; the tutorial has a test of its own."""
    cut_after(50.0, monkeypatch)
    session: dict[str, Any] = {"__name__": document.stem}
    python = [(line, text) for line, language, text in blocks(document) if language == "python"]
    assert len(python) == document.read_text(encoding="utf-8").count("```python")
    for line, text in python if document.stem != "tutorial" else []:
        run_python(document, line, text, session)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    """Files exist, and so do the headings that are pointed at."""
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text(encoding="utf-8")):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        path = (document.parent / name).resolve() if name else document
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {anchor_of(heading) for heading in headings}, target


def anchor_of(heading: str) -> str:
    """The anchor that a heading gets where Markdown is shown."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_no_document_holds_a_path_of_a_machine(document: Path) -> None:
    found = re.findall(r"(?<![\w.}])/(?:home|mnt|root|tmp|Users|var|work)/\S*", document.read_text("utf-8"))
    assert not found


def test_readme_is_short() -> None:
    """Words without the table of results."""
    before, _, rest = (ROOT / "README.md").read_text(encoding="utf-8").partition("<!-- numbers:start -->")
    table, _, after = rest.partition("<!-- numbers:end -->")
    assert len((before + after).split()) <= 370
    assert 1 <= table.count("\n| ") - 2 <= 8


def test_pages_are_few_words() -> None:
    """All written pages together, without drawings and marks of figures."""
    words = 0
    for page in (ROOT / "docs").rglob("*.md"):
        text = re.sub(r"```mermaid.*?```|<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        words += len(text.split())
    assert words <= 40_000


def test_the_tests_that_a_page_names_exist() -> None:
    named = {
        name
        for page in (ROOT / "docs").rglob("*.md")
        for name in re.findall(r"`(tests/[\w/]+\.py)`", page.read_text(encoding="utf-8"))
    }
    assert len(named) >= 10
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_a_log_on_a_page_is_in_the_catalogue_or_made_there() -> None:
    """So that every command can be typed; logs in other folders have names of days or files."""
    logs = {
        log.split("#")[0]
        for page in DOCUMENTS
        for log in re.findall(r"terrafusion \w+ (\w+/[\w/]+(?:#\d+)?)", page.read_text(encoding="utf-8"))
    }
    known = load_catalog().recordings()
    assert len(logs) >= 5
    assert [log for log in sorted(logs) if not log.startswith("today/") and log not in known] == []


def test_pictures_are_small() -> None:
    pictures = list((ROOT / "docs" / "img").iterdir())
    assert pictures
    for picture in pictures:
        assert picture.suffix == ".png"
        assert picture.stat().st_size < 200_000, picture.name


def test_numbers_stand_between_marks() -> None:
    """Measured figures of the README stand in one place, where they can be made anew."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("<!-- numbers:start -->") == text.count("<!-- numbers:end -->") == 1


def test_log_folder_columns_are_told() -> None:
    """Every column and key the reader knows stands in the conventions."""
    from terrafusion.datasets.readers import channel_tables, log_folder, log_meta

    text = (ROOT / "docs" / "reference" / "conventions.md").read_text(encoding="utf-8")
    columns = [
        *channel_tables.GYRO,
        *channel_tables.ACCEL,
        *channel_tables.GNSS_POSITION,
        *channel_tables.GNSS_HEIGHT,
    ]
    columns += [*channel_tables.GNSS_VELOCITY, *channel_tables.QUATERNION, *channel_tables.TRUTH_TWIST]
    columns += [f"{name}_{unit}" for names, unit in channel_tables.WHEEL_LAYOUTS for name in names]
    for word in [*columns, *(f"{name}.csv" for name in log_folder.CHANNELS), *log_meta.KEYS]:
        assert re.search(rf"\b{re.escape(word)}\b", text), word


def test_formats_and_units_are_told() -> None:
    """Every format, unit and key of the column map stands in the document of formats."""
    from terrafusion.datasets.readers import formats
    from terrafusion.datasets.readers.text import column_map

    text = (ROOT / "docs" / "reference" / "formats.md").read_text(encoding="utf-8")
    words = [form.name for form in formats.FORMATS] + [
        unit for known in column_map.UNITS.values() for unit in known
    ]
    words += [*column_map.TIME_UNITS, *column_map.EPOCHS, *filter(None, column_map.FIX_CODES)]
    for word in words:
        assert f"`{word}`" in text, word
