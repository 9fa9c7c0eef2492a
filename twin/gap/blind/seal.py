"""Labels under seal: committed to before the answers, opened after them, by a chain of hashes.

1. `seal` encrypts the labels and writes `commitment.json` with their salted hash. The key stays in
`labels.key`. 2. `close` notes the hash of the finished answers and of the commitment they were given under.
3. `unseal` opens the labels only if the answers are the ones that were closed, under this commitment, and
if the
   labels were not opened before for other answers; then it checks them against the salted hash.

This guards against a diagnosis (or its author) that peeks, by accident or habit. It is no protection against
whoever draws the plan once more from a seed that is known.
"""

from __future__ import annotations

import hashlib
import hmac
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
_BYTES = 32
_guarded: set[str] = set()
_hooks: list[str] = []


def seal(folder: Path, labels: bytes, public: Mapping[str, Any]) -> None:
    """Encrypts the labels into the folder and commits to them; `public` is told beside the hash.

    Encryption is by the key stream of SHAKE-256 over key and nonce, authenticated by HMAC-SHA256
    (encrypt, then authenticate).
    """
    key, salt, nonce = (secrets.token_bytes(_BYTES) for _ in range(3))
    hidden = _xor(labels, key, nonce)
    tag = hmac.digest(key, nonce + hidden, "sha256")
    _write(folder / LABELS, nonce + tag + hidden)
    _write(folder / KEY, json.dumps({"key": key.hex(), "salt": salt.hex()}).encode())
    told = {**public, "labels_salted_sha256": hashlib.sha256(salt + labels).hexdigest()}
    _write(folder / COMMITMENT, json.dumps(told, indent=1).encode())


def commitment(folder: Path) -> dict[str, Any] | None:
    """What was committed to, or None where nothing was."""
    path = folder / COMMITMENT
    return dict(json.loads(path.read_text())) if path.is_file() else None


def close(folder: Path) -> None:
    """Declares the answers finished: what is scored are these bytes, given under this commitment."""
    told = {"answers_sha256": _hash(folder / ANSWERS), "commitment_sha256": _hash(folder / COMMITMENT)}
    _write(folder / CLOSED, json.dumps(told, indent=1).encode())


def unseal(folder: Path) -> bytes:
    """The labels.

    Raises:
        DataError: the answers are not closed, are other ones than those closed, were given under another
            commitment, come after the labels were opened; or the labels are not those committed to.
    """
    _check_answers(folder)
    sealed, key = (folder / LABELS).read_bytes(), json.loads((folder / KEY).read_text())
    nonce, tag, hidden = sealed[:_BYTES], sealed[_BYTES : 2 * _BYTES], sealed[2 * _BYTES :]
    secret, salt = bytes.fromhex(key["key"]), bytes.fromhex(key["salt"])
    labels = _xor(hidden, secret, nonce)
    told = (commitment(folder) or {}).get("labels_salted_sha256")
    if not hmac.compare_digest(tag, hmac.digest(secret, nonce + hidden, "sha256")):
        raise DataError("the sealed labels or their key were changed", file=folder / LABELS)
    if hashlib.sha256(salt + labels).hexdigest() != told:
        raise DataError("the labels are not those committed to", file=folder / COMMITMENT)
    opened = json.dumps({"answers_sha256": _hash(folder / ANSWERS)}).encode()
    _write(folder / OPENED, opened)
    return labels


def _check_answers(folder: Path) -> None:
    if not (folder / CLOSED).is_file():
        raise DataError("the answers are not finished", file=folder, remedy="the same command continues")
    closed, answers = json.loads((folder / CLOSED).read_text()), _hash(folder / ANSWERS)
    if closed["answers_sha256"] != answers:
        raise DataError("the answers changed after they were closed", file=folder / ANSWERS)
    if closed["commitment_sha256"] != _hash(folder / COMMITMENT):
        raise DataError("the answers were given under another commitment", file=folder / ANSWERS)
    if (folder / OPENED).is_file():
        before = json.loads((folder / OPENED).read_text())["answers_sha256"]
        if before != answers:
            raise DataError("the labels were opened before these answers were given", file=folder / ANSWERS)


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


def _xor(text: bytes, key: bytes, nonce: bytes) -> bytes:
    stream = hashlib.shake_256(key + nonce).digest(len(text))
    return (int.from_bytes(text, "big") ^ int.from_bytes(stream, "big")).to_bytes(len(text), "big")


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _write(path: Path, content: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(content))
