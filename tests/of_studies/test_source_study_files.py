"""The files of the reproduced source study, and the stored result made from it."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fusion.reports.browser import assert_drawn
from tests.studies.__main__ import first
from tests.studies.registry import STUDIES
from tests.studies.source_study import command
from tests.studies.source_study import study as study_module
from tests.studies.source_study.batch import BatchCell, slip_cells
from tests.studies.source_study.claims import AGREE, NOT_EXAMINED, VERDICTS, load_claims
from tests.studies.source_study.published import CASES, FRICTION
from tests.studies.source_study.text import COLUMNS

DOCUMENT = Path(__file__).parents[1] / "studies" / "results" / "source_study.md"
FIXED = {"source", "statement", "quantity", "study", "criterion", "basis"}
"""Columns of the table that no run changes."""


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """The folder of a study with one seed and nine cells, and what was printed."""
    cells = [
        BatchCell(terrain, mu, slope)
        for terrain, ends in FRICTION.items()
        for mu, slope in ((ends[0], 5.0), (ends[1], 0.0), (ends[1], 5.0))
    ]
    heavy = BatchCell("medium_sand", 1.0, 0.0, 60.0)
    folder = tmp_path_factory.mktemp("study") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_module, "grid", lambda quick: (*cells, heavy))
        patch.setattr(study_module, "slip_cells", lambda quick: slip_cells(quick=True))
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            assert command.main(["--out", str(folder), "--quick", "--seeds", "1"]) == 0
    return folder, printed.getvalue()


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "agreement.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def documented() -> list[dict[str, str]]:
    """The table of agreement in the stored result."""
    lines = DOCUMENT.read_text(encoding="utf-8").splitlines()
    head = f"| {' | '.join(COLUMNS)} |"
    table = lines[lines.index(head) + 2 :]
    rows = []
    for line in table:
        if not line.startswith("|"):
            break
        cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        rows.append(dict(zip(COLUMNS, cells, strict=True)))
    return rows


def test_its_files(reproduced: tuple[Path, str]) -> None:
    folder, out = reproduced
    names = {"agreement.csv", "metrics.json", "batch.csv", "report.html"}
    assert {path.name for path in folder.iterdir()} == names
    for case in CASES:
        assert case.label in out
    assert json.loads((folder / "metrics.json").read_text())["seeds"] == 1


def test_every_claim_is_judged(reproduced: tuple[Path, str]) -> None:
    folder, _ = reproduced
    rows, claims = rows_of(folder), load_claims()
    assert [row["statement"] for row in rows] == [claim.statement for claim in claims]
    assert {row["verdict"] for row in rows} <= set(VERDICTS)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["schema"] == "terrafusion.study/1"
    assert sum(metrics["agreement"].values()) == len(rows)
    for claim in claims:
        assert claim.measure in metrics["measured"]
    for verdict, count in metrics["agreement"].items():
        assert count == sum(row["verdict"] == verdict for row in rows)


def test_the_batch_is_told_run_by_run(reproduced: tuple[Path, str]) -> None:
    folder, _ = reproduced
    with (folder / "batch.csv").open(encoding="utf-8", newline="") as file:
        runs = list(csv.DictReader(file))
    assert len(runs) == 10 + 3
    medium = [run for run in runs if run["terrain"] == "medium_sand"]
    assert all(run["mobile"] == "True" and float(run["energy_per_m_j"]) > 0.0 for run in medium)
    assert all(run["energy_per_m_j"] == "" for run in runs if run["mobile"] == "False")


def test_the_report_is_one_file_with_all_figures(reproduced: tuple[Path, str]) -> None:
    folder, _ = reproduced
    page = (folder / "report.html").read_text(encoding="utf-8")
    for number in (4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15):
        assert f"Fig. {number}. " in page
    assert re.search(r"<strong>Of \d+ statements and numbers \d+ agree", page)
    assert page.count('id="plot-') == page.count("<figure>") == 28
    assert_drawn(folder / "report.html")
    assert not re.search(r"\bnan\b", page[: page.index('id="plots"')])


def test_the_document_is_what_the_command_writes(reproduced: tuple[Path, str]) -> None:
    """Wording and criteria are those of the code; verdicts and numbers were made by the full command."""
    folder, _ = reproduced
    told, made = documented(), rows_of(folder)
    assert [{key: row[key] for key in FIXED} for row in told] == [
        {key: row[key] for key in FIXED} for row in made
    ]


def test_the_document_gives_a_reason_for_what_does_not_agree() -> None:
    for row in documented():
        assert row["why"], row
        assert row["why"] != NOT_EXAMINED, row


def test_the_numbers_of_the_document_still_hold(reproduced: tuple[Path, str]) -> None:
    """What does not depend on chance: the twin has not moved away since the document was made."""
    folder, _ = reproduced
    told, made = documented(), rows_of(folder)
    checked = 0
    for old, new in zip(told, made, strict=True):
        sure = "± 0.0" in old["twin"] and "GNSS" not in old["statement"]
        if sure and old["source"] in ("Tab. 4", "Fig. 4", "Fig. 5"):
            before, after = (float(row["twin"].split()[0]) for row in (old, new))
            assert after == pytest.approx(before, rel=0.1, abs=0.3), old
            assert (old["verdict"] == AGREE) == (new["verdict"] == AGREE), old
            checked += 1
    assert checked >= 10


def test_the_registry_reads_every_quoted_figure(reproduced: tuple[Path, str]) -> None:
    (study,) = (one for one in STUDIES if one.name == "source_study")
    stored = json.loads(DOCUMENT.with_suffix(".json").read_text(encoding="utf-8"))["figures"]
    assert study.figures.keys() == stored.keys()
    for name, pattern in study.figures.items():
        found = first(pattern, reproduced[1])
        assert found is not None, name
        assert found.count("|") == stored[name].count("|")
