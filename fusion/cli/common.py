"""What commands share: options of a log and of workers, opening and checking a log, and progress."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.printable import printable
from terrafusion.fusion.cli.usage import SHARED

if TYPE_CHECKING:
    from terrafusion.datasets.checks import Finding
    from terrafusion.datasets.core.recording import Recording
    from terrafusion.datasets.core.sensors import Rig


Mode = Literal["adaptive", "fixed", "robust", "innovation"]
Line = tuple[str, str]
"""Style of the first word of a line, shown on a terminal only, and its text."""
LogArgument = Annotated[
    str,
    typer.Argument(
        metavar="LOG",
        help="A log folder, a bag, another file that can be read, or a catalogue name such as "
        "wvu_pathfinder/s5t1. LOG#3 is the fourth of several recordings in one file.",
    ),
]
VehicleOption = Annotated[
    str | None,
    typer.Option("--vehicle", help="Vehicle by name or YAML file: IMU mounting, track, usual topics."),
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="CHANNEL=/NAME",
        help="Topic of a channel (imu, wheels, gnss, gnss_velocity, steering, barometer, magnetometer, "
        "command, truth, terrain); repeat for more.",
    ),
]
StampsOption = Annotated[
    Literal["header", "receipt"],
    typer.Option("--stamps", help="Times of a bag: 'header' (measurement) or 'receipt' (recording)."),
]
ColumnsOption = Annotated[
    Path | None,
    typer.Option("--columns", metavar="FILE", help="YAML on columns of a table or fields of a bag."),
]
RepairClockOption = Annotated[
    bool, typer.Option("--repair-clock", help="Correct steps of a clock instead of refusing the log.")
]
JobsOption = Annotated[
    int | None,
    typer.Option(min=1, help="Processes on this machine; by default one a processor.", show_default=False),
]
BackendOption = Annotated[Literal["loky", "dask"], typer.Option(help="loky: this machine; dask: a cluster.")]
AddressOption = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:PORT", help="The Dask cluster's scheduler.")
]


def parse_pairs(entries: Sequence[str] | None, form: str, hint: str) -> dict[str, str]:
    """Entries of the form `NAME=VALUE`; a malformed or repeated one is wrong usage (exit status 2)."""
    pairs: dict[str, str] = {}
    for entry in entries or ():
        name, _, value = (part.strip() for part in entry.partition("="))
        if not name or not value:
            raise typer.BadParameter(f"'{entry}' is not {form}", param_hint=hint)
        if name in pairs:
            raise typer.BadParameter(f"'{name}' is given twice", param_hint=hint)
        pairs[name] = value
    return pairs


def parse_topics(entries: Sequence[str] | None) -> dict[str, str]:
    """Topics by channel."""
    return parse_pairs(entries, "CHANNEL=/NAME", "--topic")


def parse_point(text: str | None, form: str, hint: str) -> tuple[float, float, float] | None:
    """Three numbers between commas, None for none; anything else is wrong usage (exit status 2)."""
    if text is None:
        return None
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not {form}", param_hint=hint) from None
    return x, y, z


def load_rig(vehicle: str | None) -> Rig | None:
    """The sensor geometry of a vehicle, None without one; a ConfigError where there is no such vehicle."""
    if vehicle is None:
        return None
    from terrafusion.twin.model.vehicle import load_vehicle

    return load_vehicle(vehicle).rig()


def rig_of(recording: Recording, rig: Rig | None) -> Rig | None:
    """`rig`, else that of the vehicle the log itself names, where it is known here."""
    if rig is not None or not recording.vehicle:
        return rig
    try:
        return load_rig(recording.vehicle)
    except ConfigError:
        return None


@dataclass(frozen=True)
class HowRead:
    """How logs are read: a command with a parameter of this type has these options."""

    topic: TopicOption = None
    stamps: StampsOption = "header"
    columns: ColumnsOption = None
    repair_clock: RepairClockOption = False

    def options(self, rig: Rig | None) -> dict[str, Any]:
        """Those of `open_recordings`; malformed ones are wrong usage (exit status 2)."""
        return {
            "rig": rig,
            "topics": parse_topics(self.topic),
            "stamps": self.stamps,
            "columns": self.columns,
            "repair_clock": self.repair_clock,
        }

    def open(self, log: str, rig: Rig | None) -> Recording:
        """The one recording of a log."""
        from terrafusion.datasets.readers import open_recording

        recording = open_recording(log, **self.options(rig))
        warn_of_log(log, [recording])
        return clock_accepted(recording) if self.repair_clock else recording

    def open_all(self, names: Sequence[str], rig: Rig | None) -> list[Recording]:
        """The logs of some names, of which `LOG@60-105` is a segment, `LOG@/45` all segments of 45 s."""
        from terrafusion.datasets.core.segments import split_name
        from terrafusion.datasets.readers import open_recordings

        options = self.options(rig)
        found: list[Recording] = []
        for name in names:
            log, cut = split_name(name)
            read = open_recordings(log, **options)
            warn_of_log(log, read)
            for recording in read:
                found += cut(recording)
        return [clock_accepted(r) for r in found] if self.repair_clock else found


def check_existence(logs: str | Sequence[str]) -> None:
    """Refuse names of logs that are not there (DataError), before what takes long to import."""
    for log in [logs] if isinstance(logs, str) else logs:
        if not os.path.exists(log):  # `Path.exists` raises where a name is too long
            from terrafusion.datasets.core.segments import split_name
            from terrafusion.datasets.readers.formats import format_of
            from terrafusion.datasets.readers.open import find_log

            place, _ = find_log(split_name(log)[0])
            if not place.exists():
                format_of(place)


def styled(line: str | Line) -> str:
    """A line as it is printed: in colour where standard output is a terminal, controls written out."""
    style, text = line if isinstance(line, tuple) else ("", line)
    word, space, rest = printable(text).partition(" ")
    if style and sys.stdout.isatty() and "NO_COLOR" not in os.environ:
        look: dict[str, Any] = {style: True} if style in ("bold", "dim") else {"fg": style}
        word = typer.style(word, **look)
    return word + space + rest


def warn_of_log(log: str, recordings: Sequence[Recording]) -> None:
    """A line on standard error for a log that is cut off, and for each option that means nothing for it."""
    from terrafusion.datasets.readers import CUT_OFF, NOT_USED

    for note in recordings[0].notes if recordings else ():
        if note.endswith(NOT_USED) or (CUT_OFF in note and not note.endswith("?")):
            print(f"warning: {log}: {note}", file=sys.stderr)


def clock_accepted(recording: Recording) -> Recording:
    """The recording with its repaired clock steps as notes, so that the log checks accept it."""
    notes = [
        f"{jump.channel}: its clock stood {jump.step_s:+.3f} s off from "
        f"t = {(jump.t_ns - recording.start_ns) * 1e-9:.2f} s on; taken out (--repair-clock)"
        for jump in recording.clock_jumps
    ]
    return dataclasses.replace(recording, clock_jumps=()).with_notes(*notes)


def refuse_errors(
    log: str, recording: Recording, rig: Rig | None, learned: Collection[str] = ()
) -> list[Finding]:
    """Refuse a log whose numbers would mislead: what the log checks call an error, but for those codes whose
    numbers are `learned` from the drive; gives the others.

    Raises:
        DataError: the first such finding, with its evidence and what to do.
    """
    from terrafusion.datasets.checks import run_checks

    findings = run_checks(recording, rig_of(recording, rig))
    _refuse(log, [finding for finding in findings if finding.code not in learned])
    return findings


def write_log(recording: Recording, out: Path, rig: Rig | None = None) -> list[str]:
    """Write an MCAP bag where `out` is named so, else a log folder; what ROS has no standard message for."""
    from terrafusion.datasets.writers import write_log_folder, write_mcap

    if out.suffix == ".mcap":
        return list(write_mcap(recording, out, rig=rig, overwrite=True))
    write_log_folder(recording, out)
    return []


def refuse_no_yaml(out: Path) -> None:
    """Refuse a name for a vehicle file that is none of a YAML file (ConfigError)."""
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError("--out is no YAML file", file=out, remedy="give a name such as my_robot.yaml")


def refuse_impossible(log: str, recording: Recording) -> None:
    """Refuse a log with numbers beyond anything possible: a DataError of the first."""
    from terrafusion.datasets.checks import CheckContext, check_magnitude

    _refuse(log, list(check_magnitude(CheckContext(recording, None))))


def _refuse(log: str, findings: list[Finding]) -> None:
    errors = [finding for finding in findings if finding.severity == "error"]
    if not errors:
        return
    first, more = errors[0], len(errors) - 1
    remedy = first.fix
    if first.repair is not None:
        remedy += f": `terrafusion convert {shlex.quote(log)} OUT --apply-fixes` does it"
    if more:
        remedy += f" (`terrafusion inspect` lists {more} more)"
    raise DataError(f"{first.what} ({first.evidence})", file=log, channel=first.channel, remedy=remedy)


def command_line() -> str:
    """The command as it was typed, without where its results go and what it prints."""
    words, remaining = iter(sys.argv[1:]), ["terrafusion"]
    for word in words:
        if word == "--out":
            next(words, None)
        elif word not in SHARED and not word.startswith("--out="):
            remaining.append(word)
    return shlex.join(remaining)


def read_json(path: Path) -> Any:
    """The document in a file that was just written."""
    return json.loads(path.read_text(encoding="utf-8"))


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], None] | None]:
    """A bar with the remaining time on a terminal, updated with the share done (0 to 1).

    In a pipe None; with `--verbose` a line every few seconds.
    """
    if not sys.stderr.isatty():
        yield _progress_lines(what) if PROGRESS.lines else None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, disable=not PROGRESS.bar) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(task, completed=share)


@dataclass
class ProgressOptions:
    """Whether progress is shown: as a bar on a terminal, as lines in a pipe."""

    bar: bool = True
    lines: bool = False


PROGRESS = ProgressOptions()
LINE_EVERY_S = 5.0


def _progress_lines(what: str) -> Callable[[float], None]:
    """Prints share and remaining time on standard error, at most a line every few seconds."""
    begun = time.monotonic()
    last = [begun]

    def report(share: float) -> None:
        now = time.monotonic()
        if share > 0.0 and now - last[0] >= LINE_EVERY_S:
            last[0] = now
            left_s = (now - begun) * (1.0 - share) / share
            print(f"{what}: {share:.0%}, {left_s:.0f} s left", file=sys.stderr, flush=True)

    return report


def check_backend(backend: str, address: str | None) -> None:
    """Refuse `--address` without `--backend dask`, and the other way round, before any work."""
    if (address is not None) != (backend == "dask"):
        raise typer.BadParameter("goes with --backend dask, which needs it", param_hint="--address")


def processes(jobs: int | None) -> int:
    """`--jobs`, or the number of processors."""
    import joblib

    return jobs if jobs is not None else int(joblib.cpu_count())
