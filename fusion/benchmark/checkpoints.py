"""Results of a long run, kept piece by piece: a run that was stopped goes on with the same command.

parts/<key>.json     what one piece gave, with the hash of the sources and the state of the files that made it
"""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from terrafusion.datasets.catalog.catalog import load_catalog
from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.json_text import to_json
from terrafusion.datasets.readers import files_of

FOLDER = "parts"
LIBRARIES = ("casadi", "gtsam", "numpy", "scipy")
"""Their versions make the numbers, too."""


def write_part(out: Path, key: str, content: dict[str, Any], state: str = "") -> dict[str, Any]:
    """Keep what the piece `key`, the name of its file, gave; returns it as `read_part` does.

    Args:
        state: of the files that it was made of, such as `log_state`.

    Raises:
        TerrafusionError: the folder cannot be written.
    """
    text = to_json({"sources_sha256": sources_sha256(), "state": state, **content})
    write_atomically(_file(out, key), lambda part: part.write_text(text, encoding="utf-8"))
    part: dict[str, Any] = json.loads(text)
    return part


def read_part(out: Path, key: str, state: str = "") -> dict[str, Any] | None:
    """What the piece `key` gave, None where it is missing, cut short, or of other sources or files."""
    try:
        part: dict[str, Any] = json.loads(_file(out, key).read_text(encoding="utf-8"))
        fresh = (part["sources_sha256"], part["state"]) == (sources_sha256(), state)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return part if fresh else None


def log_state(log: str) -> str:
    """Hash of names, sizes and times of the files of a log.

    Empty for a log of the catalogue: it is only read with the bytes that the catalogue, one of the sources,
    tells. Empty as well where there is no such log.
    """
    if log in load_catalog().recordings():
        return ""
    try:
        states = [(file.name, file.stat()) for file in files_of(log)]
    except (OSError, TerrafusionError):
        return ""
    text = "".join(f"{name}\0{found.st_size}\0{found.st_mtime_ns}\0" for name, found in states)
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def sources_sha256() -> str:
    """`hash_sources` as it was when this process first asked: pieces of two versions are not mixed."""
    return hash_sources()


def hash_sources() -> str:
    """Hash of everything that makes the numbers: this library and the `LIBRARIES` it computes with."""
    digest = hashlib.sha256()
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}\0".encode())
    for package in ("datasets", "twin", "fusion"):
        with resources.as_file(resources.files(f"terrafusion.{package}")) as folder:
            for file in sorted(folder.rglob("*")):
                if file.suffix in (".py", ".c", ".h", ".yaml", ".csv"):
                    digest.update(f"{package}/{file.relative_to(folder).as_posix()}\0".encode())
                    digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()


def _file(out: Path, key: str) -> Path:
    return out / FOLDER / f"{key}.json"
