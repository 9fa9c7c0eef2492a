"""A fixed part of the kills: `python -m tests.studies run kills`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.kills.commands import COMMANDS, prepared
from tests.studies.kills.kills import BAD, killed, reference_run
from tests.studies.kills.leftovers import half_files, whole
from tests.studies.kills.troubles import TROUBLES, troubled, two_at_once

WORDS = COMMANDS["simulate"]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("kills"))


@pytest.mark.parametrize("name", ["simulate", "convert"])
def test_a_killed_command_leaves_nothing_half_and_runs_again(name: str, work: Path) -> None:
    count = killed(name, work, 5)
    assert count["kills"] == 5
    assert count["ended before"] < 5
    assert {what: count[what] for what in BAD if count[what]} == {}


def test_a_machine_in_trouble_leaves_nothing_half(work: Path) -> None:
    reference_run(WORDS, work)
    ends = {name: troubled("simulate", work, trouble) for name, trouble in TROUBLES.items()}
    assert set(ends.values()) <= {"works", "refused"}, ends
    assert ends["full disk"] == ends["read only"] == "refused"
    assert ends["clock set back"] == ends["no home"] == "works"
    assert two_at_once("simulate", work) == "works"


def test_half_a_file_is_seen(work: Path, tmp_path: Path) -> None:
    reference_run(WORDS, work)
    whole = work / "reference"
    assert half_files(whole, whole) == []
    for name, size in (("imu.csv", 700), ("imu.csv", 0)):
        log = tmp_path / str(size) / "run"
        log.mkdir(parents=True)
        (log / name).write_bytes((whole / "run" / name).read_bytes()[:size])
        assert half_files(log.parent, whole) == [f"run/{name}"]
    rows = (whole / "run" / "imu.csv").read_text().splitlines(keepends=True)
    cut = tmp_path / "cut" / "run"
    cut.mkdir(parents=True)
    for path in (whole / "run").iterdir():
        (cut / path.name).write_bytes(path.read_bytes())
    (cut / "imu.csv").write_text("".join(rows[: len(rows) // 2]))
    assert half_files(cut.parent, whole) == ["run: not the whole log"]


def test_a_table_with_commas_in_quotes_is_whole_and_a_cut_one_is_not(tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text('name,why\n"a, b",c\nd,"e, f"\n')
    assert whole(table)
    table.write_text('name,why\n"a, b",c\nd\n')
    assert not whole(table)
    table.write_text('name,why\n"a, b",c\nd,e')
    assert not whole(table)
