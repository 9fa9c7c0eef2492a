"""The table of all effects in the twin's own runs: what it holds, on one effect of it."""

from __future__ import annotations

import pytest

from tests.studies import effect_sweep
from tests.studies.effect_sweep import first_forms, main


def test_a_sensors_change_is_named_with_its_size(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(effect_sweep, "SEGMENTS", effect_sweep.SEGMENTS[:7])
    some = ["--effects", "gyro_scale", "--runs", "2", "--references", "5", "--sizes", "3"]
    assert main(some) == 0
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    ((name, size, p, verdict, first, named, found),) = rows
    assert name == "`gyro_scale/scale`"
    assert float(p) <= 0.05
    assert (verdict, named) == ("effect", "gyro_scale")
    assert first.startswith("gyro_scale")
    value, sigma = map(float, found.split(" +- "))
    assert abs(value - float(size.split()[0])) < 4.0 * sigma


def test_every_effect_has_a_row() -> None:
    assert len(first_forms()) == 37
    assert all(key.startswith(f"{name}/") for name, key in first_forms().items())


def test_an_unknown_effect_is_one_line_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--effects", "gyro_bais"]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err == "error: unknown effect 'gyro_bais'; did you mean gyro_bias or gyro_scale\n"


def test_numbers_that_cannot_be_are_wrong_usage() -> None:
    for words in (["--seed", "-1"], ["--runs", "0"], ["--references", "-2"]):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        assert stopped.value.code == 2


def test_a_ground_that_is_not_known_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--terrain", "lava", "--effects", "gyro_bias"]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("error: unknown terrain 'lava'; known are asphalt")
