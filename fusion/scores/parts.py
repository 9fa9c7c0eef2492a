"""Results of a long run, kept piece by piece: a run that was stopped goes on with the same command.

parts/<key>.json     what one piece gave, with the hash of the sources that made it
"""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

from terrafusion.datasets.atomic import write_atomically
from terrafusion.fusion.report.outputs import to_json

FOLDER = "parts"


def write_part(out: Path, key: str, content: dict[str, Any]) -> None:
    """Keep what the piece `key`, the name of its file, gave.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    text = to_json({"sources_sha256": sources_sha256(), **content})
    write_atomically(_file(out, key), lambda part: part.write_text(text, encoding="utf-8"))


def read_part(out: Path, key: str) -> dict[str, Any] | None:
    """What the piece `key` gave, None where it is missing, cut short, or of other sources."""
    try:
        part: dict[str, Any] = json.loads(_file(out, key).read_text(encoding="utf-8"))
        fresh = part["sources_sha256"] == sources_sha256()
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return part if fresh else None


@functools.cache
def sources_sha256() -> str:
    """Hash of everything that makes the numbers: pieces of two versions are not mixed."""
    digest = hashlib.sha256()
    for package in ("datasets", "twin", "fusion"):
        with resources.as_file(resources.files(f"terrafusion.{package}")) as folder:
            for file in sorted(folder.rglob("*")):
                if file.suffix in (".py", ".c", ".h", ".yaml", ".csv"):
                    digest.update(f"{package}/{file.relative_to(folder).as_posix()}\0".encode())
                    digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()


def _file(out: Path, key: str) -> Path:
    return out / FOLDER / f"{key}.json"
