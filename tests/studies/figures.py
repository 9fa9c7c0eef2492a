"""Figures that documents quote, and the results they come from.

A quoted figure stands between comments that name its study and its name there, which a reader does not see:
`<!-- coverage:within_2_sigma_percent -->93.1<!-- / -->`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

QUOTED = re.compile(r"<!-- (\w+):(\w+) -->(.*?)<!-- / -->")


def documents(root: Path) -> list[Path]:
    """The README and every page."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def stored(results: Path, study: str, name: str) -> str | None:
    """A figure as its study printed it, or None where there is no such result."""
    file = results / f"{study}.json"
    if not file.is_file():
        return None
    found = json.loads(file.read_text(encoding="utf-8"))["figures"].get(name)
    return None if found is None else str(found)


def differences(text: str, results: Path) -> list[str]:
    """What a document quotes otherwise than the results have it."""
    lines = []
    for study, name, quoted in QUOTED.findall(text):
        found = stored(results, study, name)
        if found is None:
            lines.append(f"{study}:{name} is quoted, but has no result")
        elif found != quoted:
            lines.append(f"{study}:{name} is quoted as {quoted}, its result is {found}")
    return lines


def rewritten(text: str, results: Path) -> str:
    """The document with every quoted figure as its result has it."""

    def put(match: re.Match[str]) -> str:
        found = stored(results, match[1], match[2])
        return match[0] if found is None else f"<!-- {match[1]}:{match[2]} -->{found}<!-- / -->"

    return QUOTED.sub(put, text)
