"""Checkpoints of a long computation: an interrupted one continues with the same command.

parts/<key>.json     result of one part, with the hash of the sources and the state of the files it depends on
"""

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
"""Libraries whose version the results depend on."""


def write_part(out: Path, key: str, content: dict[str, Any], state: str = "") -> dict[str, Any]:
    """Store the result of the part `key`, the name of its file; returns it as `read_part` does.

    `state` is that of the files it depends on, such as `log_state`. TerrafusionError: it cannot be written.
    """
    text = to_json({"sources_sha256": sources_sha256(), "state": state, **content})
    write_atomically(_file(out, key), lambda part: part.write_text(text, encoding="utf-8"))
    part: dict[str, Any] = json.loads(text)
    return part


def read_part(out: Path, key: str, state: str = "") -> dict[str, Any] | None:
    """Result of the part `key`; None if it is missing, incomplete, or of other sources or files."""
    try:
        part: dict[str, Any] = json.loads(_file(out, key).read_text(encoding="utf-8"))
        fresh = (part["sources_sha256"], part["state"]) == (sources_sha256(), state)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return part if fresh else None


def log_state(log: str) -> str:
    """Hash of names, sizes and times of the files of a log; "" if there is no such log.

    "" for a log of the catalogue, too: the catalogue, one of the sources, fixes its bytes.
    """
    if log in load_catalog().recordings():
        return ""
    try:
        states = [(file.name, file.stat()) for file in files_of(log)]
    except (OSError, TerrafusionError):
        return ""
    text = "".join(f"{name}\0{stat.st_size}\0{stat.st_mtime_ns}\0" for name, stat in states)
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def sources_sha256() -> str:
    """`hash_sources` at the first call of this process: parts of two versions are never mixed."""
    return hash_sources()


def hash_sources() -> str:
    """Hash of everything that results depend on: this library and the versions of `LIBRARIES`."""
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
