"""A vehicle file of the short form in the making: a line a number, with unit and source as its comment."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.robot import KnownNumber
from terrafusion.fusion.outputs.robot_file import raw_number, write_section


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


Draft = dict[str, DraftLine]
"""Lines by the name of their key."""


def write_draft(path: Path, draft: Draft, head: str) -> Path:
    """Write the file, with `head` as a comment above.

    Raises:
        ConfigError: a number out of range.
        TerrafusionError: it cannot be written.
    """
    robot = {name: line.raw() for name, line in draft.items()}
    return write_section(path, robot, {name: line.comment for name, line in draft.items()}, head)
