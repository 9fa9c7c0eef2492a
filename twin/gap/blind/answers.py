"""Trials given to a diagnosis and its opponent, and their answers: one line of JSON a trial."""

import contextlib
import dataclasses
import functools
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from terrafusion.datasets.core.files import unwritable, write_atomically
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.executors import open_workers
from terrafusion.twin.gap.blind import seal
from terrafusion.twin.gap.blind.plan import RUNS, VEHICLE, Trial, specs
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

ORACLE = "oracle.jsonl"
DIAGNOSIS, OPPONENT = "diagnosis", "opponent"
LANES = 160  # runs of the plant in one batch (about 5 MB each)


class Answer(Protocol):
    """Result of a diagnosis."""

    def to_json(self) -> dict[str, Any]:
        """Keeps to `diagnosis.schema.json`."""


Diagnose = Callable[..., Answer]  # diagnose(runs, references, vehicle, *, seed) -> Answer


@dataclass(frozen=True)
class Pool:
    """Where answers are computed: `backend` and `address` as for `executors.open_workers`; `jobs` trials at
    once."""

    jobs: int = 1
    backend: str = "loky"
    address: str | None = None


@dataclass(frozen=True, eq=False)
class BlindCase:
    """A trial as a diagnosis gets it: nothing of the truth."""

    trial: str
    runs: tuple[Recording, ...]
    references: tuple[Recording, ...]
    vehicle: VehicleParams


def cases(trials: Sequence[Trial]) -> Iterator[BlindCase]:
    """The trials' recordings, simulated lazily."""
    vehicle, block = load_vehicle(VEHICLE), list[Trial]()
    for trial in trials:
        if sum(RUNS + t.references for t in (*block, trial)) > LANES:
            yield from _simulated(block, vehicle)
            block = []
        block.append(trial)
    yield from _simulated(block, vehicle)


def _simulated(block: Sequence[Trial], vehicle: VehicleParams) -> Iterator[BlindCase]:
    """Trials whose runs are computed together, those of equal length in one batch."""
    from terrafusion.twin.gap.blind.plant.run import record

    wanted = [spec for trial in block for spec in specs(trial)]
    names = [f"run-{i + 1}" for i in range(RUNS)]
    names = [n for t in block for n in (*names, *(f"reference-{i + 1}" for i in range(t.references)))]
    made: dict[int, Recording] = {}
    for seconds in dict.fromkeys(spec.duration_s() for spec in wanted):
        some = [i for i, spec in enumerate(wanted) if spec.duration_s() == seconds]
        made |= zip(some, record([wanted[i] for i in some], names=[names[i] for i in some]), strict=True)
    first = 0
    for trial in block:
        split, end = first + RUNS, first + RUNS + trial.references
        runs, references = (
            tuple(made.pop(i) for i in range(*ends)) for ends in ((first, split), (split, end))
        )
        yield BlindCase(trial.trial, runs, references, vehicle)
        first = end


def answered(folder: Path, name: str = seal.ANSWERS) -> dict[str, dict[str, Any]]:
    """Stored answers by trial; a truncated line does not count."""
    path = folder / name
    found = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        found[entry["trial"]] = entry
    return found


def answer_all(
    folder: Path,
    trials: Sequence[Trial],
    methods: Mapping[str, Diagnose],
    pool: Pool,
    progress: Callable[[float], None] | None = None,
    minutes: float = math.inf,
) -> None:
    """Answers of all `methods` to the trials that have none yet, until all are stored, or for so many
    minutes."""
    until_s = time.monotonic() + 60.0 * minutes
    done = answered(folder)
    _rewrite(folder, done)  # without a line that was cut off
    missing = [trial for trial in trials if trial.trial not in done]
    questions = ((case, methods) for case in cases(missing))
    for entry in _stored(folder / seal.ANSWERS, questions, pool):
        done[entry["trial"]] = entry
        if progress is not None:
            progress(len(done) / len(trials))
        if time.monotonic() > until_s:
            break
    _rewrite(folder, done)


def _stored(path: Path, questions: Iterator[tuple[Any, ...]], pool: Pool) -> Iterator[dict[str, Any]]:
    """Entries as they come, each appended to the file."""
    with open_workers(pool.backend, pool.jobs, pool.address) as found:
        # Recordings are large: no more of them at once than are worked on soon.
        workers = dataclasses.replace(found, at_once=found.at_once or 2 * pool.jobs)
        for entry in workers.results(answer, questions):
            _append(path, entry)
            yield entry


def _append(path: Path, entry: Mapping[str, Any]) -> None:
    """One more line; where the disk is full, the file stays as it was.

    Raises:
        DataError: it cannot be written.
    """
    size = path.stat().st_size if path.exists() else 0
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        with contextlib.suppress(OSError):
            os.truncate(path, size)
        raise unwritable(path, error) from None


def answer(case: BlindCase, methods: Mapping[str, Diagnose]) -> dict[str, Any]:
    """Answers of all methods: {"trial", method: {"seconds", "error", "answer"}}. An exception is recorded: it
    counts as wrong."""
    return {"trial": case.trial, **{name: _answer(case, method) for name, method in methods.items()}}


def _answer(case: BlindCase, method: Diagnose) -> dict[str, Any]:
    begun = time.process_time()
    try:
        given = method(case.runs, case.references, case.vehicle, seed=0).to_json()
        json.dumps(given, allow_nan=False)
        error = None
    except Exception as problem:
        given, error = None, f"{type(problem).__name__}: {problem}"
    return {"seconds": round(time.process_time() - begun, 3), "error": error, "answer": given}


def ask_oracle(folder: Path, trials: Sequence[Trial], oracle: Diagnose, pool: Pool) -> dict[str, float]:
    """Share of the gap that disappears where the diagnosis is given the true effects, by trial.

    For single effects whose answer has a share, once the labels are open; `oracle.jsonl` stores the results.
    The oracle is called as the diagnosis, with `effects`, the names of the candidates.
    """
    with_share = {t for t, entry in answered(folder).items() if _share(entry) is not None}
    done = answered(folder, ORACLE)
    asked = [t for t in trials if t.trial in with_share and t.family in ("same", "shifted")]
    effects = {t.trial: t.effects() for t in asked}
    questions = (
        (case, {DIAGNOSIS: functools.partial(oracle, effects=effects[case.trial])})
        for case in cases([t for t in asked if t.trial not in done])
    )
    done |= {entry["trial"]: entry for entry in _stored(folder / ORACLE, questions, pool)}
    shares = {t: _share(entry) for t, entry in done.items()}
    return {t: float(share) for t, share in shares.items() if share is not None}


def _share(entry: Mapping[str, Any]) -> float | None:
    return ((entry[DIAGNOSIS]["answer"] or {}).get("shrink") or {}).get("share")


def _rewrite(folder: Path, entries: Mapping[str, dict[str, Any]]) -> None:
    lines = "".join(json.dumps(entries[name]) + "\n" for name in sorted(entries))
    write_atomically(folder / seal.ANSWERS, lambda part: part.write_text(lines, encoding="utf-8"))
