"""The survey: facts told of the public sets beside what is found in them."""

from __future__ import annotations

import os
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from terrafusion.datasets.catalog.catalog import DATA_VARIABLE
from terrafusion.datasets.writers import write_log_folder
from tests.datasets.conftest import make_drive
from tests.studies.survey import survey
from tests.studies.survey.published import FACTS, Fact, Instead


@pytest.fixture
def field_sets() -> Path:
    """The field logs, where the environment names their folder."""
    root = os.environ.get(DATA_VARIABLE)
    if not root or not (Path(root) / "manifest.json").is_file():
        pytest.skip(f"{DATA_VARIABLE} names no folder with the field logs")
    return Path(root)


def test_what_is_found_is_what_was_told(field_sets: Path) -> None:
    rows = list(survey.survey())
    assert [row.cells() for row in rows if row.verdict() == survey.WRONG] == []
    sets = {folder.name for folder in field_sets.iterdir()}
    sets |= {name.split("/")[0] for name, _ in survey.on_this_machine()}
    assert len(rows) == sum(fact.of.split("/")[0] in sets for fact in FACTS)
    told = [row.verdict() for row in rows if row.fact.is_told()]
    assert sum(verdict == "agrees" for verdict in told) > 0.8 * len(told)
    assert {row.verdict() for row in rows if not row.fact.is_told()} == {"as before"}


def test_every_fact_is_of_a_recording_and_a_quantity() -> None:
    names = list(survey.surveyed())
    for fact in FACTS:
        assert fact.quantity in survey.QUANTITIES
        assert any(fnmatchcase(name, fact.of) for name in names), fact.of
    for name in names:
        assert any(fnmatchcase(name, fact.of) for fact in FACTS), f"nothing is told of {name}"


def test_what_is_otherwise_is_not_what_was_told() -> None:
    """An `instead` inside the told interval would hide nothing and explain nothing."""
    for fact in FACTS:
        if fact.instead is not None:
            assert isinstance(fact.expected, tuple)
            low, high = fact.expected
            assert not (low <= fact.instead.low and fact.instead.high <= high), fact


def test_verdicts() -> None:
    fact = Fact("*", "q", (9.0, 11.0), "10 Hz", Instead(4.0, 5.0, "held"))
    verdicts = {
        (10.0,): "agrees",
        (9.0, 11.0): "agrees",
        (4.5,): "otherwise: held",
        (4.5, 10.0): survey.WRONG,
        (8.0,): survey.WRONG,
        (10.0, None): "agrees",
        (None, None): survey.WRONG,
        ("10",): survey.WRONG,
    }
    for found, verdict in verdicts.items():
        assert survey.Row(fact, found).verdict() == verdict, found
    word = Fact("set/*", "axis", "+z", "z up")
    assert survey.Row(word, ("+z", "+z")).verdict() == "agrees"
    assert survey.Row(word, ("+z", "+y")).verdict() == survey.WRONG
    assert survey.Row(word, ("+z", "+y")).cells() == [
        "set/* (2 of 2)", "axis", "z up (+z)", "+y, +z", survey.WRONG
    ]  # fmt: skip
    late = survey.Row(Fact("set/one", "lag", (0.1, 0.2), "0.15 s"), (survey.Estimate(-0.15, -0.1, -0.2),))
    assert late.verdict() == survey.WRONG
    assert late.cells()[3] == "-0.15 [-0.2, -0.1]"
    table = survey.markdown([survey.Row(fact, (9.5, 10.25, None))])
    assert table.splitlines()[2] == "| * (2 of 3) | q | 10 Hz (9 to 11) | 9.5 to 10.25 | agrees |"


def test_quantities_of_a_known_drive(tmp_path: Path) -> None:
    """The synthetic drive of the tests: every number is known from how it was made."""
    drives = survey.Drives("set/drive", write_log_folder(make_drive(), tmp_path / "drive"))
    expected = {
        "drives": 1,
        "duration, s": pytest.approx(60.0, abs=0.3),
        "channels": "command wheels imu gnss motor truth",
        "wheels of": "left right radps",
        "imu rows a second": pytest.approx(100.0, abs=0.01),
        "wheels rows a second": pytest.approx(20.0, abs=0.01),
        "gnss rows a second": pytest.approx(5.0, abs=0.01),
        "gravity in the log on": "+z",
        "gravity on body z, m/s2": pytest.approx(9.81, abs=0.02),
        "rows a wheel speed is held": 1.0,
        "imu ends after wheels, s": pytest.approx(0.04, abs=1e-6),
        "least sigma, m": pytest.approx(0.05),
        "terrain": "gravel",
    }
    found = {name: survey.QUANTITIES[name](drives) for name in expected}
    assert found == expected
    for name in ("gyro with wheels, r", "gyro with truth, r", "gyro with wheels in the log, r"):
        r = survey.QUANTITIES[name](drives)
        assert isinstance(r, float)
        assert 0.9 < r <= 1.0


def test_no_recording_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["survey", "no such set/*"])
    assert survey.main() == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert DATA_VARIABLE in err


def test_the_table_of_one_set(
    field_sets: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["survey", "cmu_single_wheel/*"])
    assert survey.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| recording | quantity | told | found | verdict |"
    assert len(lines) == 2 + sum(fact.of.startswith("cmu_single_wheel") for fact in FACTS)
    monkeypatch.setattr(survey, "FACTS", (Fact("cmu_single_wheel/*", "trials", (190, 190), "190"),))
    assert survey.main() == 1
    assert survey.WRONG in capsys.readouterr().out
