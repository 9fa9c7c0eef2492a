"""What README and docs quote is what the studies found."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from tests.studies.figures import QUOTED, differences, documents, rewritten
from tests.studies.registry import STUDIES
from tests.studies.study import Study

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "tests" / "studies" / "results"


@pytest.mark.parametrize("document", documents(ROOT), ids=lambda p: p.name)
def test_quoted_figures_are_those_of_the_results(document: Path) -> None:
    assert differences(document.read_text(encoding="utf-8"), RESULTS) == []


def test_the_readme_quotes_results() -> None:
    assert len(QUOTED.findall((ROOT / "README.md").read_text(encoding="utf-8"))) >= 5


@pytest.mark.parametrize("study", STUDIES, ids=lambda s: s.name)
def test_every_study_has_a_program(study: Study) -> None:
    if study.command[0] == "-m":
        assert importlib.util.find_spec(study.command[1]) is not None
    elif study.command[0] != "terrafusion":
        assert (ROOT / study.command[0]).is_file()


def test_every_result_is_of_a_study_and_whole() -> None:
    names = {study.name for study in STUDIES}
    for file in RESULTS.glob("*.json"):
        result = json.loads(file.read_text(encoding="utf-8"))
        assert result["study"] == file.stem
        assert file.stem in names
        assert file.with_suffix(".md").is_file()


def test_a_wrong_figure_is_found_and_put_right(tmp_path: Path) -> None:
    (tmp_path / "mass.json").write_text('{"figures": {"kg": "32.0"}}')
    text = "It has <!-- mass:kg -->31.0<!-- / --> kg and <!-- mass:lb -->70<!-- / --> lb."
    wrong, missing = differences(text, tmp_path)
    assert "quoted as 31.0, its result is 32.0" in wrong
    assert "no result" in missing
    assert differences(rewritten(text, tmp_path), tmp_path) == [missing]
