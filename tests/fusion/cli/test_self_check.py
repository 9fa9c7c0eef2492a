"""`self-check`: what works is told, and what is broken with its remedy."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from terrafusion.fusion.cli import self_check


def test_this_installation_works(terrafusion) -> None:
    done = terrafusion("self-check")
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert lines[-1] == "this installation works"
    for word in (
        "versions: Python",
        "compiler",
        "cache of compiled code",
        "engine",
        "replay: position error",
    ):
        assert any(word in line for line in lines), word
    assert sum("extra " in line for line in lines) == len(self_check.EXTRAS)


@pytest.mark.parametrize(
    ("attribute", "value", "name"),
    [("MAX_DIFFERENCE", -1.0, "engine"), ("MAX_ERROR_M", 0.0, "replay")],
)
def test_what_is_broken_is_told_with_its_remedy(
    attribute: str, value: float, name: str, terrafusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(self_check, attribute, value)
    done = terrafusion("self-check", "--json")
    assert done.status == 1
    document = json.loads(done.out)
    assert document["works"] is False
    (broken,) = [check for check in document["checks"] if check["state"] == "broken"]
    assert broken["name"] == name
    assert broken["remedy"]


def test_a_cache_that_cannot_be_written_is_told(
    terrafusion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TERRAFUSION_CACHE", str(tmp_path / "file" / "cache"))
    done = terrafusion("self-check")
    assert done.status == 1
    (line,) = [line for line in done.out.splitlines() if line.startswith("broken")]
    assert "TERRAFUSION_CACHE" in line


def test_a_check_that_ends_in_an_exception_is_broken(monkeypatch: pytest.MonkeyPatch, terrafusion) -> None:
    def fails() -> None:
        raise ImportError("libgtsam.so.4 is missing")

    monkeypatch.setattr(self_check, "_replay", fails)
    done = terrafusion("self-check", "--quiet")
    assert done.status == 1
    assert re.fullmatch(r"1 of \d+ checks failed\n", done.out)
