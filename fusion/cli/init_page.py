"""What `terrafusion init` shows and asks."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.fusion.cli.common import Line
from terrafusion.fusion.cli.inspect_page import clock_table, entry, measured_texts, print_lines

if TYPE_CHECKING:
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.fusion.init.answers import Answers
    from terrafusion.fusion.init.vehicle import FirstVehicle
    from terrafusion.fusion.metrics.verdict import Verdict

QUESTIONS = {
    "drive": "how it turns: differential, skid_steer, tracked, ackermann or four_wheel_steer",
    "track_m": "distance of left and right wheels, m",
    "antenna_m": "GNSS antenna from the middle of the wheels' contacts: forward,left,up in m",
    "mass_kg": "mass, kg",
}
"""Asked on a terminal, in this order, where no option gives the answer."""


def interactive() -> bool:
    """Whether somebody can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def choose_sensors(log: str, topics: dict[str, str]) -> dict[str, str]:
    """The topics given, and those the user chooses among several sensors of a kind, by channel.

    Raises:
        DataError: several of a kind, and nobody to ask.
    """
    from terrafusion.datasets.checks.summary import clock, mean_rate_hz
    from terrafusion.datasets.readers.ros.contents import bag_contents

    contents = bag_contents(log, topics)
    if contents is None:
        return topics
    start_ns = min((int(t_ns[0]) for t_ns in contents.times_ns.values()), default=0)
    clocks = {
        name: clock(start_ns, t_ns) | {"rate_hz": mean_rate_hz(t_ns)}
        for name, t_ns in contents.times_ns.items()
    }
    print_lines(clock_table(clocks, "topic"))
    if contents.unused:
        print_lines(entry("not used", "dim", ", ".join(contents.unused)))
    chosen = dict(topics)
    while contents is not None and contents.candidates:
        kind, names = next(iter(contents.candidates.items()))
        rates = [f"{name} ({clocks[name]['rate_hz'] or 0.0:.3g} Hz)" for name in names]
        if not interactive():
            raise DataError(
                f"{len(names)} sensors of one kind: {', '.join(rates)}",
                file=log,
                channel=kind,
                remedy="choose with " + " or ".join(f"--topic {kind}={name}" for name in names),
            )
        print(f"{kind}: which of these?")
        for number, shown in enumerate(rates, 1):
            print(f"  {number}  {shown}")
        chosen[kind] = names[_number_to(len(names)) - 1]
        contents = bag_contents(log, chosen)  # of several robots the wheels choose the other topics
    return chosen


def _number_to(last: int) -> int:
    """A number from 1 to the last, asked for until it is one."""
    while not (1 <= (number := typer.prompt("number", type=int)) <= last):
        print(f"  give a number from 1 to {last}")
    return int(number)


def contents_lines(recording: Recording) -> Iterator[Line]:
    """Channels with rates and gaps."""
    from terrafusion.datasets.checks.measures import Measures
    from terrafusion.datasets.checks.summary import summarise

    yield from clock_table(summarise(recording, Measures(), [])["channels"])
    yield "", ""


def ask(answers: Answers, topics: dict[str, str]) -> Answers:
    """The answers, completed on a terminal; Enter leaves a number to the assumption."""
    held = {kind: name for kind, name in topics.items() if not kind.startswith("joint.")}
    found: dict[str, Any] = {"topics": held}
    if interactive():
        print(
            "What the log cannot tell (Enter: not known, assumed as of the generic vehicle; add :data_sheet"
        )
        print("to a number that is not measured):")
    for name, question in QUESTIONS.items() if interactive() else ():
        if getattr(answers, name) is None:
            answer = _asked(name, question)
            found |= {} if answer is None else {name: answer}
    return dataclasses.replace(answers, **found)


def _asked(name: str, question: str) -> Any:
    """The answer, asked for again while it is malformed; None for none."""
    from terrafusion.fusion.init.answers import parse

    while text := typer.prompt(f"  {question}", default="", show_default=False).strip():
        try:
            return parse(text, name)
        except ConfigError as error:
            print(f"  {error}")
    return None


def result_lines(found: FirstVehicle, out: Path) -> Iterator[Line]:
    """What was measured, repaired and assumed, and the file."""
    from terrafusion.datasets.core.json_text import finite
    from terrafusion.fusion.init.geometry import unmeasured_lines

    if "imu_axes" in found.draft:
        axes = found.draft["imu_axes"]
        yield from entry("mounting", "", f"{', '.join(axes.raw())} are the {axes.comment}")
    for name, text in measured_texts(finite(dataclasses.asdict(found.measured))):
        yield from entry(name, "", text)
    if found.calibration is not None:
        missing = [n for n in found.calibration.unobserved() if n not in found.draft]
        if missing:
            yield from entry(
                "not seen", "dim", f"{', '.join(missing)}: taken as usual, learned while driving"
            )
    for note in (*found.notes, *found.recording.notes):
        if not note.startswith("repaired: "):  # listed below
            yield from entry("note", "dim", note)
    for finding in found.repaired:
        text = f"{finding.channel}: {finding.what} ({finding.evidence}); {finding.fix}"
        yield from entry("repaired", "yellow", text)
    for finding in found.findings:
        yield from entry(
            finding.severity, "yellow", f"{finding.channel}: {finding.what} ({finding.evidence})"
        )
    for word, text in unmeasured_lines(found.draft):
        yield from entry(word, "yellow" if word == "assumed" else "", text)
    yield "", ""
    for line in out.read_text(encoding="utf-8").splitlines():
        yield "", line
    yield "", ""
    yield "", f"written to {out}"


def document_of(found: FirstVehicle, out: Path, verdict: Verdict | None) -> dict[str, Any]:
    """What `--json` prints: the file's section `robot`, what of it is assumed, findings and the verdict."""
    from terrafusion.datasets.core.json_text import finite

    return {
        "file": str(out),
        "robot": finite({name: line.raw() for name, line in found.draft.items()}),
        "assumed": [name for name, line in found.draft.items() if line.assumed],
        "repaired": [one.to_dict() for one in found.repaired],
        "findings": [one.to_dict() for one in found.findings],
        "verdict": None if verdict is None else {"value": verdict.value, "reasons": [*verdict.reasons]},
    }
