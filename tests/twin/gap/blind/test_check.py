"""A blind check from plan to scores: resumed, out of time, with a diagnosis that breaks."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.answers import answered
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.plan import (
    PLAIN,
    CheckSize,
    plan,
)
from tests.twin.gap.blind import blind_answers as fake

TINY = CheckSize(nulls=1, other_nulls=0, effects=1, other_effects=0, harder=0, outside=0, pairs=1)


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what happens around the diagnosis."""
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)


@pytest.mark.usefixtures("quickly")
def test_the_oracle_is_asked_where_a_share_was_told(tmp_path: Path) -> None:
    """It is given the true effects; its shares stand beside those of the same trials."""
    asked = []

    def tells(runs: Any, references: Any, vehicle: Any, *, seed: int, effects: Any = None) -> fake.Fixed:
        answer = fake.diagnosis("effect", [("mass", 0.9)], ["mass"])
        if effects is not None:
            asked.append(effects)
        return fake.Fixed(answer | {"shrink": {"share": 0.5 if effects is None else 0.8}})

    scores = run_blind_check(tmp_path, tells, scale=TINY, seed=1, oracle=tells)
    single = [t.effects() for t in plan(1, TINY) if t.family in ("same", "shifted")]
    assert sorted(asked) == sorted(single)
    found = scores["figures"]["diagnosis"]["shrink"]
    assert (found["mean"], found["oracle"]) == pytest.approx((0.5, 0.8))
    assert found["over_oracle"] == pytest.approx(0.625)


@pytest.mark.usefixtures("quickly")
def test_a_diagnosis_that_breaks_is_wrong_everywhere(tmp_path: Path) -> None:
    """And leaves the opponent, which answers the same trials, as it is."""
    scores = run_blind_check(tmp_path, fake.breaking, opponent=fake.guess, scale=TINY, seed=1)
    broken, other = scores["figures"]["diagnosis"], scores["figures"]["opponent"]
    assert len(broken["crashes"]) == scores["trials"] == len(plan(1, TINY))
    assert broken["false_alarms"][PLAIN]["rate"] == 1.0
    assert all(cell["rate"] == 0.0 for cell in broken["power_all"].values())
    assert broken["pairs"]["both_of_all"]["rate"] == 0.0
    assert all("LinAlgError" in entry["diagnosis"]["error"] for entry in answered(tmp_path).values())
    assert json.loads((tmp_path / "blind.json").read_text()) == scores
    assert other["crashes"] == []
    assert other["power_all"]["25"]["rate"] == 1.0


@pytest.mark.usefixtures("quickly")
def test_a_check_resumes_where_it_was_stopped(tmp_path: Path) -> None:
    """Answers that are there are kept; another seed is refused."""
    whole = run_blind_check(tmp_path / "whole", fake.guess, scale=TINY, seed=2)

    def stops(*arguments: Any, **more: Any) -> Any:
        stops.calls += 1  # type: ignore[attr-defined]
        if stops.calls > 3:  # type: ignore[attr-defined]
            raise KeyboardInterrupt
        return fake.guess(*arguments, **more)

    stops.calls = 0  # type: ignore[attr-defined]
    with pytest.raises(KeyboardInterrupt):
        run_blind_check(tmp_path / "cut", stops, scale=TINY, seed=2)
    assert len(answered(tmp_path / "cut")) == 3
    with pytest.raises(ConfigError, match="another seed or size"):
        run_blind_check(tmp_path / "cut", fake.guess, scale=TINY, seed=3)
    resumed = run_blind_check(tmp_path / "cut", fake.guess, scale=TINY, seed=2)
    assert fake.without_times(resumed) == fake.without_times(whole)


@pytest.mark.usefixtures("quickly")
def test_a_check_that_runs_out_of_time_scores_what_is_answered(tmp_path: Path) -> None:
    """A prefix of the random order; no trial that was not asked counts as a crash."""
    scores = run_blind_check(tmp_path, fake.guess, scale=TINY, seed=2, minutes=0.0)
    assert (scores["trials"], scores["planned"]) == (1, len(plan(2, TINY)))
    assert scores["figures"]["diagnosis"]["crashes"] == []
    assert list(answered(tmp_path)) == ["trial-0001"]
    again = run_blind_check(tmp_path, fake.guess, scale=TINY, seed=2)
    assert again == scores  # the labels are open: nothing is answered any more


@pytest.mark.usefixtures("quickly")
def test_a_full_disk_is_one_line_and_leaves_no_half_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Path.write_text

    def full(path: Path, data: str, **more: Any) -> int:
        if path.name.startswith(".trial-0002"):
            whole(path, data[:5])
            raise OSError(errno.ENOSPC, "No space left on device")
        return whole(path, data, **more)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(DataError, match=r"cannot be written: No space left"):
        run_blind_check(tmp_path, fake.guess, scale=TINY, seed=2)
    assert [path.name for path in (tmp_path / seal.ANSWERS).iterdir()] == ["trial-0001.json"]
