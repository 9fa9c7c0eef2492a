"""What a command left: parts by name, whole files, and half files that pass for whole."""

from __future__ import annotations

import contextlib
import csv
import gzip
import json
from pathlib import Path

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.scratch import PREFIX
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.datasets.readers import open_recording


def is_part(path: Path) -> bool:
    """Whether a name says that its content is work in progress."""
    return any(
        name.startswith(PREFIX) or name.endswith((".part", ".parts")) or name == "parts"
        for name in path.parts
    )


def whole(path: Path) -> bool:
    """Whether a file is complete, by its format."""
    data, kind = path.read_bytes(), path.suffix
    if not data:
        return kind == ".jsonl"
    try:
        if path.name.endswith(".csv.gz"):
            data, kind = gzip.decompress(data), ".csv"
        if kind == ".json":
            json.loads(data)
        elif kind == ".jsonl":
            [json.loads(line) for line in data.splitlines()]
        elif kind == ".yaml":
            read_yaml(path)
    except (EOFError, OSError, ValueError, TerrafusionError):
        return False
    tails = {".html": b"</html>", ".png": b"IEND\xaeB`\x82", ".parquet": b"PAR1", ".mcap": b"\x89MCAP0\r\n"}
    if kind == ".csv":
        lines = data.decode(errors="replace").splitlines(keepends=True)
        rows = csv.reader(line for line in lines if not line.startswith("#"))
        return data.endswith(b"\n") and len({len(row) for row in rows}) == 1
    return data.rstrip(b"\n" if kind == ".html" else b"").endswith(tails.get(kind, b""))


def rows_of(log: Path) -> dict[str, int]:
    """Number of samples of each channel of a log.

    Raises:
        TerrafusionError: it is no log.
    """
    return {name: len(channel) for name, channel in open_recording(str(log)).channels().items()}


def half_files(out: Path, reference: Path) -> list[str]:
    """Files of `out` that pass for whole and are not; logs that open and lack samples."""
    bad = [
        str(path.relative_to(out))
        for path in sorted(out.rglob("*"))
        if path.is_file() and not is_part(path.relative_to(out)) and not whole(path)
    ]
    for meta in sorted(out.rglob("meta.yaml")):
        folder = meta.parent.relative_to(out)
        if not is_part(folder):
            with contextlib.suppress(TerrafusionError):
                if rows_of(out / folder) != rows_of(reference / folder):
                    bad.append(f"{folder}: not the whole log")
    return bad


def names_in(folder: Path) -> set[str]:
    """All files below a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
