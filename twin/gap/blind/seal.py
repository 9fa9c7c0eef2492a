"""Sealed labels: a hash commitment before the answers, opened after them.

1. `seal` writes the labels, hidden by a secret, and publishes the SHA-256 of secret and labels in
`commitment.json`. 2. `close` records the hashes of the finished answers and of the commitment they were given
under. 3. `unseal` returns the labels if the answers are the closed ones, under this commitment, if the labels
were not opened
   before for other answers, and if they are those committed to.

This guards against a diagnosis (or its author) that reads the labels by accident or habit, not against one
who draws the plan again from a known seed.
"""

import hashlib
import json
import os
import secrets
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import write_atomically

LABELS, KEY, COMMITMENT = "labels.sealed", "labels.key", "commitment.json"
ANSWERS, CLOSED, OPENED = "answers.jsonl", "answers.closed.json", "labels.opened.json"
_guarded: set[str] = set()
_hooks: list[str] = []


def seal(folder: Path, labels: bytes, public: Mapping[str, Any]) -> None:
    """Hides the labels in the folder and commits to them; `public` is published beside the hash."""
    secret = secrets.token_bytes(32)
    _write(folder / LABELS, _hidden(labels, secret))
    _write(folder / KEY, secret.hex().encode())
    _write_json(folder / COMMITMENT, {**public, "labels_salted_sha256": _commitment(secret, labels)})


def commitment(folder: Path) -> dict[str, Any] | None:
    """What was committed to, or None."""
    path = folder / COMMITMENT
    return dict(json.loads(path.read_text())) if path.is_file() else None


def close(folder: Path) -> None:
    """Declares the answers finished: these bytes, given under this commitment, are scored."""
    hashes = {"answers_sha256": _sha256(folder / ANSWERS), "commitment_sha256": _sha256(folder / COMMITMENT)}
    _write_json(folder / CLOSED, hashes)


def unseal(folder: Path) -> bytes:
    """The labels.

    Raises:
        DataError: the answers are not closed, are not the closed ones, were given under another commitment,
            or come after the labels were opened; or the labels are not those committed to.
    """
    answers = _check_answers(folder)
    secret = bytes.fromhex((folder / KEY).read_text())
    labels = _hidden((folder / LABELS).read_bytes(), secret)
    if _commitment(secret, labels) != (commitment(folder) or {}).get("labels_salted_sha256"):
        raise DataError(
            "the labels or their key were changed: they are not those committed to", file=folder / LABELS
        )
    _write_json(folder / OPENED, {"answers_sha256": answers})
    return labels


def _check_answers(folder: Path) -> str:
    """Hash of the answers, once they may be scored."""
    if not (folder / CLOSED).is_file():
        raise DataError("the answers are not finished", file=folder, remedy="the same command continues")
    closed, answers = json.loads((folder / CLOSED).read_text()), _sha256(folder / ANSWERS)
    if closed["answers_sha256"] != answers:
        raise DataError("the answers changed after they were closed", file=folder / ANSWERS)
    if closed["commitment_sha256"] != _sha256(folder / COMMITMENT):
        raise DataError("the answers were given under another commitment", file=folder / ANSWERS)
    opened = folder / OPENED
    if opened.is_file() and json.loads(opened.read_text())["answers_sha256"] != answers:
        raise DataError("the labels were opened before these answers were given", file=folder / ANSWERS)
    return answers


def forbid(folder: Path) -> None:
    """From now on this process cannot open the labels or their key in the folder: an audit hook refuses.

    The hook stays as long as the process lives; `permit` lifts the ban.
    """
    if not _hooks:
        sys.addaudithook(_refuse)
        _hooks.append("open")
    _guarded.update(os.path.realpath(folder / name) for name in (LABELS, KEY))


def permit(folder: Path) -> None:
    """Lifts the ban of `forbid`."""
    _guarded.difference_update(os.path.realpath(folder / name) for name in (LABELS, KEY))


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        path = os.fsdecode(arguments[0])
        if os.path.basename(path) in (LABELS, KEY) and os.path.realpath(path) in _guarded:
            raise PermissionError(f"{path} stays closed until the answers are given")


def _commitment(secret: bytes, labels: bytes) -> str:
    return hashlib.sha256(secret + labels).hexdigest()


def _hidden(text: bytes, secret: bytes) -> bytes:
    """The text XOR a key stream of the secret (SHAKE-256); the same call reveals it."""
    stream = hashlib.shake_256(secret).digest(len(text))
    return (int.from_bytes(text, "big") ^ int.from_bytes(stream, "big")).to_bytes(len(text), "big")


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _write(path: Path, content: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(content))


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    _write(path, json.dumps(content, indent=1).encode())
