"""Known changes put into field logs: errors in outages and ellipses before, after, and with the number told.

    python -m tests.studies.known_changes.table --out FOLDER [--logs LOG...] [--seconds 30] [--jobs 2]

Every log gets every change (`changes`); the estimator runs with its defaults and is not told, then once more
with the number told where there is a place for it. "Inside" is the share of errors in the outages that lie
in the 95 % ellipse of their estimate. Paths in TERRAFUSION_LOGS are added to the logs of the catalogue.
Results are kept one by one: the same command goes on where it was stopped.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.fusion.benchmark.outage_plan import until
from tests.studies.known_changes.changes import CHANGES, Change
from tests.studies.known_changes.page import BEFORE, Found, markdown, picture
from tests.studies.opponents import ours
from tests.studies.opponents.command import further_logs, missing, parser_of, prepared, store
from tests.studies.opponents.drives import Drive, default_logs, vehicle_of
from tests.studies.opponents.protocol import Streams, streams_of
from tests.studies.parts import Task, TaskWorkers, code_of, library_code, result_of, run_all

HERE = Path(__file__).parent
MODE = "adaptive"
"""The default of replay."""


@dataclasses.dataclass(frozen=True)
class Work:
    """One drive with one change; `told` as in `changes`."""

    drive: int
    change: str
    told: bool
    seconds: float


_DRIVES: list[tuple[Drive, Streams]] = []
"""Loaded once, shared by the workers."""
_BY_NAME = {change.name: change for change in CHANGES}


def compute(work: Work) -> dict[str, Any]:
    """Rows of one task, or why the change does not apply to the log."""
    drive, streams = _DRIVES[work.drive]
    recording = drive.recording
    if work.change != BEFORE:
        change: Change = _BY_NAME[work.change]
        put = change.told if work.told and change.told else change.put
        try:
            recording = put(recording)
        except TerrafusionError as error:
            return {"rows": [], "failures": [], "skipped": str(error)}
    rows, failures = ours.rows(recording, streams, work.seconds, MODE, original=drive.recording)
    return {"rows": [dataclasses.asdict(row) for row in rows], "failures": failures, "skipped": ""}


def load(names: Sequence[str], runs: int, most_s: float) -> None:
    """Read the logs and cut long ones; those that cannot be read are named and left out."""

    def prepare(drive: Drive) -> tuple[Drive, Streams] | None:
        cut = dataclasses.replace(drive, recording=until(drive.recording, most_s))
        streams = streams_of(cut.recording, vehicle_of(cut.recording, None))
        return None if streams is None else (cut, streams)

    _DRIVES[:] = prepared(names, runs, prepare)


def tasks_of(seconds: float, most_s: float) -> list[Task]:
    """Before, then change after change over all logs, not told and told."""
    code = library_code() + code_of(HERE / "changes.py", HERE.parent / "opponents" / "drives.py")
    wanted = [(BEFORE, False), *((c.name, False) for c in CHANGES)]
    wanted += [(c.name, True) for c in CHANGES if c.told is not None]
    return [
        Task(
            f"{drive.name} {drive.recording.name} {change} {told} {seconds:g} {most_s:g}",
            code,
            Work(i, change, told, seconds),
        )
        for change, told in wanted
        for i, (drive, streams) in enumerate(_DRIVES)
        if streams.passes(seconds)
    ]


def found_in(tasks: Sequence[Task], folder: Path) -> tuple[list[Found], list[str]]:
    """Results by log and change, and what failed or does not apply."""
    rows: dict[tuple[str, str, str, bool], list[dict[str, Any]]] = {}
    notes = []
    for task in tasks:
        result, work = result_of(task, folder), task.what
        if result is None:
            continue
        drive = _DRIVES[work.drive][0]
        rows.setdefault((drive.set_name, drive.name, work.change, work.told), []).extend(result["rows"])
        lines = [*result["failures"], *([result["skipped"]] if result["skipped"] else [])]
        notes += [f"{drive.name}, {work.change}: {line}" for line in lines]
    return [
        Found(*key, [r["error_m"] for r in mine], [r["share_inside"] for r in mine])
        for key, mine in rows.items()
        if mine
    ], notes


def main() -> int:
    """The command line."""
    parser = parser_of("known_changes.table", __doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the outages")
    parser.add_argument("--most-s", type=float, default=3600.0, help="longer logs are cut")
    given = parser.parse_args()
    names = [*(given.logs or default_logs()), *further_logs()]
    load(names, given.runs, given.most_s)
    if not _DRIVES:
        parser.exit(1, "error: no log can be scored; set TERRAFUSION_DATA\n")
    tasks, parts = tasks_of(given.seconds, given.most_s), given.out / "parts"
    again = functools.partial(load, names, given.runs, given.most_s)
    run_all(tasks, compute, parts, TaskWorkers.of(given), again)
    found, notes = found_in(tasks, parts)
    text = markdown(found, notes, missing(tasks, parts), len(tasks))
    store(given.out, "known_changes", text, picture(found))
    return 0


if __name__ == "__main__":
    from tests.studies.known_changes import table

    sys.exit(table.main())  # workers know the tasks by the module's own name
