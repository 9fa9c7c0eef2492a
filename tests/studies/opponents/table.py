"""Errors in outages: terrafusion beside three opponents, on every log with fixes or truth.

    python -m tests.studies.opponents.table --out FOLDER [--logs LOG...] [--seconds 10 30 60] [--jobs 2]

Opponents are tuned on half of the logs (`tuning`), with the vehicle of the log; terrafusion runs with its
defaults, once with that vehicle and once with wheel radius and track alone. Logs without a receiver get
fixes made from their truth, RTK-like and consumer-like. Paths in TERRAFUSION_LOGS are added to the logs of
the catalogue. Results are kept outage by outage: the same command goes on where it was stopped.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.studies.opponents import estimators, ours
from tests.studies.opponents.command import further_logs, missing, parser_of, prepared, store
from tests.studies.opponents.drives import Drive, as_unknown, default_logs, vehicle_of
from tests.studies.opponents.inertial import Inertial
from tests.studies.opponents.page import Cell, markdown, picture
from tests.studies.parts import Task, TaskWorkers, code_of, library_code, result_of, run_all

LENGTHS_S, APART_S = (30.0, 60.0, 10.0), 20.0
"""Lengths of the outages, and the time between their begins: many logs have room for one, so they overlap."""
DESCRIBED, UNKNOWN = "vehicle of the log", "wheel radius and track alone"
HERE = Path(__file__).parent


@dataclasses.dataclass(frozen=True)
class Work:
    """One drive, one length, one estimator; `known` is DESCRIBED or UNKNOWN."""

    drive: int
    seconds: float
    estimator: str
    known: str


_DRIVES: list[tuple[Drive, Inertial]] = []
"""Loaded once, shared by the workers."""


def compute(work: Work) -> dict[str, Any]:
    """Rows and failures of one task."""
    drive, inputs = _DRIVES[work.drive]
    if work.estimator in estimators.OPPONENTS:
        noise = estimators.noise_of(work.estimator)
        rows = estimators.rows_of(work.estimator, inputs, work.seconds, noise)
        return {"rows": [dataclasses.asdict(row) for row in rows], "failures": []}
    recording = as_unknown(drive.recording) if work.known == UNKNOWN else drive.recording
    replayed, failures = ours.rows(recording, inputs.streams, work.seconds, work.estimator)
    return {"rows": [dataclasses.asdict(row) for row in replayed], "failures": failures}


def load(names: Sequence[str], runs: int) -> None:
    """Read the logs; those that cannot be read are named and left out."""

    def prepare(drive: Drive) -> tuple[Drive, Inertial] | None:
        inputs = Inertial.of(drive.recording, vehicle_of(drive.recording, None))
        if inputs is None:
            return None
        streams = dataclasses.replace(inputs.streams, apart_s=APART_S)
        return drive, dataclasses.replace(inputs, streams=streams)

    _DRIVES[:] = prepared(names, runs, prepare)


def tasks_of(lengths: Sequence[float]) -> list[Task]:
    """All tasks, length after length; the opponents first, then one mode after another over all logs."""
    opponents = code_of(
        *(HERE / f"{n}.py" for n in ("ekf", "smoother", "ins", "inertial", "protocol", "drives"))
    )
    opponents += code_of(estimators.TUNED)
    library = library_code() + code_of(HERE / "drives.py", HERE / "protocol.py")
    wanted = [(name, DESCRIBED) for name in estimators.OPPONENTS]
    wanted += [(mode, known) for known in (DESCRIBED, UNKNOWN) for mode in estimators.MODES]
    tasks = []
    for seconds in lengths:
        for estimator, known in wanted:
            code = opponents if estimator in estimators.OPPONENTS else library
            for i, (drive, inputs) in enumerate(_DRIVES):
                if inputs.streams.passes(seconds):
                    name = f"{drive.name} {drive.recording.name} {seconds:g} s {estimator} {known}"
                    tasks.append(Task(name, code, Work(i, seconds, estimator, known)))
    return tasks


def cells_of(tasks: Sequence[Task], folder: Path) -> tuple[list[Cell], list[str]]:
    """Outages by log, length, estimator and what is known, and all failures."""
    errors: dict[tuple[str, float, str, str], list[tuple[float, float]]] = {}
    failures = []
    for task in tasks:
        result = result_of(task, folder)
        if result is None:
            continue
        work: Work = task.what
        key = (_DRIVES[work.drive][0].name, work.seconds, work.estimator, work.known)
        errors.setdefault(key, []).extend((r["error_m"], r["distance_m"]) for r in result["rows"])
        failures += [f"{key[0]}, {key[1]:g} s, {key[2]}, {key[3]}: {line}" for line in result["failures"]]
    return [Cell(*key, *zip(*rows, strict=True)) for key, rows in errors.items() if rows], failures


def main() -> int:
    """The command line."""
    parser = parser_of("opponents.table", __doc__)
    parser.add_argument("--seconds", nargs="+", type=float, default=LENGTHS_S)
    parser.add_argument("--only", nargs="+", metavar="ESTIMATOR", help="run these alone")
    given = parser.parse_args()
    names = given.logs or [*default_logs(), *further_logs()]
    load(names, given.runs)
    if not _DRIVES:
        parser.exit(1, "error: no log can be scored; set TERRAFUSION_DATA\n")
    tasks, parts = tasks_of(given.seconds), given.out / "parts"
    run_all(
        [t for t in tasks if not given.only or t.what.estimator in given.only],
        compute,
        parts,
        TaskWorkers.of(given),
        functools.partial(load, names, given.runs),
    )
    cells, failures = cells_of(tasks, parts)
    text = markdown(cells, failures, missing(tasks, parts), len(tasks))
    store(given.out, "opponents", text, picture(cells))
    return 0


if __name__ == "__main__":
    from tests.studies.opponents import table

    sys.exit(table.main())  # workers know the tasks by the module's own name
