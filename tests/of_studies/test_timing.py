"""What is timed are the trials asked for, each with the site's references."""

from __future__ import annotations

import time

import pytest

from terrafusion.twin.gap.blind.plant import run as plant
from tests.studies.blind.development import RUNS, specs
from tests.studies.blind.timing import timed, trials_of


def test_each_trial_is_timed_with_its_own_runs_and_the_references(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant, "record", list)  # the runs as they are ordered, not driven
    runs, references = trials_of(8, [19, 2], references=2)
    assert [[run.seed for run in some] for some in runs] == [
        [run.seed for run in specs(8)[RUNS * trial : RUNS * (trial + 1)]] for trial in (19, 2)
    ]
    assert [run.seed for run in references] == [run.seed for run in specs(8, 2)[-2:]]
    seen = []

    def judge(some, normal, vehicle):
        time.sleep(0.05)
        seen.append((some, normal))
        return len(seen)

    found = list(timed(judge, runs, references))
    assert [answer for _, _, answer in found] == [1, 2]
    assert all(clock >= 0.05 and processor < clock for clock, processor, _ in found)
    assert [some for some, _ in seen] == runs
    assert all(normal is references for _, normal in seen)


def test_more_references_leave_the_trials_as_they_are() -> None:
    few, many = specs(3, 2), specs(3, 5)
    assert len(many) == len(few) + 3
    for a, b in zip(few, many, strict=False):
        assert (a.seed, a.heading_rad, a.changes) == (b.seed, b.heading_rad, b.changes)
