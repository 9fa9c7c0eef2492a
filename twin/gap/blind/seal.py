"""Labels of a blind check, committed to by a salted hash before the answers.

`commit` publishes the SHA-256 of a salt and the labels in `commitment.json`. Once the answers are finished,
`open_labels` publishes salt and labels with the hash of the answers, which are scored only as they were then.
This shows that neither was chosen after the other. A diagnosis could still draw the plan of a known seed.
"""

import hashlib
import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.files import write_atomically

COMMITMENT, SALT, ANSWERS, OPENED = "commitment.json", "labels.salt", "answers", "labels.opened.json"


def commit(folder: Path, labels: str, public: Mapping[str, Any]) -> None:
    """Commits to the labels; `public` is published beside the hash."""
    salt = secrets.token_hex(32)
    _write(folder / SALT, salt)
    _write(folder / COMMITMENT, _json({**public, "labels_salted_sha256": _sha256(salt + labels)}))


def commitment(folder: Path) -> dict[str, Any] | None:
    """What was committed to, or None."""
    path = folder / COMMITMENT
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None


def opened(folder: Path) -> bool:
    """Whether the answers are finished."""
    return (folder / OPENED).is_file()


def open_labels(folder: Path, labels: str) -> None:
    """Declares the answers finished, and publishes labels and salt beside their hash.

    Raises:
        DataError: the labels are not those committed to, or the answers changed since.
    """
    salt_file, path = folder / SALT, folder / OPENED
    salt = salt_file.read_text(encoding="utf-8") if salt_file.is_file() else ""
    if _sha256(salt + labels) != (commitment(folder) or {}).get("labels_salted_sha256"):
        raise DataError("the labels are not those committed to", file=folder / COMMITMENT)
    answers = _sha256("".join(p.read_text(encoding="utf-8") for p in sorted((folder / ANSWERS).iterdir())))
    if not path.is_file():
        _write(path, _json({"answers_sha256": answers, "salt": salt, "labels": labels}))
    elif json.loads(path.read_text(encoding="utf-8"))["answers_sha256"] != answers:
        raise DataError("the answers changed after the labels were opened", file=folder / ANSWERS)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _json(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=1)


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
