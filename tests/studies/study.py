"""What a study is: a command, the question it answers, and the figures that are read from what it prints."""

from __future__ import annotations

from dataclasses import dataclass, field

OUT = "{out}"
"""Stands for the study's own folder, where it may keep parts of a long run."""
DATA = "{data}"
"""Stands for the folder of the public field logs (TERRAFUSION_DATA)."""


@dataclass(frozen=True)
class Study:
    """One experiment.

    Attributes:
        question: what it answers, in a sentence.
        command: arguments of `python`; a word that is `terrafusion` stands for the command line.
        minutes: on two idle cores, about.
        figures: name -> regular expression with one group; it is searched in what the command prints, line
            by line from its beginning.
        picture: file that the command leaves in its folder, if it draws one.
        spread: whether its trials run in many processes or on a cluster (--jobs, --backend, --address).
    """

    name: str
    question: str
    command: tuple[str, ...]
    minutes: float
    figures: dict[str, str] = field(default_factory=dict)
    picture: str = ""
    spread: bool = False

    def needs_logs(self) -> bool:
        """Whether it reads public field logs."""
        return DATA in self.command or self.name in READS_LOGS


READS_LOGS = (
    "good_logs", "survey", "field_table", "fault_injection", "field_nulls", "benchmark", "opponents",
    "ice_picture", "outage_terms", "known_changes", "grounds", "fault_matrix",
    "coarse_slides", "course_lag", "own_grounds", "effective_track",
)  # fmt: skip


def module(name: str, *arguments: str) -> tuple[str, ...]:
    """Words of `python -m tests.studies.NAME ...`."""
    return ("-m", f"tests.studies.{name}", *arguments)
