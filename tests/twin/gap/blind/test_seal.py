"""The labels of a blind check stay closed until all answers are written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.twin.gap.blind import seal


def test_labels_come_back_after_the_answers(tmp_path: Path) -> None:
    seal.seal(tmp_path, b"the truth", {"seed": 1})
    assert b"truth" not in (tmp_path / seal.LABELS).read_bytes()
    with pytest.raises(DataError, match="not finished"):
        seal.unseal(tmp_path)
    (tmp_path / seal.ANSWERS).write_text("{}\n")
    seal.close(tmp_path)
    assert seal.unseal(tmp_path) == b"the truth"
    assert seal.unseal(tmp_path) == b"the truth"


def test_answers_that_came_at_the_wrong_time_are_refused(tmp_path: Path) -> None:
    """Changed after closing, closed anew after the opening, or given under another commitment."""
    for name in ("changed", "late", "older"):
        (tmp_path / name).mkdir()
        seal.seal(tmp_path / name, b"labels", {})
        (tmp_path / name / seal.ANSWERS).write_text("first\n")
        seal.close(tmp_path / name)
    (tmp_path / "changed" / seal.ANSWERS).write_text("second\n")
    with pytest.raises(DataError, match="changed after they were closed"):
        seal.unseal(tmp_path / "changed")

    seal.unseal(tmp_path / "late")
    (tmp_path / "late" / seal.ANSWERS).write_text("second\n")
    seal.close(tmp_path / "late")
    with pytest.raises(DataError, match="opened before"):
        seal.unseal(tmp_path / "late")

    seal.seal(tmp_path / "older", b"other labels", {})
    with pytest.raises(DataError, match="another commitment"):
        seal.unseal(tmp_path / "older")


@pytest.mark.parametrize("part", [seal.LABELS, seal.KEY])
def test_other_labels_are_noticed(tmp_path: Path, part: str) -> None:
    """Neither the sealed file nor the key can be swapped for those of other labels."""
    other = tmp_path / "other"
    other.mkdir()
    seal.seal(tmp_path, b"labels", {})
    seal.seal(other, b"labelz", {})
    (tmp_path / seal.ANSWERS).write_text("\n")
    seal.close(tmp_path)
    (tmp_path / part).write_bytes((other / part).read_bytes())
    with pytest.raises(DataError, match="changed"):
        seal.unseal(tmp_path)
    for name in (seal.LABELS, seal.KEY):
        (tmp_path / name).write_bytes((other / name).read_bytes())
    with pytest.raises(DataError, match="not those committed to"):
        seal.unseal(tmp_path)


def test_a_diagnosis_cannot_open_the_labels(tmp_path: Path) -> None:
    seal.seal(tmp_path, b"labels", {})
    seal.forbid(tmp_path)
    try:
        for name in (seal.LABELS, seal.KEY):
            with pytest.raises(PermissionError):
                (tmp_path / name).read_bytes()
        assert seal.commitment(tmp_path) is not None
    finally:
        seal.permit(tmp_path)
    assert (tmp_path / seal.LABELS).read_bytes()


OPENED = """
import sys
sys.path.insert(0, {tests!r})
order = []
def hook(event, arguments):
    if event == "open" and isinstance(arguments[0], str):
        name, writes = arguments[0].rsplit("/", 1)[-1], "r" not in str(arguments[1] or "r")
        order.append((name, writes))
sys.addaudithook(hook)
import blind_answers as fake
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind import answers as module
from terrafusion.twin.gap.blind.plan import CheckSize
module.cases = fake.short_cases
run_blind_check({out!r}, fake.guess, scale=CheckSize(1, 0, 0, 0, 0, 1, 0), seed=5)
sealed = ("labels.sealed", "labels.key")
reads = [i for i, (name, writes) in enumerate(order) if name in sealed and not writes]
closed = max(i for i, (name, _) in enumerate(order) if name.startswith("answers.closed.json"))
answers = max(i for i, (name, writes) in enumerate(order) if name.startswith("answers.jsonl") and writes)
assert reads, "the labels were never opened: the test would prove nothing"
assert answers < min(reads), "an answer was written after the labels were opened"
print("ok")
"""


def test_the_labels_stay_closed_until_all_answers_are_written(tmp_path: Path) -> None:
    """Every file the process opens is watched: labels and key are read after the last write of an answer."""
    code = OPENED.format(tests=str(Path(__file__).parent), out=str(tmp_path / "out"))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "ok"
