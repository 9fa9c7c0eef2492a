"""Labels of a blind check are committed to before the answers, which are fixed once the labels are open."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.twin.gap.blind import seal


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    seal.commit(tmp_path, "the truth", {"seed": 1})
    (tmp_path / seal.ANSWERS).mkdir()
    (tmp_path / seal.ANSWERS / "trial-1.json").write_text("first\n")
    return tmp_path


def test_anyone_can_check_the_commitment_once_the_labels_are_open(committed: Path) -> None:
    before = seal.commitment(committed)
    assert before is not None
    assert before["seed"] == 1
    assert not seal.opened(committed)
    seal.open_labels(committed, "the truth")
    seal.open_labels(committed, "the truth")
    assert seal.opened(committed)
    opened = json.loads((committed / seal.OPENED).read_text())
    salted = hashlib.sha256((opened["salt"] + opened["labels"]).encode()).hexdigest()
    assert salted == before["labels_salted_sha256"]
    assert opened["answers_sha256"] == hashlib.sha256(b"first\n").hexdigest()


def test_answers_of_after_the_opening_are_refused(committed: Path) -> None:
    seal.open_labels(committed, "the truth")
    (committed / seal.ANSWERS / "trial-1.json").write_text("second\n")
    with pytest.raises(DataError, match="answers changed after the labels were opened"):
        seal.open_labels(committed, "the truth")


def test_other_labels_are_noticed(committed: Path) -> None:
    """Neither labels nor salt nor commitment can be swapped; salts differ from check to check."""
    with pytest.raises(DataError, match="not those committed to"):
        seal.open_labels(committed, "another truth")
    first = seal.commitment(committed)
    seal.commit(committed, "the truth", {"seed": 1})
    assert seal.commitment(committed) != first
    (committed / seal.SALT).unlink()
    with pytest.raises(DataError, match="not those committed to"):
        seal.open_labels(committed, "the truth")
