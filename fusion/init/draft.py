"""A vehicle file of the short form in the making: a line a number, with unit and source as its comment."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.files import write_atomically
from terrafusion.datasets.core.robot import KnownNumber, RobotFile

COMMENT_COLUMN = 64


@dataclass(frozen=True)
class DraftLine:
    """One entry of section `robot`: its value and its comment."""

    value: KnownNumber | str | tuple[str, ...] | dict[str, str]
    comment: str

    @property
    def assumed(self) -> bool:
        """Whether nobody knows it."""
        word = self.comment.startswith("assumed")
        return word or (isinstance(self.value, KnownNumber) and self.value.known == "assumed")

    def raw(self) -> Any:
        """The value as the YAML reader gives it."""
        if isinstance(self.value, KnownNumber):
            return raw_number(self.value)
        return list(self.value) if isinstance(self.value, tuple) else self.value


def raw_number(number: KnownNumber) -> dict[str, Any]:
    """A number as the YAML reader gives it, without what it leaves open."""
    entries = dataclasses.asdict(number).items()
    return {k: list(v) if isinstance(v, tuple) else v for k, v in entries if v not in (None, ())}


Draft = dict[str, DraftLine]
"""Lines by the name of their key."""


def draft_text(draft: Draft, head: str) -> str:
    """The file."""
    lines = [f"# {head}", "robot:"]
    for name, line in draft.items():
        content = f"  {name}: {_flow(line.raw())}"
        lines.append(f"{content.ljust(COMMENT_COLUMN)}  # {' '.join(line.comment.split())}")
    return "\n".join(lines) + "\n"


def write_draft(path: Path, draft: Draft, head: str) -> Path:
    """Write the file.

    Raises:
        ConfigError: a number out of range.
        TerrafusionError: it cannot be written.
    """
    structure(RobotFile, {"robot": {name: line.raw() for name, line in draft.items()}}, file=path)
    text = draft_text(draft, head)
    return write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def _flow(value: Any) -> str:
    """A value in YAML's flow style; texts that might be read as something else in quotes."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_flow(part)}' for key, part in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    if isinstance(value, str):
        return value if value.isidentifier() and value not in _WORDS else json.dumps(value)
    return repr(value)


_WORDS = ("true", "false", "null", "True", "False", "None", "yes", "no", "on", "off", "nan", "inf")
