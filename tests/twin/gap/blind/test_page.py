"""`terrafusion gap-blind`: its files, its words, its errors. The diagnosis itself is a stand-in here."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from terrafusion.fusion.reports.blind import draw, summary, write_blind
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.twin.gap.blind.plan import FULL, CheckSize, plan
from terrafusion.twin.gap.blind.score import score
from tests.fusion.reports.browser import assert_drawn
from tests.twin.gap.blind import blind_answers as fake


def test_the_page_tells_every_score(tmp_path: Path) -> None:
    """Both methods, settings and verdicts of a full check; figures are inside; nothing points outside."""
    trials = plan(0, FULL)
    answers = {
        t.trial: {
            name: {"seconds": 1.0, "error": None, "answer": content(t)}
            for name, content in (("diagnosis", fake.perfect), ("opponent", fake.guessed))
        }
        for t in trials
    }
    scores = score(trials, answers, methods=("diagnosis", "opponent"))
    write_blind(tmp_path, scores, {"command": "terrafusion gap-blind"})
    page = (tmp_path / "report.html").read_text()
    for words in (
        f"{len(trials)} trials",
        "false alarms",
        "targets are met, 0 missed",
        "Confusion",
        "wrong soil label",
        "opponent",
    ):
        assert words in page
    assert page.count('class="tile"') == 3
    assert re.findall(r'id="plot-(\w+)"', page) == ["power", "alarms", "named", "confidence", "confusion"]
    assert_drawn(tmp_path / "report.html")
    told = summary(scores)
    assert any(
        "false alarms, same drives" in line and "0 of 200" in line and "200 of 200" in line for line in told
    )
    assert sum(line.endswith("met") for line in told) >= 12
    sheet = Sheet()
    draw(sheet, scores)
    assert set(sheet.panels["power"].legend) == {"diagnosis", "opponent"}
    assert "0 of 200 (0.00 to 0.02)" in sheet.json()


def test_the_page_of_a_check_without_answers(tmp_path: Path) -> None:
    """Nothing detected, nothing to rank: every panel stands, no number is made up."""
    tiny = CheckSize(nulls=0, other_nulls=0, effects=1, other_effects=0, harder=0, outside=0, pairs=0)
    scores = score(plan(0, tiny), {})
    write_blind(tmp_path, scores)
    assert "not measured" in (tmp_path / "report.html").read_text()
    stored = json.loads(json.dumps(scores, allow_nan=False))
    assert stored["figures"]["diagnosis"]["unknown"]["recall"]["rate"] is None


def test_the_command_writes_and_continues(
    terrafusion: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = CheckSize(nulls=1, other_nulls=0, effects=0, other_effects=0, harder=0, outside=0, pairs=0)
    monkeypatch.setattr("terrafusion.twin.gap.blind.plan.QUICK", tiny)
    monkeypatch.setattr("terrafusion.twin.gap.diagnose", fake.guess)
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)
    out = tmp_path / "out"
    for _ in range(2):
        done = terrafusion("gap-blind", "--quick", "--out", out)
        assert done.status == 0, done.err
        assert "false alarms" in done.out
        assert done.err == ""
    scores = json.loads((out / "blind.json").read_text())
    assert scores["schema"] == "terrafusion.gap-blind/2"
    assert scores["trials"] == 1
    assert list(scores["figures"]) == ["diagnosis", "opponent"]
    assert terrafusion("gap-blind", "--quick", "--seed", 9, "--out", out).refused("another seed")


def test_a_share_is_of_the_full_check(
    terrafusion: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("terrafusion.twin.gap.diagnose", fake.guess)
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)
    done = terrafusion("gap-blind", "--share", 0.01, "--no-opponent", "--out", tmp_path)
    assert done.status == 0, done.err
    assert json.loads((tmp_path / "blind.json").read_text())["trials"] == len(plan(0, FULL.part(0.01)))
    for wrong in (["--share", 0.5, "--quick"], ["--share", 0], ["--backend", "dask"], ["--backend", "slurm"]):
        assert terrafusion("gap-blind", *wrong, "--out", tmp_path / "b").status == 2
    assert not (tmp_path / "b").exists()
